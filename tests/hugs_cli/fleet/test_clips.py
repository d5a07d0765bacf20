"""Clips from paths, patterns, lists and tables, and names that collide."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hugs_cli.fleet.clips import Row, read, work_folders
from hugs_cli.pipelines import UsageError
from tests.made.said import holds


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """A folder with clips of the same name in two others."""
    monkeypatch.chdir(tmp_path)
    for name in ("mon/dance.mp4", "tue/dance.mp4", "tue/jump.mp4", "tue/jump.mov"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(name)
    return tmp_path


def rows(*given: str, pipeline: str = "default", settings: tuple[str, ...] = ()):
    return read(given, pipeline, settings, Path("work"))


def test_patterns_and_paths_give_each_clip_once(here):
    found = rows("mon/*.mp4", "mon/dance.mp4", "tue/*.mov")
    assert [str(row.video) for row in found] == ["mon/dance.mp4", "tue/jump.mov"]
    with pytest.raises(UsageError, match="no clip fits"):
        rows("wed/*.mp4")
    assert rows("not-there.mp4")[0].name == "not-there"  # said when it is planned, for it hurts no other


def test_names_that_collide_get_folders_of_their_own(here):
    found = rows("mon/dance.mp4", "tue/dance.mp4", "tue/jump.mp4", "tue/jump.mov")
    assert [row.root.as_posix() for row in found] == [
        "work/dance",
        "work/from-tue/dance",
        "work/jump",
        "work/from-tue/jump",
    ]
    assert len({row.id for row in found}) == 4


def test_a_clip_keeps_the_folder_that_has_its_results(here):
    for video, root in (("tue/dance.mp4", "work/dance"), ("mon/dance.mp4", "work/from-mon/dance")):
        (here / root).mkdir(parents=True)
        (here / root / "sources.json").write_text(json.dumps({"video": {"path": str(here / video)}}))
    found = {str(row.video): row.root.as_posix() for row in rows("mon/dance.mp4", "tue/dance.mp4")}
    assert found == {"tue/dance.mp4": "work/dance", "mon/dance.mp4": "work/from-mon/dance"}
    assert rows("mon/dance.mp4")[0].root.as_posix() == "work/from-mon/dance"
    (here / "tue/dance.mp4").rename(here / "dance.mp4")  # moved: its results go with it
    assert rows("dance.mp4")[0].root.as_posix() == "work/dance"


@pytest.mark.parametrize("again", ["{here}/mon/dance.mp4", "./mon/dance.mp4", "tue/../mon/dance.mp4", "mon//dance.mp4"])
def test_a_clip_by_two_names_is_one_and_with_two_settings_refused(here, again):
    again = again.format(here=here)
    (here / "list.txt").write_text(f"mon/dance.mp4\n{again}\n")
    for given in ((("mon/dance.mp4", again),), ("list.txt",)):
        assert len(rows(*(given[0] if isinstance(given[0], tuple) else given))) == 1
    (here / "twice.csv").write_text(f"clip,settings\nmon/dance.mp4,\n{again},train.steps=1\n")
    with pytest.raises(UsageError, match=r"dance\.mp4.*twice.*default"):
        rows("twice.csv")
    for name in ("m1", "m2"):
        (here / name).mkdir()
    (here / "masks.csv").write_text(f"clip,masks\nmon/dance.mp4,m1\n{again},{here}/m1\n")
    assert len(rows("masks.csv")) == 1
    (here / "masks.csv").write_text(f"clip,masks\nmon/dance.mp4,m1\n{again},{here}/m2\n")
    with pytest.raises(UsageError, match=r"dance\.mp4.*twice.*default"):
        rows("masks.csv")


def test_ids_of_many_clips_in_any_script_are_all_their_own_and_fit_into_a_file_name():
    letters = [chr(0x4E00 + number) for number in range(10_000)]
    many = [
        Row(Path("".join(letters[number : number + 6]) + ".mp4"), Path("work"), "default") for number in range(9_990)
    ]
    assert len({row.id for row in many}) == len(many)
    assert letters[0] in many[0].id and Row(Path("a b/c#d.mp4"), Path("w"), "p").id.startswith("c_d.p.")
    assert all(
        len(f"{row.id}.before.log".encode()) < 255 for row in (*many, Row(Path("\U00020000" * 200), Path("w"), "p"))
    )


def test_clips_of_one_name_below_folders_of_any_script_each_get_a_folder(here):
    places = ["\u6708", "\u706b", "\u6c34", "\u6728", "a?", "a*", "a|", "x" * 250, "\u6708" * 80]
    for place in places:
        for ending in ("mp4", "mov"):
            Path(place).mkdir(exist_ok=True)
            Path(place, f"dance.{ending}").write_text(place)
    found = rows(*(f"{place}/dance.{ending}" for place in places for ending in ("mp4", "mov")))
    roots = {str(row.root) for row in found}
    assert len(roots) == len(found) == 18 and "work/from-\u706b/dance" in roots
    assert all(len(part.encode()) < 255 for root in roots for part in root.split("/"))


def test_who_has_results_keeps_their_folder_whoever_is_named_first(here):
    """Also where the other's would be put there, for it has none yet."""
    (here / "work/dance").mkdir(parents=True)
    entry = {"video": {"path": str(here / "tue/dance.mp4")}}
    (here / "work/dance/sources.json").write_text(json.dumps(entry))
    for given in (("mon/dance.mp4", "tue/dance.mp4"), ("tue/dance.mp4", "mon/dance.mp4")):
        roots = {str(row.video): row.root.as_posix() for row in rows(*given)}
        assert roots == {"tue/dance.mp4": "work/dance", "mon/dance.mp4": "work/from-mon/dance"}


