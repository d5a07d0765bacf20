"""What earlier runs tell of memory."""

import json

from hugs_cli.fleet import history as histories
from hugs_cli.fleet.history import OWN_MB, UNMEASURED_MB, free_megabytes, history


def test_the_most_memory(tmp_path):
    (tmp_path / "a").mkdir()
    line = {"pipeline": "draft", "stage": "train", "result": "done", "peak_memory_bytes": 2**30}
    lines = [line, {**line, "result": "killed", "peak_memory_bytes": 2**31}, {**line, "stage": "frames"}]
    (tmp_path / "a/runs.jsonl").write_text("\n".join([*map(json.dumps, lines), "not json", "[1]", '{"stage": 1}']))
    found = history(tmp_path)
    assert found.megabytes("draft") == OWN_MB + round(1.25 * 2048) and found.megabytes("other") == UNMEASURED_MB


def test_clips_of_the_same_name_count_too(tmp_path):
    """Their results lie in a work folder of their own, see `clips.work_folders`."""
    for place, megabytes in (("dance", 1000), ("from-monday/dance", 3000), ("from-shots-tuesday/dance", 2000)):
        (tmp_path / place).mkdir(parents=True)
        run = {"pipeline": "draft", "stage": "train", "result": "done", "peak_memory_bytes": megabytes * 2**20}
        (tmp_path / place / "runs.jsonl").write_text(json.dumps(run))
    assert history(tmp_path).megabytes("draft") == OWN_MB + 3750


def test_so_many_clips_are_read_and_no_more(tmp_path, monkeypatch):
    """A fleet of 100,000 clips is planned before its histories could be read."""
    read: list[str] = []
    monkeypatch.setattr(histories, "CLIPS", 3)
    monkeypatch.setattr(histories, "runs", lambda file: read.append(file.parent.name) or [])
    for k in range(9):
        (tmp_path / f"clip{k}").mkdir()
        (tmp_path / f"clip{k}/runs.jsonl").touch()
    history(tmp_path)
    assert len(read) == 3


def test_an_empty_folder_tells_nothing(tmp_path):
    assert history(tmp_path / "none").megabytes("draft") == UNMEASURED_MB


def test_this_machine_has_memory():
    assert free_megabytes() > 50


def test_the_memory_of_a_container(tmp_path):
    """What it read from files lately gives way, and none at all is not the same as not known."""
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9000000 kB\nMemAvailable: 8192000 kB\nHugePages_Total: 0\n")
    assert free_megabytes(tmp_path) == 8000
    group = tmp_path / "sys/fs/cgroup"
    group.mkdir(parents=True)
    (group / "memory.stat").write_text(f"anon 5\ninactive_file {3 << 30}\n")
    (group / "memory.current").write_text(f"{4 << 30}\n")
    for limit, expected in (("max\n", 8000), (f"{5 << 30}\n", 4096), (f"{1 << 29}\n", 1)):
        (group / "memory.max").write_text(limit)
        assert free_megabytes(tmp_path) == expected
