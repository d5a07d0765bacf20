"""The examples of the documents that make something are tried, up to their plan, on a small clip: `--dry-run` of each."""

import shlex
import shutil

import numpy as np
import pytest

from stages.formats.video import write_video
from tests.docs.documents import documents
from tests.made.command import hugs_here

PLANNED = {"run": "train", "ablate": "no_", "costs": "steps", "fleet": "dance"}
"""A command that has a plan -> a word that its plan has, on this clip."""
BROUGHT = (
    "--masks",
    "--smpl-fit",
    "--cameras",
    "--body-model",
    "--landmarks",
    "neuman",
    "zju",
    "--profile",
    "--only-failed",
)
"""What this clip has not; tests/test_datasets_end_to_end.py, tests/hugs_cli and tests/stages bring them."""
SAME = {"--dry-run", "--jobs", "--name", "--budget", "--seeds", "--plot", "--height", "--scale", "--person"}


def examples() -> list[str]:
    """One for each command with the same options but those that change no plan, without what follows #."""
    lines = [line.split(" #")[0].strip() for d in documents() for b in d.blocks("console") for line in b.splitlines()]
    planned = [line for line in lines if line.startswith("hugs ") and line.split()[1] in PLANNED]
    planned = [line for line in planned if not any(word in line for word in BROUGHT)]
    planned = [line for line in planned if "costs" not in line or "--sweep" in line]
    options = {line: {word for word in line.split() if word[0] == "-"} - SAME for line in planned}
    return list({(line.split()[1], *sorted(words)): line for line, words in options.items()}.values())


@pytest.mark.slow
def test_examples_have_a_plan(tmp_path, monkeypatch, capsys):
    rng = np.random.default_rng(0)
    write_video(tmp_path / "dance.mp4", rng.integers(0, 255, (12, 64, 48, 3), np.uint8), 12)
    (tmp_path / "clips").mkdir()
    shutil.copy(tmp_path / "dance.mp4", tmp_path / "clips" / "dance.mp4")
    (tmp_path / "clips.csv").write_text("clip\nclips/dance.mp4\n")
    found = examples()
    assert {line.split()[1] for line in found} == set(PLANNED) and len(found) > 8
    for line in found:
        words = shlex.split(line)[1:]
        out, err = hugs_here(tmp_path, monkeypatch, capsys, *words, *([] if "--dry-run" in words else ["--dry-run"]))
        wanted = words[2] if words[0] == "run" and words[2:] and words[2][0] != "-" else PLANNED[words[0]]
        assert wanted in out + err, line
