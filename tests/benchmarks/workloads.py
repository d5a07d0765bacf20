"""What the benchmarks draw: random Gaussians, a published scene, and the result of a pipeline."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.rotations import quat_from_matrix
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats, spacing
from stages.filming.clip_cast import completed
from stages.formats.clip import Clip, load_clip
from stages.formats.effects import read_effects
from stages.formats.poses import read_poses
from stages.formats.splats import read_avatar, read_scene
from tests.benchmarks.naive import Workload, covariances
from tests.made.learned import Learned, Pose, load_learned

FAINTEST = 1 / 255  # where a Gaussian ends: of the workload, which must not change with the code
SIZES = (1.0, 4.0, 12.0)  # of small, medium and large Gaussians
SHARES = (0.8, 0.17, 0.03)


def random_work(count: int, width: int, height: int, layers: float, needles: bool = False, seed: int = 0) -> Workload:
    """Anisotropic Gaussians, most of them small, that cover each pixel about `layers` times; needles are 100 to 1."""
    g = torch.Generator().manual_seed(seed)
    focal, depth = 0.9 * max(width, height), 2 + 8 * torch.rand(count, generator=g)
    size = torch.tensor([width, height])
    means = (torch.rand(count, 2, generator=g) - 0.5) * size / focal * depth[:, None]
    kinds = torch.tensor(SIZES)[torch.multinomial(torch.tensor(SHARES), count, replacement=True, generator=g)]
    shape = torch.exp(0.5 * torch.randn(count, 3, generator=g))
    if needles:
        shape = torch.tensor([10.0, 0.1, 0.1]).repeat(count, 1)
    pixels = kinds[:, None] * shape * depth[:, None] / focal  # one pixel wide times kind and shape
    opacities = 0.05 + 0.94 * torch.rand(count, generator=g)
    parts = (torch.cat([means, depth[:, None]], 1), torch.randn(count, 4, generator=g), pixels, opacities)
    parts += (torch.rand(count, 3, generator=g),)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    work = Workload(parts, Camera(torch.eye(4), K, width, height), torch.rand(height, width, 3, generator=g))
    low, high = 1e-3, 1e2
    for _ in range(20):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if _layers(_scaled(work, middle)) > layers else (middle, high)
    return _scaled(work, low)


def _scaled(work: Workload, factor: float) -> Workload:
    means, quats, scales, *rest = work.parts
    return work._replace(parts=(means, quats, factor * scales, *rest))


def _layers(work: Workload) -> float:
    """Mean number of Gaussians at a pixel, those hidden behind others included."""
    xx, xy, yy = covariances(work)[2].unbind(1)
    cut = 2 * (work.parts[3] / FAINTEST).log()
    return (torch.pi * (xx * yy - xy * xy).sqrt() * cut).sum().item() / (work.camera.width * work.camera.height)


def garden_works(path: Path, seed: int = 0) -> dict[str, Workload]:
    """The points of an npz (means3d, colors, viewmats, Ks, width, height) as round Gaussians, one workload a camera."""
    g = torch.Generator().manual_seed(seed)
    with np.load(path) as arrays:
        means, colors, views, Ks = (
            torch.from_numpy(arrays[name]).float() for name in ("means3d", "colors", "viewmats", "Ks")
        )
        width, height = int(arrays["width"]), int(arrays["height"])
    count, extent = len(means), (means - means.mean(0)).norm(dim=1).median().item()
    scales = spacing(means, extent)[:, None].repeat(1, 3)
    opacities = 0.5 + 0.4 * torch.rand(count, generator=g)
    parts = (means, torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), scales, opacities, colors / 255)
    v_image = torch.rand(height, width, 3, generator=g)
    return {
        f"garden {i}": Workload(parts, Camera(v, K, width, height), v_image) for i, (v, K) in enumerate(zip(views, Ks))
    }


def surveyed(folder: Path) -> tuple[dict[str, bool], dict[str, list[float]]]:
    """What `survey` decided about a pipeline's clip, and where training begins with what it saw."""
    facts = json.loads((folder / "survey" / "survey.json").read_text())
    return facts["decisions"], facts["starts"]


def finished(folder: Path, device: str = "cpu") -> tuple[Clip, Learned, dict[str, Pose]]:
    """The clip of a pipeline's folder, what training left there, and the person's poses by frame name."""
    train = folder / "train"
    scene = read_scene(train / "scene.npz") if (train / "scene.npz").exists() else None
    body = read_poses(train / "body.npz")
    poses = dict(zip(body.names, zip(body.global_orient, body.body_pose, body.transl, strict=True), strict=True))
    clip = load_clip(folder / "sfm", folder / "smpl", train)
    avatar = completed(read_avatar(train / "avatar.npz"), clip.body_model)
    return clip, load_learned(avatar, scene, read_effects(train / "effects.npz"), device), poses


def learned_work(folder: Path, seed: int = 0) -> Workload:
    """Person and scene of a finished pipeline as the camera of the middle frame that shows the person sees them."""
    clip, learned, poses = finished(folder)
    shown = [i for i in range(len(clip.names)) if clip.shows_person(i)]
    frame = shown[len(shown) // 2]
    viewmat, K = (torch.from_numpy(m[frame]).float() for m in (clip.viewmats, clip.Ks))
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
    sets = [s for s in (learned.person(poses[clip.names[frame]]), learned.scene) if s is not None]
    parts = [torch.cat(part) for part in zip(*(_parts(s, centre) for s in sets), strict=True)]
    v_image = torch.rand(clip.height, clip.width, 3, generator=torch.Generator().manual_seed(seed))
    return Workload(tuple(parts), Camera(viewmat, K, clip.width, clip.height), v_image)


def _parts(splats: Splats, centre: Tensor) -> tuple[Tensor, ...]:
    """Rows with the same covariances; skinned axes are no longer a rotation times scales, so they are taken apart."""
    turns, scales, _ = torch.linalg.svd(splats.axes.double())
    turns = turns * torch.linalg.det(turns).sign()[:, None, None]
    return splats.means, quat_from_matrix(turns).float(), scales.float(), splats.opacities, splats.colors(centre)
