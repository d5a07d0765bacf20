"""What re-runs and why; killed, stopped, doubled and damaged runs. Every test goes through the command line."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from pathlib import Path

import pytest

from hugs_cli.cache import fingerprint
from hugs_cli.cache.fingerprint import digest
from hugs_cli.cache.workspace import Stamp
from hugs_cli.pipelines import SOURCES
from tests.made.flow import ALL, LONGEST, STAGE, WHOLE
from tests.made.said import holds


def child_of(pid: int) -> list[int]:
    """Processes that a process started."""
    return [int(p) for p in open(f"/proc/{pid}/task/{pid}/children").read().split()]


def alive(pid: int) -> bool:
    """True while a process runs (a dead one that nobody has waited for does not)."""
    try:
        return open(f"/proc/{pid}/stat").read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
def test_first_run_makes_all_and_the_second_nothing(flow):
    out, err = flow.hugs()
    assert out == "work/clip/default/four\n"
    assert flow.text("four") == WHOLE
    assert err.splitlines()[1].startswith("this run takes about ")
    assert [line.split()[:2] for line in err.splitlines()[2:]] == [[name, "done"] for name in ALL]
    assert "first run" in err
    out, err = flow.hugs()
    assert [line.split()[:3] for line in err.splitlines()[1:]] == [[name, "cached", "saved"] for name in ALL]


@pytest.mark.slow
def test_run_of_one_stage_runs_what_it_needs_and_no_more(flow):
    assert list(flow.ran("two")) == ["one", "two"]
    assert list(flow.ran("two", "three")) == ["three"]
    out, _ = flow.hugs("two")
    assert out == "work/clip/default/two\n"


@pytest.mark.slow
def test_comments_and_docstrings_make_nothing_stale(made):
    made.edit("helper", "# with a comment", "# with another comment, and a line\n")
    made.edit("helper", "What all stages do.", "What every stage does.")
    made.edit("two", "Write one file.", "Write a file.")
    made.edit("two", "What to write.", "The word to write.")
    assert made.ran() == {}


@pytest.mark.slow
def test_edited_helper_reruns_all_that_import_it_and_same_bytes_stop_the_wave(made):
    made.edit("helper", "count = len(", "count = 0 + len(")
    assert made.ran() == {name: ["code flow.helper edited"] for name in ALL}
    made.edit("two", "from flow import helper", "from flow import helper as helper; helper.x = 1")
    assert made.ran() == {"two": ["code flow.two edited"]}  # four sees the same bytes
    made.edit("one", '"one"', '"eins"')
    ran = made.ran()
    assert ran["one"] == ["code flow.one edited"]
    assert ran["two"] == ["inputs.one changed"]
    assert ran["four"] == ["inputs.three changed", "inputs.two changed"]


@pytest.mark.slow
def test_a_changed_input_tells_what_its_stage_decides_otherwise(flow):
    note = '; (job.out / \'one.json\').write_text(\'{"decisions": {"shadow": true, "sky": false}}\')'
    flow.edit("one", "[video])", "[video])" + note)
    flow.hugs("two")
    flow.edit("one", "true", "false")
    assert flow.ran("one") == {"one": ["code flow.one edited"]}
    out, _ = flow.hugs("two", command="why")
    assert holds(out, "inputs", "one", "shadow", "on", "off") and "sky" not in out
    (reason,) = flow.ran("two")["two"]
    assert holds(reason, "inputs.one", "shadow", "on", "off")


@pytest.mark.slow
def test_edited_code_and_settings_are_named_together(made):
    made.edit("two", "helper.work(", "helper.x = 1; helper.work(")
    ran = made.ran("--set", "two.word=b")
    assert ran == {"two": ["params.word: a -> b", "code flow.two edited"], "four": ["inputs.two changed"]}


@pytest.mark.slow
def test_settings_that_only_change_speed_make_nothing_stale(made):
    assert made.ran("--set", "four.delay=0.1") == {}
    assert made.ran("--set", "four.word=b") == {"four": ["params.word: a -> b"]}
    assert made.ran() == {}  # the first result is still there
    assert made.text("four") == WHOLE


@pytest.mark.slow
@pytest.mark.parametrize("source", SOURCES)
def test_h20_a_result_is_that_of_each_file_that_its_stage_reads(flow, source):
    flow.write("one", STAGE.format(name="one", needs=", ".join(SOURCES), resumes=False))
    pipelines = flow.folder / "pipelines.yaml"
    pipelines.write_text(pipelines.read_text().replace("[video]", f"[{', '.join(SOURCES)}]"))
    files = {name: flow.folder / f"{name}.txt" for name in SOURCES} | {"video": flow.video}
    given = [word for name in SOURCES if name != "video" for word in (SOURCES[name], files[name].name)]
    for name, path in files.items():
        path.write_text(name)
    assert list(flow.ran("one", *given)) == ["one"] and flow.ran("one", *given) == {}
    files[source].write_text("other content")
    assert flow.ran("one", *given) == {"one": [f"inputs.{source} changed"]}


@pytest.mark.slow
def test_h20_edited_video_and_masks(made):
    made.video.write_text("other pixels")
    assert made.ran()["one"] == ["inputs.video changed"]
    masks = made.folder / "masks.txt"
    masks.write_text("m")
    assert made.ran("--masks", "masks.txt")["three"] == ["inputs.mask_files new"]
    assert made.ran("--masks", "masks.txt") == {}
    masks.write_text("n")
    assert made.ran("--masks", "masks.txt") == {
        "three": ["inputs.mask_files changed"],
        "four": ["inputs.three changed"],
    }
    os.utime(made.video)
    assert made.ran("--masks", "masks.txt") == {}  # touched, not changed


@pytest.mark.slow
def test_seed_is_in_the_key_and_force_is_not(made):
    assert made.ran("one", "--seed", "1") == {"one": ["seed: 0 -> 1"]}
    assert made.ran() == {}
    assert made.ran("two", "--force") == {"two": ["forced"]}
    assert made.ran("--force") == {name: ["forced"] for name in ALL}
    assert not list(made.store.glob("*.old"))


@pytest.mark.slow
def test_pipelines_share_results(made):
    assert made.ran("--pipeline", "other") == {"four": ["first run"]}
    assert made.text("four", "other").startswith("four:z(")
    assert (made.work / "clip/other/one").resolve() == (made.work / "clip/default/one").resolve()


@pytest.mark.slow
@pytest.mark.parametrize("stage", ALL)
def test_killed_inside_each_stage_and_run_again(flow, stage):
    run = flow.start(*flow.hold(stage))
    flow.wait_for(lambda: list(flow.store.glob(f"{stage}-*.part/step0")))
    children = child_of(run.pid)
    run.kill()
    run.wait()
    before = {name for name in ALL if (flow.work / "clip/default" / name).exists()}
    assert stage not in before
    flow.wait_for(lambda: not any(map(alive, children)))  # the stage ends with its run
    assert not [folder for folder in flow.store.iterdir() if folder.name.startswith(stage) and folder.suffix != ".part"]
    ran = flow.ran("--set", f"{stage}.delay=0.05")
    assert set(ran) == set(ALL) - before
    first, how = ran[stage]
    assert first == "first run" and holds(how, "cut short") and holds(how, "continues") == (stage == "three")
    assert flow.text("four") == WHOLE
    stamp = json.loads((flow.work / "clip/default" / stage / "stamp.json").read_text())
    assert (stamp["notes"] == ["began at step 0"]) == (stage != "three")
    assert not list(flow.store.glob("*.part"))


@pytest.mark.slow
def test_what_a_stage_says_twice_is_kept_once(flow):
    flow.edit(
        "helper", "# with a comment", "[say(text) for say in (job.note, job.warn) for text in ('again', 'again')]"
    )
    flow.ran()
    stamp = json.loads((flow.work / "clip/default/one/stamp.json").read_text())
    assert stamp["notes"] == stamp["warnings"] == ["again"]


@pytest.mark.slow
def test_stage_killed_from_outside_is_an_error_that_names_the_signal(flow):
    run = flow.start(*flow.hold("two"))
    flow.wait_for(lambda: list(flow.store.glob("two-*.part/step0")))
    os.kill(child_of(run.pid)[0], signal.SIGKILL)
    _, err = run.communicate(timeout=LONGEST)
    assert run.returncode == 1
    assert holds(err, "error", "two", "SIGKILL", "hint", "memory")
    lines = [json.loads(line) for line in (flow.work / "clip/runs.jsonl").read_text().splitlines()]
    assert [(line["stage"], line["result"]) for line in lines] == [("one", "done"), ("two", "killed")]


@pytest.mark.slow
@pytest.mark.parametrize(("number", "stage"), [(signal.SIGTERM, "two"), (signal.SIGINT, "three")])
def test_stopped_run_ends_at_once_keeps_what_is_done_and_goes_on(flow, number, stage):
    run = flow.start(*flow.hold(stage))
    flow.wait_for(lambda: list(flow.store.glob(f"{stage}-*.part/step0")))
    run.send_signal(number)
    _, err = run.communicate(timeout=LONGEST)
    assert run.returncode == 130
    assert holds(err.splitlines()[-1], "stopped", stage, "next run")
    spent = [json.loads(line)["seconds"] for line in (flow.work / "clip/runs.jsonl").read_text().splitlines()][-1]
    ran = flow.ran("--set", f"{stage}.delay=0.05")
    assert "one" not in ran and stage in ran
    last = [json.loads(line) for line in (flow.work / "clip/runs.jsonl").read_text().splitlines()]
    (again,) = [line["seconds"] for line in last if line["stage"] == stage and line["result"] == "done"]
    assert again > spent if stage == "three" else again > 0, "of a training, all its time"
    assert not list(flow.store.glob("*/.earlier.json"))
    assert flow.text("four") == WHOLE


@pytest.mark.slow
def test_a_stop_that_a_stage_no_longer_hears_keeps_its_result_and_ends_the_run_after_it(flow):
    flow.edit("helper", "if job.stop_asked:", "if False:")  # as training does once its last step is taken
    run = flow.start(*flow.hold("three"))
    flow.wait_for(lambda: list(flow.store.glob("three-*.part/step0")))
    run.send_signal(signal.SIGINT)
    time.sleep(0.5)
    flow.go()
    _, err = run.communicate(timeout=LONGEST)
    assert run.returncode == 130 and err.splitlines()[-1].startswith("stopped"), err
    assert list(flow.ran()) == ["four"] and flow.text("four") == WHOLE


@pytest.mark.slow
def test_two_runs_at_once_the_second_waits_and_finds_all_done(flow):
    first = flow.start(*flow.hold("two"))
    flow.wait_for(lambda: list(flow.store.glob("two-*.part/step0")))
    second = flow.start()
    assert any(holds(line, "waiting", first.pid) for line in second.stderr)
    flow.go()
    _, err = second.communicate(timeout=LONGEST)
    assert second.returncode == 0 and err.count(" cached ") == 4
    _, err = first.communicate(timeout=LONGEST)
    assert first.returncode == 0 and err.count(" done ") == 4
    lines = [json.loads(line) for line in (flow.work / "clip/runs.jsonl").read_text().splitlines()]
    assert [line["stage"] for line in lines] == ALL


@pytest.mark.slow
def test_a_result_that_was_changed_and_has_its_old_size_and_time_is_made_again(made, monkeypatch):
    """The time of its change tells; after a copy, which changes that too, each file is read once."""
    read: list[Path] = []
    digest_of = fingerprint.file_digest
    monkeypatch.setattr(fingerprint, "file_digest", lambda path: read.append(path) or digest_of(path))
    copy = made.copied(made.folder / "copy")
    for place in (made, copy):
        for name in ("two", "four"):
            folder = (place.work / "clip/default" / name).resolve()
            stamp = Stamp.read(folder)
            for times in (1, 0):
                read.clear()
                assert stamp.damage(folder) == "" and len(read) <= times
    file = (made.work / "clip/default/two/out.txt").resolve()
    before, stat = file.read_text(), file.stat()
    file.write_text(before[::-1])
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    ((stage, (reason,)),) = made.ran().items()
    assert stage == "two" and holds(reason, "damaged", "out.txt") and made.text("two") == before


@pytest.mark.slow
def test_damaged_results_are_made_again(made):
    folder = (made.work / "clip/default/two").resolve()
    time_ = (folder / "out.txt").stat().st_mtime_ns
    (folder / "out.txt").write_text("half")
    ((stage, (reason,)),) = made.ran().items()
    assert stage == "two" and holds(reason, "damaged", "out.txt") and "missing" not in reason
    (folder / "out.txt").write_text((folder / "out.txt").read_text())  # same bytes, another time
    assert made.ran() == {} and (folder / "out.txt").stat().st_mtime_ns != time_
    (folder / "out.txt").unlink()
    ((stage, (reason,)),) = made.ran().items()
    assert stage == "two" and holds(reason, "damaged", "out.txt", "missing")
    (folder / "stamp.json").write_text("{")
    assert list(made.ran()) == ["two"]
    assert made.text("four") == WHOLE


@pytest.mark.slow
def test_half_written_part_is_emptied_unless_the_stage_resumes(made):
    for stage in ("two", "three"):
        folder = (made.work / f"clip/default/{stage}").resolve()
        part = folder.with_name(folder.name + ".part")
        folder.rename(part)
        (part / "step0").write_text("")
        (part / "rubbish").write_text("")
    assert list(made.ran()) == ["two", "three", "four"]  # what three kept is new content for four
    assert not (made.work / "clip/default/two/rubbish").exists()
    assert (made.work / "clip/default/three/rubbish").exists()


@pytest.mark.slow
def test_a_run_killed_when_a_result_was_whole_and_had_no_name_keeps_it(made):
    for stage in ("two", "three"):
        folder = (made.work / f"clip/default/{stage}").resolve()
        folder.rename(folder.with_name(folder.name + ".part"))
    assert made.ran() == {} and made.text("four") == WHOLE


@pytest.mark.slow
@pytest.mark.parametrize("deep", [False, True])
def test_nothing_is_written_through_the_links_of_a_part_that_somebody_else_left(made, deep):
    """The log of a stage is added to; a work folder from elsewhere may have a link there, or in the part's own place."""
    precious = made.folder / "precious"
    precious.mkdir()
    (precious / "log.txt").write_text("precious")
    for stage in ("two", "three"):
        folder = (made.work / f"clip/default/{stage}").resolve()
        part = folder.with_name(folder.name + ".part")
        shutil.rmtree(folder)
        part.mkdir() if deep else part.symlink_to(precious)
        if deep:
            (part / "log.txt").symlink_to(precious / "log.txt")
    assert list(made.ran()) == ["two", "three"]
    assert (precious / "log.txt").read_text() == "precious" and len(list(precious.iterdir())) == 1


