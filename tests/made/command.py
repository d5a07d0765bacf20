"""The command line: in a process of its own from the repository's root, or in this one from any folder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hugs_cli.app import main

ROOT = Path(__file__).parents[2]


def hugs(*arguments: str | Path, seconds: float = 1200) -> subprocess.CompletedProcess[str]:
    """Run the command line; the test fails with all it said if it does, or takes longer."""
    command = [sys.executable, "-c", "from hugs_cli import main; main()", *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=seconds)
    assert done.returncode == 0, f"hugs {' '.join(map(str, arguments))}\n{done.stdout}\n{done.stderr}"
    return done


def hugs_here(
    folder: Path, patch: pytest.MonkeyPatch, output: pytest.CaptureFixture[str], *arguments: str, code: int = 0
) -> tuple[str, str]:
    """Run the command line in this process, in a folder; its stdout and stderr. The test fails if it ends with another code."""
    patch.chdir(folder)
    patch.setattr("signal.signal", lambda number, handler: None)  # Ctrl-C stays pytest's
    patch.setattr(sys, "argv", ["hugs", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    out, err = output.readouterr()
    assert end.value.code == code, out + err
    return out, err
