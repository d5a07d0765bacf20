"""Every dependency that is declared has a lower bound that `make lowest` installs."""

import tomllib

from tests.tools.lowest import KEPT, ROOT, bounds


def test_every_dependency_has_a_bound():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    found = bounds(declared)
    assert len(found) == len(declared) - len(KEPT) and found["av"] == "17" and all(found.values())