@pytest.mark.slow
def test_force_discards_what_a_stage_would_go_on_from(made):
    """A checkpoint may be what is broken."""
    folder = (made.work / "clip/default/three").resolve()
    part = folder.with_name(folder.name + ".part")
    part.mkdir()
    (part / "step0").write_text("")
    (part / "rubbish").write_text("")
    assert made.ran("three", "--force") == {"three": ["forced"]}
    assert not (made.work / "clip/default/three/rubbish").exists()


@pytest.mark.slow
def test_a_stage_error_is_told_without_a_traceback_and_a_bug_with_one(flow):
    flow.edit("two", "from flow import helper", "from stages.contract import StageError\n    raise StageError("
              "'only 41 of 300 frames placed', 'try `--set two.word=b`', ['median 38 matches'])")  # fmt: skip
    out, err = flow.hugs(code=1)
    assert out == ""
    assert holds(err, "error", "41 of 300", "38", "hint", "--set two.word=b")
    assert "Traceback" not in err and "  two      failed" in err
    flow.edit("two", "raise StageError(", "print('seen'); 1 / 0; StageError(")
    _, err = flow.hugs(code=1)
    assert "Traceback" in err and holds(err, "error", "two", "bug", "ZeroDivisionError", "division by zero")
    assert "seen" in next(flow.store.glob("two-*.part/log.txt")).read_text()
    assert (flow.work / "clip/default/one").is_dir()


