"""The command that opens the page of a result: view."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

from typer import Option

from hugs_cli import options, words
from hugs_cli.app_draw import finished
from hugs_cli.console import Console
from hugs_cli.options import AnyPipeline, Work, pipeline_of
from hugs_cli.pipelines import UsageError

PAGE = "viewer.html"


def view(
    video: options.Video,
    open_: Annotated[
        bool, Option("--open/--no-open", help="Open it in the default browser, or only say where it is.")
    ] = True,
    pipeline: AnyPipeline = None,
    work: Work = Path("work"),
) -> None:
    """Open the page on which person and scene move.

    It is one file that needs no network. The line on stdout is its path.
    """
    console = Console()
    pipeline = pipeline_of(video, work, pipeline, console, "export")
    (folder,) = finished(video, work, pipeline, "export")
    page = folder / PAGE
    if not page.is_file():
        command = words.command("run", video, "export", pipeline=pipeline, work=work)
        facts = ["it was written without `viewer` in `export.formats`, or by a hugs that had no page"]
        raise UsageError(f"the export of {video.name} holds no {PAGE}", f"`{command}`", facts)
    if open_ and not webbrowser.open(page.absolute().as_uri()):
        console.say("no browser was found to open it with")
    console.result(words.relative(page))
