"""`hugs view`: which page it opens, and what it says where there is none."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path

import pytest

from hugs_cli.app import main
from hugs_cli.cache.fingerprint import content_digest
from hugs_cli.cache.workspace import Stamp
from tests.made.said import holds


@pytest.fixture
def hugs(tmp_path, monkeypatch, capsys):
    """Runs `hugs view ...` beside a clip whose export is finished: its exit code, stdout and stderr."""
    (tmp_path / "my dance.mp4").write_text("pixels")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("signal.signal", lambda number, handler: None)  # Ctrl-C stays pytest's

    def run(*args: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["hugs", "view", *args])
        with pytest.raises(SystemExit) as end:
            main()
        return int(end.value.code or 0), *capsys.readouterr()

    return run


@pytest.fixture
def page(tmp_path) -> Path:
    """The page of a finished export."""
    links = tmp_path / "work/my dance/default"
    stored = tmp_path / "work/my dance/store/export-01234567"
    stored.mkdir(parents=True)
    links.mkdir()
    (stored / "viewer.html").write_text("<!doctype html>")
    (links / "export").symlink_to("../store/export-01234567")
    film = {"video": content_digest(tmp_path / "my dance.mp4")}
    made_of = {"seed": 0, "code": {}, "params": {}, "inputs": film, "content": "", "files": {}, "seconds": 1.0}
    machine = {"host": "h", "device": "cpu", "system": "s", "processors": 1, "versions": {}}
    made_by = {"made": "2026-01-01T00:00:00+00:00", "peak_memory_bytes": 0, "machine": machine}
    Stamp("export", "", **made_of, **made_by).write(stored)
    return links / "export" / "viewer.html"


@pytest.fixture
def opened(monkeypatch) -> list[str]:
    """What the default browser was asked to open."""
    asked: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: bool(asked.append(address) or True))
    return asked


def test_the_page_is_opened_and_named(hugs, page, opened):
    code, out, _ = hugs("my dance.mp4")
    assert code == 0 and len(opened) == 1
    assert Path(out.strip()).resolve() == page.resolve()
    assert opened[0].startswith("file:///") and " " not in opened[0] and opened[0].endswith("/viewer.html")


def test_it_is_only_named_if_so_wished(hugs, page, opened):
    code, out, _ = hugs("my dance.mp4", "--no-open")
    assert code == 0 and opened == []
    assert Path(out.strip()).absolute() == page.absolute(), "it stays where the store changes"


def test_a_machine_without_a_browser_says_so(hugs, page, monkeypatch):
    monkeypatch.setattr(webbrowser, "open", lambda address: False)
    code, out, said = hugs("my dance.mp4")
    assert code == 0 and out.strip().endswith("viewer.html") and "no browser" in said


def test_an_export_without_the_page_says_how_to_get_it(hugs, page, opened):
    page.resolve().unlink()
    code, _, said = hugs("my dance.mp4", "--pipeline", "default")
    assert code == 2 and holds(said, "error", "viewer.html", "hint", "`hugs run 'my dance.mp4' export`")
    assert opened == []


def test_a_clip_that_never_ran_says_so(hugs):
    code, _, said = hugs("my dance.mp4")
    assert code == 2 and holds(said, "error", "export", "my dance.mp4", "hint", "`hugs run 'my dance.mp4'`")