@pytest.mark.slow
def test_a_stage_that_writes_nothing_or_dies_early_is_an_error(flow):
    flow.edit("two", "helper.work(", "return (")
    _, err = flow.hugs(code=1)
    assert holds(err, "error", "two", "bug", "no file")
    flow.edit("two", "from flow import helper", "import os; os._exit(3)")
    _, err = flow.hugs(code=1)
    assert holds(err, "error", "two", "exit code 3")
    flow.edit("two", "import os; os._exit(3)", "import os; os.abort()")
    _, err = flow.hugs(code=1)
    assert holds(err, "error", "two", "SIGABRT")


@pytest.mark.slow
def test_a_worker_that_a_stage_leaves_behind_does_not_hold_the_run(flow):
    line = "import os, time\n    if os.fork() == 0:\n        time.sleep(60)\n        os._exit(0)\n    "
    flow.edit("four", "from flow import helper", line + "from flow import helper")
    flow.hugs()
    assert flow.text("four") == WHOLE


@pytest.mark.slow
def test_status_why_and_dry_run_say_what_would_run(flow):
    out, _ = flow.hugs(command="status")
    assert [line.split()[:2] for line in out.splitlines()] == [[name, "missing"] for name in ALL]
    assert not flow.work.exists()
    flow.hugs()
    flow.edit("two", '"two"', '"zwei"')
    out, _ = flow.hugs("--dry-run")
    *rows, last = out.splitlines()
    assert holds(last, "takes about")
    states = {line.split()[0]: line.split()[1] for line in rows}
    assert states == {"one": "fresh", "two": "stale", "three": "fresh", "four": "waits"}
    out, _ = flow.hugs("two", "--set", "two.word=b", command="why")
    assert holds(out, "two", "would run", "last result")
    assert holds(out, "code", "flow.two", "edited")
    assert "  params   word                   a -> b" in out
    assert holds(out, "one", 0, "settings", 2, "modules")
    out, _ = flow.hugs("one", command="why")
    assert out.startswith("one is fresh (")
    rows = json.loads(flow.hugs("--json", command="status")[0])
    assert [(row["stage"], row["state"]) for row in rows] == list(states.items())


