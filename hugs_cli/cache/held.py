"""A clip while one run works on it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass

from hugs_cli.cache.freshness import Session
from hugs_cli.cache.launcher import Launcher
from hugs_cli.cache.report import Report, reporting
from hugs_cli.console import Console


@dataclass(frozen=True)
class Held:
    """A clip that nobody else works on: what runs its stages, and the page that grows meanwhile, if there is one."""

    launcher: Launcher
    page: Report | None

    def end(self, session: Session) -> None:
        """Make the page as it stays, of all fresh results of a session."""
        if self.page:
            self.page.end(session)


@contextmanager
def holding(session: Session, wanted: list[str], console: Console, report: bool) -> Iterator[Held]:
    """Keep the clip of a session to oneself. `report`: the wanted stages, in running order, are shown on a page."""
    made_by = session.pipeline.report
    with (
        session.workspace.lock(console.waiting) as lock,
        closing(Launcher(lock)) as launcher,
        reporting(session, made_by, wanted, lock) if report and made_by else nullcontext() as page,
    ):
        session.workspace.keep_options(session.options)
        yield Held(launcher, page)
