"""The scene: plain 3D Gaussians, started from SfM points and from points filled in where SfM saw no texture."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from torch import Tensor, nn

from stages import records
from stages.avatar.cameras.pinhole import camera_centers, project, unproject
from stages.avatar.rasterize import gaussian_axes
from stages.avatar.splats.gaussians import Splats, spacing
from stages.avatar.splats.neighbours import nearest
from stages.avatar.splats.sh import bases, sh_from_rgb

MOVABLE = 15.0  # largest logit of an opacity: from 17 on float32's sigmoid is flat and opacities would freeze (C04)
START_OPACITY = 0.5
OPAQUE = 3.0  # logit of an opacity of 0.95
NEAREST = 0.02  # of the extent: nearer to a camera is no surface, see `clear_of_cameras`


def scene_extent(viewmats: Tensor, points: Tensor) -> float:
    """Size in metres to which scene lengths are relative: 1.1 x the spread of cameras, at least half the median depth.

    viewmats[C,4,4], points[P,3]. The floor keeps a tripod or a pure turn from making every length 0 (hard case H05).
    """
    rotations, shifts = viewmats[:, :3, :3].double(), viewmats[:, :3, 3].double()
    centres = camera_centers(viewmats.double())
    spread = 1.1 * (centres - centres.mean(0)).norm(dim=1).max().item()
    if len(points) == 0:
        return max(spread, 1.0)
    depths = torch.einsum("cj,pj->cp", rotations[:, 2], points.double()) + shifts[:, 2:3]
    front = depths[depths > 0]
    return max(spread, 0.5 * front.median().item() if len(front) else 1.0)


def clear_of_cameras(points: Tensor, viewmats: Tensor, extent: float) -> Tensor:
    """Which points[P,3] are farther than NEAREST extents from the centres of all viewmats[C,4,4].

    A point on a camera is a wrong match: no direction leads to it, and it covers that whole picture (hard case H17).
    """
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.bool, device=points.device)
    return nearest(camera_centers(viewmats), points, 1)[0][:, 0] > NEAREST * extent


def fill_points(
    points: np.ndarray,
    images: list[np.ndarray],
    masks: list[np.ndarray],
    viewmats: np.ndarray,
    Ks: np.ndarray,
    count: int,
    rng: np.random.Generator,
    skies: list[np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Points [<=count,3] m and colours [.,3] uint8 of background at random pixels, as deep as the SfM points around.

    points[P,3] m; per view: image uint8[H,W,3], mask uint8[H,W] (255 = person), viewmat[4,4] and K[3,3]. Inverse depth is
    linear between the SfM points of a view; outside them the nearest one gives it. It skips views with under 8 points, and
    pixels of people and of `skies` bool[H,W].
    """
    xyz, rgb = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    share = max(1, count // max(1, len(images)))
    skies = skies or [np.zeros_like(mask, bool) for mask in masks]
    for image, mask, viewmat, K, sky in zip(images, masks, viewmats, Ks, skies, strict=True):
        height, width = mask.shape
        pixels, depths = project(points, viewmat, K)
        seen = (depths > 1e-6) & (pixels > 0).all(1) & (pixels < [width, height]).all(1)
        pixels, inverse = pixels[seen], 1 / depths[seen]
        if len(pixels) < 8:
            continue
        at = rng.random((share, 2)) * [width, height]
        column, row = at.astype(int).T
        bare = ~sky[row, column] & (mask[row, column] < 128)
        at, column, row = at[bare], column[bare], row[bare]
        w = LinearNDInterpolator(pixels, inverse)(at)
        beyond = ~np.isfinite(w)
        w[beyond] = NearestNDInterpolator(pixels, inverse)(at[beyond])
        xyz.append(unproject(at, w, viewmat, K))
        rgb.append(image[row, column])
    return np.concatenate(xyz), np.concatenate(rgb)


class SceneModel(nn.Module):
    """The trainable scene: one row a Gaussian in `means`, `quats`, `log_scales`, `logit_opacities`, `sh0`, `shN`."""

    ROWS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")

    def __init__(self, points: Tensor, rgb: Tensor, sh_degree: int, extent: float, antialias: bool = False):
        """points[P,3] m, rgb[P,3] in 0..1; raises ValueError when there is none."""
        super().__init__()
        self.antialias, self.extent, self.shell = antialias, extent, math.inf
        self.middle: Tensor | None = None
        if len(points) == 0:
            raise ValueError("a scene needs at least one point")
        n = len(points)
        size = spacing(points, extent)
        logit = math.log(START_OPACITY / (1 - START_OPACITY))
        self.means = nn.Parameter(points.clone())
        self.quats = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).to(points).repeat(n, 1))
        self.log_scales = nn.Parameter(size.log()[:, None].repeat(1, 3))
        self.logit_opacities = nn.Parameter(torch.full((n,), logit).to(points))
        self.sh0 = nn.Parameter(sh_from_rgb(rgb))
        self.shN = nn.Parameter(torch.zeros(n, bases(sh_degree) - 1, 3).to(points))

    def __len__(self) -> int:
        return len(self.means)

    @torch.no_grad()
    def add_sky(self, points: Tensor, rgb: Tensor, middle: Tensor, radius: float) -> None:
        """Add the shell of `effects.sky`: points[P,3] m about `radius` m away from middle[3], with rgb[P,3] in 0..1."""
        sky = SceneModel(points, rgb, math.isqrt(self.shN.shape[1]), radius, self.antialias)
        for name in self.ROWS:
            setattr(self, name, nn.Parameter(torch.cat([getattr(self, name), getattr(sky, name)])))
        self.shell, self.middle = radius, middle

    @torch.no_grad()
    def exchange(self, lost: Tensor, points: Tensor, rgb: Tensor, sizes: Tensor) -> None:
        """Put opaque round Gaussians at points[P,3] m, with rgb[P,3] in 0..1 and sigmas sizes[P] m, for those `lost` [N]."""
        fresh = SceneModel(points, rgb, math.isqrt(self.shN.shape[1]), self.extent)
        fresh.log_scales.copy_(sizes.log()[:, None].expand(-1, 3))
        fresh.logit_opacities.fill_(OPAQUE)
        rows = {name: torch.cat([getattr(self, name)[~lost], getattr(fresh, name)]) for name in self.ROWS}
        for name, row in rows.items():
            setattr(self, name, nn.Parameter(row))

    @torch.no_grad()
    def sizes(self) -> Tensor:
        """Scales [N,3] in m for growth and regularizer; a Gaussian on the sky shell counts as if one extent away."""
        scales = self.log_scales.exp()
        if self.middle is None:
            return scales
        away = (self.means - self.middle).norm(dim=1, keepdim=True)
        return torch.where(away > 0.5 * self.shell, scales * self.extent / away, scales)

    @torch.no_grad()
    def add_sparsity_gradient(self, weight: float) -> None:
        """Add the gradient of weight x (mean opacity + mean scale in extents) to Gaussians that the picture shows.

        The regularizer of 3DGS-MCMC, section 3.4 (https://arxiv.org/abs/2404.09591). The paper's
        acts on all: those that no picture shows vanish.
        """
        assert self.logit_opacities.grad is not None and self.log_scales.grad is not None, "after a backward pass"
        taught = self.logit_opacities.grad != 0
        opacities, share = self.logit_opacities.sigmoid(), weight * taught / len(self)
        self.logit_opacities.grad += share * opacities * (1 - opacities)
        self.log_scales.grad += share[:, None] * self.sizes() / (3 * self.extent)

    @torch.no_grad()
    def clamp_opacities(self) -> None:
        """Clamp opacities, in place, to where their sigmoid still has a slope."""
        self.logit_opacities.clamp_(-MOVABLE, MOVABLE)

    def colors(self) -> list[Tensor]:
        """The parameters that hold colours: `sh0`, and `shN` where there is any of it."""
        return [self.sh0, self.shN] if self.shN.shape[1] else [self.sh0]

    def splats(self) -> Splats:
        """The scene's Gaussians, ready to be drawn."""
        sh = self.sh0[:, None] if self.shN.shape[1] == 0 else torch.cat([self.sh0[:, None], self.shN], 1)
        axes = gaussian_axes(self.quats, self.log_scales.exp())
        return Splats(self.means, axes, self.logit_opacities.sigmoid(), sh, antialias=self.antialias)


def load_scene(scene: records.Scene, device: str | torch.device = "cpu") -> Splats:
    """A trained scene, ready to be drawn, float32 on `device`."""
    means, quats, scales, opacities, sh0, shN = (
        torch.as_tensor(array, dtype=torch.float32, device=device)
        for array in (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh0, scene.shN)
    )
    sh = torch.cat([sh0[:, None], shN], 1)
    return Splats(means, gaussian_axes(quats, scales), opacities, sh, antialias=scene.antialias)