@pytest.mark.slow
def test_accept_takes_code_changes_and_nothing_else(made):
    made.hugs("--pipeline", "other")
    made.edit("helper", "count = len(", "count = 0 + len(")
    out, _ = made.hugs("two", command="accept")
    assert holds(out, "two", "not accepted", "code flow.helper", "edited", "one")
    out, _ = made.hugs(command="accept")
    assert out.count("accepted: ") == 4 and "code flow.helper edited" in out
    assert made.ran() == {}
    assert made.ran("--pipeline", "other") == {"four": ["code flow.helper edited"]}
    out, _ = made.hugs("--set", "two.word=b", "two", command="accept")
    assert out.count("\n") == 1 and holds(out, "two", "not accepted", "params.word", "a", "b")
    stamp = json.loads((made.work / "clip/default/one/stamp.json").read_text())
    assert stamp["accepted"][0]["changes"] == ["code flow.helper edited"]


@pytest.mark.slow
def test_gc_removes_what_nothing_links_to(made):
    made.hugs("--set", "four.word=b")
    made.hugs("--pipeline", "other")
    (made.store / "two-00000000.part").mkdir()
    kept = {p.name for p in made.store.iterdir()}
    out, _ = made.hugs("--dry-run", command="gc")
    assert out.count("would remove") == 2 and {p.name for p in made.store.iterdir()} == kept
    out, _ = made.hugs(command="gc")
    assert out.count("removed") == 2
    assert made.ran("--set", "four.word=b") == {}
    assert made.ran("--pipeline", "other") == {}
    assert made.ran() == {"four": ["params.word: b -> a"]}


