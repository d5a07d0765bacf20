"""The kernels whatever the machine: threads, processors, a cache folder that cannot be written, dtypes."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from stages.avatar.kernels import cache
from stages.avatar.rasterize import Camera, Gaussians, cpu, gaussian_axes, rasterize
from tests.made.rasterized import HEIGHT, PICTURE, WIDTH, apart, camera, cast, draw, gaussians, show


def test_the_number_of_threads_changes_no_pixel():
    parts = gaussians(2000)
    view, K = camera(150, 110)
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            results.append([draw(cpu, parts, view, K, 150, 110) for _ in range(2)])
    finally:
        torch.set_num_threads(threads)
    (first, first_grads), _ = results[0]
    for (one, grads), (again, again_grads) in results:
        assert all(torch.equal(getattr(one, name), getattr(first, name)) for name in PICTURE)
        assert torch.equal(one.image, again.image), "a run repeats to the bit"
        assert all(torch.equal(a, b) for a, b in zip(grads[:5], again_grads[:5])), "so do its gradients"
        assert all(apart(a, b) < 3e-6 for a, b in zip(grads, first_grads))


def test_the_front_door_sends_each_dtype_to_its_maker():
    parts = gaussians(50)
    view, K = camera()
    fast, true = (
        rasterize(Gaussians(p[0], gaussian_axes(*p[1:3]), *p[3:]), Camera(view, K, 61, 45).to(p[0]))[0]
        for p in (parts, cast(parts))
    )
    assert (fast.image.dtype, true.image.dtype) == (torch.float32, torch.float64)
    assert (fast.image - true.image).abs().max() < 1 / 255
    assert apart(fast.means2d, true.means2d) < 1e-6


SAME = """
import sys, torch
sys.path[:0] = {path!r}
from tests.made.rasterized import HEIGHT, WIDTH, camera, gaussians, show
from stages.avatar.rasterize import cpu
drawn = show(cpu, gaussians(), *camera(), WIDTH, HEIGHT)
torch.save([drawn.image, drawn.alpha], sys.argv[1])
"""


@pytest.mark.slow
def test_an_older_processor_without_a_cache_folder_draws_the_same(tmp_path):
    """No 512-bit vectors, and a home that cannot be written, where the machine's temporary folder takes its place. The picture
    alone: to compile its gradients too takes as long again."""
    root, blocked = str(Path(__file__).parents[4]), tmp_path / "file"
    blocked.write_text("")
    environment = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "", "HUGS_CACHE": str(blocked)}
    command = [sys.executable, "-c", SAME.format(path=[root]), str(tmp_path / "out.pt")]
    subprocess.run(command, env={**os.environ, **environment}, check=True, timeout=300)
    here = show(cpu, gaussians(), *camera(), WIDTH, HEIGHT)
    image, alpha = torch.load(tmp_path / "out.pt")
    assert here.alpha.max() > 0.5 and torch.equal(here.image, image) and torch.equal(here.alpha, alpha)


def test_kernels_of_older_sources_are_removed_when_nobody_has_used_them_for_a_month(tmp_path, monkeypatch):
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path))
    own = cache.folder()
    others = {name: own.parent / name for name in ("older", "recent")}
    for days, place in zip((31, 29), others.values()):
        (place / "rasterize").mkdir(parents=True)
        (place / "rasterize" / "blend.nbi").write_text("")
        os.utime(place, (time.time() - days * 86400,) * 2)
    (own / "kernels.nbi").write_text("ours")
    os.utime(own, (0, 0))
    assert cache.folder() == own and (own / "kernels.nbi").exists() and time.time() - own.stat().st_mtime < 3600
    assert not others["older"].exists() and others["recent"].is_dir()


def test_two_processes_remove_the_same_folder(tmp_path, monkeypatch):
    (tmp_path / "older").mkdir()
    remove = shutil.rmtree
    monkeypatch.setattr(shutil, "rmtree", lambda *a, **more: (remove(*a), remove(*a, **more)))
    cache.tidy(tmp_path, time.time() + 1)
    assert list(tmp_path.iterdir()) == []
