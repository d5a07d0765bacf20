"""make lowest: the tests of films, masks and the pipeline `ci` with the oldest version of each dependency that is allowed.

They are installed in build/lowest; what pyproject.toml does not name, and torch, comes from the environment that runs this.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).parents[2]
KEPT = ("torch",)  # no CPU build of its oldest version is to be had
TESTS = ("tests/stages/formats/test_video.py", "tests/stages/formats/test_film_pixels.py", "tests/stages/formats/test_images.py",
         "tests/stages/test_frames.py", "tests/stages/test_masks.py", "tests/stages/estimators/person/test_given.py",
         "tests/stages/formats/given_masks", "tests/hugs_cli/test_doctor.py", "tests/test_end_to_end.py")  # fmt: skip


def bounds(requirements: list[str]) -> dict[str, str]:
    """Name -> lower bound of each requirement, without those that are kept."""
    found = dict(re.match(r"([A-Za-z0-9_-]+)>=([0-9.]+)", entry).groups() for entry in requirements)
    return {name: bound for name, bound in found.items() if name not in KEPT}


def versions(pip: list[str], name: str, bound: str) -> str:
    """The oldest version of a package that is not below a bound."""
    told = subprocess.run([*pip, "index", "versions", name], capture_output=True, text=True, check=True).stdout
    every = re.search(r"Available versions: (.*)", told)[1].split(", ")
    number = lambda text: [int(part) for part in re.findall("[0-9]+", text)]  # noqa: E731
    return min((one for one in every if number(one) >= number(bound)), key=number)


def main() -> None:
    """Install and test; exits as pytest does."""
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    folder = ROOT / "build" / "lowest"
    venv.create(folder, with_pip=True, clear=not (folder / "bin" / "python").exists())
    python = str(folder / "bin" / "python")
    pip = [python, "-m", "pip", "--disable-pip-version-check"]
    pins = [f"{name}=={versions(pip, name, bound)}" for name, bound in bounds(declared).items()]
    print("\n".join(pins), flush=True)
    subprocess.run([*pip, "install", "--quiet", *pins], check=True)
    site = next((folder / "lib").glob("python*/site-packages"))
    own = next(path for path in sys.path if path.endswith("site-packages"))
    (site / "zz_rest.pth").write_text(f"{own}\n")  # searched last
    sys.exit(subprocess.run([python, "-m", "pytest", "-q", *TESTS], cwd=ROOT).returncode)


if __name__ == "__main__":
    main()