def test_runs_are_logged_with_cost_and_machine(flow):
    flow.hugs("one")
    (line,) = map(json.loads, (flow.work / "clip/runs.jsonl").read_text().splitlines())
    assert line["stage"] == "one" and line["result"] == "done" and line["reasons"] == ["first run"]
    assert line["seconds"] > 0 and line["peak_memory_bytes"] > 1e6
    stamp = json.loads((flow.work / "clip/default/one/stamp.json").read_text())
    assert stamp["machine"]["device"] == "cpu" and "python" in stamp["machine"]["versions"]
    assert (flow.work / "clip/default/one/log.txt").exists()


def written_by_older_code(flow) -> None:
    """Rewrite all stamps as older code left them: other modules, and a stage that read one input more."""
    for stage in ALL:
        link = flow.work / "clip/default" / stage
        stamp = json.loads((link / "stamp.json").read_text())
        stamp["code"] = {"flow.long_gone": "0" * 64, f"flow.{stage}": "1" * 64}
        if stage == "four":
            stamp["inputs"]["one"] = "2" * 64
        recipe = [stamp[name] for name in ("stage", "seed", "code", "params", "inputs")]
        stamp["key"] = digest(recipe)
        (link / "stamp.json").write_text(json.dumps(stamp))
        folder = link.resolve()
        link.unlink()
        link.symlink_to(f"../store/{stage}-{stamp['key'][:8]}")
        folder.rename(folder.with_name(f"{stage}-{stamp['key'][:8]}"))


