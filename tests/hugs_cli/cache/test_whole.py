"""Small files: old or new, never half, and nothing is left of one that could not be written."""

from __future__ import annotations

import errno
import os

import pytest

from hugs_cli.cache.whole import replace


def test_a_file_is_new_or_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "facts.json"
    replace(path, "new")
    replace(path, "newer \N{MULTIPLICATION SIGN}", flush=True)
    assert path.read_text(encoding="utf-8") == "newer \N{MULTIPLICATION SIGN}" and list(tmp_path.iterdir()) == [path]

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        replace(path, "lost", flush=True)
    assert path.read_text(encoding="utf-8").startswith("newer") and list(tmp_path.iterdir()) == [path]
