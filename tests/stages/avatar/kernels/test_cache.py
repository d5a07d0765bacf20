"""Where compiled kernels lie: Numba unpickles them, so only where nobody else could have put them."""

from __future__ import annotations

import importlib
import inspect
import os
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from stages.avatar import compiled
from stages.avatar.kernels import cache

ROOT = os.geteuid() == 0


def theirs(place: Path) -> None:
    place.mkdir(parents=True)
    os.chown(place, 65534, 65534)


def open_to(mode: int) -> Callable[[Path], None]:
    def make(place: Path) -> None:
        place.mkdir(parents=True)
        place.chmod(mode)

    return make


def link(place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    (place.parent / "elsewhere").mkdir(exist_ok=True)
    place.symlink_to("elsewhere")


def file(place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text("")


HOWS = {"of the group": open_to(0o775), "of all": open_to(0o777), "sticky": open_to(0o1777), "file": file, "link": link}
HOWS |= {"another's": theirs} if ROOT else {}


@pytest.fixture
def roots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """The user's cache, and the folder that is taken where that may not be."""
    for folder in ("home", "temporary"):
        (tmp_path / folder).mkdir()
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path / "home/hugs"))
    monkeypatch.setattr(cache.tempfile, "tempdir", str(tmp_path / "temporary"))
    return tmp_path / "home/hugs", tmp_path / f"temporary/hugs-{os.getuid()}"


def only_ours(place: Path) -> bool:
    info = os.lstat(place)
    return stat.S_ISDIR(info.st_mode) and info.st_uid == os.getuid() and not info.st_mode & 0o022


def test_the_users_cache_is_taken_again_and_again(roots):
    place = cache.folder()
    assert place.parent.parent == roots[0] and cache.folder() == place
    assert all(stat.S_IMODE(os.lstat(one).st_mode) == 0o700 for one in (place, place.parent, roots[0]))


@pytest.mark.parametrize("how", HOWS)
@pytest.mark.parametrize("deep", [0, 1, 2])
def test_a_folder_that_another_could_have_filled_is_left_alone(roots, how, deep):
    """At each of its three levels; the user's own cache may be a link of theirs."""
    home, temporary = roots
    place = cache.folder()
    digest, level = place.name, (home, home / "kernels", place)[deep]
    os.rename(level, level.with_name("aside"))
    HOWS[how](level)
    fine = (how, deep) == ("link", 0)
    assert (cache.folder().parent.parent == home) == fine
    if fine:
        return
    assert cache.folder() == temporary / "kernels" / digest and only_ours(cache.folder())
    level = (temporary, temporary / "kernels", temporary / "kernels" / digest)[deep]
    os.rename(level, level.with_name("aside"))
    HOWS[how](level)
    own = cache.folder()
    assert home not in own.parents and temporary not in own.parents and cache.folder() != own
    assert only_ours(own) and not list(own.iterdir())


def test_no_kernel_has_an_array_as_a_default_which_numba_takes_for_another_one_in_every_process():
    """It compiled `cast` again whenever a synthetic clip was made: 9 s."""
    files = [file.relative_to(compiled.HOUSE.parents[1]).with_suffix("") for file in compiled.sources()]
    modules = [importlib.import_module(".".join(file.parts)) for file in files if file.name != "__init__"]
    kernels = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    assert len(kernels) > 20
    defaults = [
        parameter.default for one in kernels for parameter in inspect.signature(one.py_func).parameters.values()
    ]
    assert not any(isinstance(value, np.ndarray) for value in defaults)
