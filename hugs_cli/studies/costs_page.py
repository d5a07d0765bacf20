"""The comparison of `hugs costs` as a plot and as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hugs_cli.direct import run_directly
from hugs_cli.studies.comparison import REGIONS, measured
from hugs_cli.studies.costs import table
from stages.contract import Job


def write(folder: Path, name: str, title: str, result: dict[str, Any]) -> Path:
    """Write NAME.svg, NAME.png and NAME.html into the folder; returns the path of the page."""
    regions = {region: REGIONS[region] for region in measured([row["scores"] for row in result["rows"]])}
    inputs = {"result": result, "regions": regions, "table": table(result)}
    run_directly("stages.commands.costs_page", Job(folder), {"name": name, "title": title}, **inputs)
    return folder / f"{name}.html"
