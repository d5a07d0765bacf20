"""The command line, run from the repository's root."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def hugs(*arguments: str | Path, seconds: float = 1200) -> subprocess.CompletedProcess[str]:
    """Run the command line; the test fails with all it said if it does, or takes longer."""
    command = [sys.executable, "-c", "from hugs_cli import main; main()", *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=seconds)
    assert done.returncode == 0, f"hugs {' '.join(map(str, arguments))}\n{done.stdout}\n{done.stderr}"
    return done