@pytest.mark.slow
def test_results_of_older_code_are_kept_as_they_are(made):
    written_by_older_code(made)
    before = {path.stat().st_ino for path in made.store.glob("*/out.txt")}
    out, _ = made.hugs(command="accept")
    assert out.count(" accepted: ") == 4 and "four accepted" in out and holds(out, "inputs.one", "no longer read")
    assert made.ran() == {} and made.text("four") == WHOLE
    assert before == {path.stat().st_ino for path in made.store.glob("*/out.txt")}, "nothing was made again"
    assert len(before) == 4
    stamp = json.loads((made.work / "clip/default/four/stamp.json").read_text())
    assert list(stamp["inputs"]) == ["three", "two"]


@pytest.mark.slow
def test_an_input_that_was_given_and_is_not_any_more_is_no_change_of_code(flow):
    (flow.folder / "masks.txt").write_text("m")
    flow.hugs("--masks", "masks.txt")
    assert holds(flow.hugs("three", command="accept")[0], "three", "fresh")
    (flow.work / "clip/default/options.json").unlink()
    out, _ = flow.hugs("three", command="accept")
    assert out.count("\n") == 1 and holds(out, "three", "not accepted", "inputs.mask_files", "gone")


@pytest.mark.slow
def test_a_run_says_how_to_keep_results_where_only_code_changed(flow):
    hint = "`hugs accept clip.mp4`"
    assert hint not in flow.hugs()[1]
    flow.edit("helper", "count = len(", "count = 0 + len(")
    err = flow.hugs()[1]
    assert hint in err and err.index(hint) < err.index(" done ")
    flow.edit("helper", "count = 0 + len(", "count = len(")
    assert hint not in flow.hugs("--force")[1]
    flow.edit("two", "helper.work(", "helper.x = 1; helper.work(")
    assert hint not in flow.hugs("--set", "two.word=b")[1]
    flow.hugs("--pipeline", "other")
    flow.edit("four", "helper.work(", "helper.x = 1; helper.work(")
    assert "`hugs accept clip.mp4 --pipeline other`" in flow.hugs("--pipeline", "other")[1]


@pytest.mark.slow
def test_a_stage_is_handed_the_records_of_all_stages_before_it(flow):
    line = "import dataclasses, json; (job.out / 'up.json').write_text(json.dumps("
    line += "{name: dataclasses.asdict(one) for name, one in job.upstream.items()})); helper.work("
    flow.edit("four", "helper.work(", line)
    flow.edit("one", "helper.work(", "job.warn('dark'); job.note('40 frames'); helper.work(")
    for _ in range(2):  # the second time from the cache
        flow.hugs("four")
        found = json.loads((flow.work / "clip/default/four/up.json").read_text())
        assert list(found) == ["one", "two", "three"]
        assert found["one"]["warnings"] == ["dark"] and "40 frames" in found["one"]["notes"]
        assert all(one["seconds"] > 0 and one["peak_memory_bytes"] > 1e6 for one in found.values())
        flow.edit("four", "helper.work(", "helper.x = 1; helper.work(")
