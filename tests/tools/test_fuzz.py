"""A few damaged files of each kind, and a few kills; `python -m tests.tools.fuzz` and `tests.tools.kills` do thousands."""

from __future__ import annotations

import numpy as np
import pytest

from tests.made import faulty
from tests.made.corpus import KINDS
from tests.tools import fuzz, kills
from tests.tools.mutations import DAMAGE, mutated, with_checksums

TRIES = 3  # of each kind


@pytest.mark.slow
def test_i14_i15_every_kind_of_damaged_file_is_read_or_refused(whole, tmp_path):
    """In this process, so that it is quick; a crash inside a library ends the whole test run."""
    root = tmp_path / "root"
    fuzz.shutil.copytree(whole, root)
    found = []
    for kind in KINDS:
        assert fuzz.attempt(kind, root) == ("read", ""), kind.file
        for number in range(TRIES):
            (root / kind.file).write_bytes(fuzz.damaged(kind, whole, 1, number))
            outcome, text = fuzz.attempt(kind, root)
            found += [f"{kind.file}:{number} {text}"] if outcome == "crashed" else []
        (root / kind.file).write_bytes((whole / kind.file).read_bytes())
    assert found == []


@pytest.mark.slow
def test_the_fuzzer_finds_bugs_files_elsewhere_memory_aborts_and_hangs(whole, monkeypatch):
    monkeypatch.setattr(fuzz, "LONGEST", 5.0)
    for kind, last in zip(faulty.KINDS, ("crashed exit code -6", "hung for 5 s"), strict=True):
        tally = fuzz.fuzz(kind, whole, 0, 5, "tests.made.faulty")
        found = [finding.partition(":")[2] for finding in tally.findings]
        wanted = ["0 crashed KeyError", "1 crashed wrote", "2 crashed MemoryError", f"3 {last}", "4 crashed KeyError"]
        assert [text.startswith(start) for text, start in zip(found, wanted, strict=True)] == [True] * 5, found
        assert sum(tally.counts.values()) == 5


def test_damage_is_the_same_for_the_same_seed_and_changes_something():
    data = b"\x89PNG element vertex 20 and more text, 3.5 of it\nlines\n" * 3
    for damage in DAMAGE:
        one, two = (damage(data, np.random.default_rng(5)) for _ in range(2))
        assert one == two
    changed = [mutated(data, np.random.default_rng(i)) != data for i in range(50)]
    assert sum(changed) > 40


def test_checksums_are_made_right(whole):
    data = bytearray((whole / "picture.png").read_bytes())
    assert with_checksums(bytes(data)) == bytes(data)
    data[20] ^= 1
    assert with_checksums(bytes(data)) != bytes(data)


@pytest.mark.slow
def test_killed_at_random_moments_nothing_is_lost(tmp_path):
    """Stand-in stages; `python -m tests.tools.kills` also kills a real training."""
    times = 2
    found = kills.harass(kills.StandIns(tmp_path), times, np.random.default_rng(3))
    assert {what: found[what] for what in kills.FINDINGS} == dict.fromkeys(kills.FINDINGS, 0)
    assert sum(found[f"killed {number.name}"] for number in kills.SIGNALS) == times and found["finished"]