def test_a_clip_keeps_a_folder_of_its_own_though_the_plain_one_is_free(here):
    (here / "work/from-tue/dance").mkdir(parents=True)
    entry = {"video": {"path": str(here / "tue/dance.mp4")}}
    (here / "work/from-tue/dance/sources.json").write_text(json.dumps(entry))
    assert [row.root.as_posix() for row in rows("tue/dance.mp4")] == ["work/from-tue/dance"]


def test_clips_that_differ_in_their_ending_alone_have_a_folder_each():
    found = list(work_folders(Path("work"), Path("/a/jump.mov")))
    assert found[:3] == [Path("work"), Path("work/from-a"), Path("work/from-a-mov")]


def test_a_list(here):
    (here / "mon/list.txt").write_text("# monday\n\ndance.mp4\n../tue/jump.mp4\n")
    assert [str(row.video) for row in rows("mon/list.txt")] == ["mon/dance.mp4", "mon/../tue/jump.mp4"]


@pytest.mark.parametrize("kind", ["csv", "yaml"])
def test_a_table(here, kind):
    text = {
        "csv": "\ufeffclip,pipeline,settings,masks,fit,person\ndance.mp4,draft,train.steps=8; frames.count=9,m,,2\njump.mp4,,,,,\n",
        "yaml": "- {clip: dance.mp4, pipeline: draft, settings: [train.steps=8, frames.count=9], masks: m, person: 2}\n"
        "- clip: jump.mp4\n",
    }[kind]
    Path(f"tue/clips.{kind}").write_text(text, encoding="utf-8")
    first, second = rows(f"tue/clips.{kind}", pipeline="ci", settings=("train.human_points=7000",))
    assert (first.pipeline, second.pipeline) == ("draft", "ci")
    assert (
        first.settings == ("train.human_points=7000", "train.steps=8", "frames.count=9")
        and second.settings == first.settings[:1]
    )
    assert (str(first.masks), first.fit, first.person) == ("tue/m", None, "2")


@pytest.mark.parametrize(
    ("name", "text", "facts"),
    [
        ("t.csv", "clip,pipelin\na.mp4,x\n", ("t.csv", "column", "pipelin")),
        ("t.csv", "pipeline\nx\n", ("t.csv", "clip 1", "no clip")),
        ("t.csv", 'clip\n"a\n', ("t.csv", "CSV")),
        ("t.yaml", "clip: a.mp4\n", ("t.yaml", "list", "clips")),
        ("t.yaml", "- {clip: [a, b]}\n", ("t.yaml", "clip", "text")),
        ("t.yaml", "- {clip: a, settings: {a: 1}}\n", ("t.yaml", "settings")),
        ("t.yaml", "- {clip: a\n", ("t.yaml", "YAML")),
        ("t.txt", None, ("t.txt",)),
        ("t.csv", "clip,settings\na.mp4,train.steps=1\na.mp4,train.steps=2\n", ("a.mp4", "twice", "default")),
        ("t.csv", "clip\n../../../../../../..\n", ("clip 1", "named")),
    ],
)
def test_what_cannot_be_understood_is_refused(here, name, text, facts):
    if text is not None:
        Path(name).write_text(text)
    with pytest.raises(UsageError) as refused:
        rows(name)
    assert holds(str(refused.value), *facts)


def test_a_table_of_many_clips(here):
    Path("t.yaml").write_text(
        "".join(f"- {{clip: c{i}.mp4, pipeline: draft, settings: [a.b=1]}}\n" for i in range(1300))
    )
    assert len(rows("t.yaml")) == 1300
