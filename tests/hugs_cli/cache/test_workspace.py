"""The folder of a clip: small files are whole at every moment."""

from __future__ import annotations

import os

import pytest

from hugs_cli.cache.workspace import read_json, write_json


def test_a_small_file_is_replaced_in_one_step(tmp_path):
    path = tmp_path / "stamp.json"
    write_json(path, {"a": 1})
    with open(path) as reader:
        write_json(path, {"a": 2})
        assert reader.read().split() == ["{", '"a":', "1", "}"], "who reads the old file reads it whole"
    assert read_json(path) == {"a": 2} and os.listdir(tmp_path) == ["stamp.json"]


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = tmp_path / "stamp.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": 2, "b": object()})
    assert read_json(path) == {"a": 1}
