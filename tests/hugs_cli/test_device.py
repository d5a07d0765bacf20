"""Where the heavy stages compute."""

from __future__ import annotations

import pytest

from hugs_cli import device
from hugs_cli.device import device_of
from hugs_cli.pipelines import UsageError
from tests.made.said import holds


def test_a_gpu_counts_only_with_gsplat(monkeypatch):
    monkeypatch.setattr(device, "find_device", lambda: "cuda")
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: None)
    assert device_of("auto")[0] == device_of("cpu")[0] == "cpu" and "gsplat" in device_of("auto")[1]
    with pytest.raises(UsageError) as error:
        device_of("cuda")
    assert "gsplat" in error.value.problem and "hugs-avatar[gpu]" in error.value.hint
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: object())
    assert device_of("auto")[0] == device_of("cuda")[0] == "cuda" and device_of("cpu")[0] == "cpu"
    monkeypatch.setattr(device, "find_device", lambda: "cpu")
    assert device_of("auto")[0] == "cpu" and holds(device_of("auto")[1], "GPU", "torch")
