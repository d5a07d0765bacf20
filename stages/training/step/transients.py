"""Things that pass by (people, cars, balls) must not teach the scene: where other frames outvote one, it teaches nothing.

RobustNeRF (https://arxiv.org/abs/2302.00833) and SpotLessSplats (https://arxiv.org/abs/2406.20055) distrust pixels of
large residuals. Those are also what has not been learned yet: on a clean clip that cost us 0.9 dB. So here the other
frames are asked: what they show at the same place of the scene lies nearer to what is drawn, or to what this frame shows.
All is done on cells, over which detail cancels. On a clip with walkers perfect masks bring back no more.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from stages.avatar.effects.motion_blur import BlurredRendering
from stages.avatar.rasterize import Rendering
from stages.training.views import Views

WARM_UP = 0.05  # share of a phase's steps that trust every pixel: at first what is drawn says nothing
CELLS = 48  # along the longer side
LEAST = 0.06  # of the brightest colour: a smaller mean difference of a cell is worth no vote
NEARER = 0.4  # share of the difference within which another frame votes for what is drawn
EDGE = 0.1  # share of a bad cell from which a pixel is bad: adds nearly half a cell around it
VOTERS = 3  # frames at least that see a place, of which more than half must be against


class Transients(nn.Module):
    """Cells of all `views`, of which the frames `train` vote; `shares`[F] is how much of each frame was last distrusted."""

    def __init__(self, views: Views, train: list[int]):
        super().__init__()
        height, width = views.masks.shape[1:]
        scale = CELLS / max(height, width)
        self.grid = max(1, round(height * scale)), max(1, round(width * scale))
        self.viewmats, self.Ks, self.train_frames = views.viewmats[train], views.Ks[train], train
        self.cells = torch.stack([self._pooled(views.images[i].permute(2, 0, 1).float() / 255) for i in train])
        self.masks = torch.stack([self._pooled(views.masks[i][None].float() / 255) for i in train])
        self.size = torch.tensor([width, height]).to(self.Ks)
        self.shares: Tensor
        self.register_buffer("shares", torch.zeros(len(views.images)).to(self.Ks))

    def _pooled(self, picture: Tensor) -> Tensor:
        return F.adaptive_avg_pool2d(picture, self.grid)

    @torch.no_grad()
    def forward(self, rendered: Tensor, depth: Tensor, alpha: Tensor, image: Tensor, frame: int) -> Tensor:
        """Pixels bool[H,W] of the training `frame` that are not to be learned from.

        rendered and image [H,W,3] at one size, depth[H,W] m, summed with the weights that sum to alpha[H,W].
        """
        row = self.train_frames.index(frame)
        drawn, seen = self._pooled(rendered.permute(2, 0, 1)), self._pooled(image.permute(2, 0, 1))
        z = self._pooled(depth[None]) / self._pooled(alpha[None]).clamp_min(1e-3)
        there = self._places(z[0], row)
        others = F.grid_sample(self.cells, there, align_corners=False)
        nobody = F.grid_sample(self.masks, there, align_corners=False)[:, 0] < 0.1
        votes = (there.abs() < 1).all(-1) & nobody
        votes[row] = False
        against = votes & ((others - drawn).abs().amax(1) < NEARER * (drawn - seen).abs().amax(0))
        cast = votes.sum(0)
        bad = ((drawn - seen).abs().amax(0) > LEAST) & (cast >= VOTERS) & (2 * against.sum(0) > cast)
        pixels = F.interpolate(bad[None, None].float(), image.shape[:2], mode="bilinear")[0, 0] > EDGE
        self.shares[frame] = pixels.float().mean()
        return pixels

    def replace(
        self, rendered: Tensor, drawn: Rendering | BlurredRendering, image: Tensor, frame: int, done: float
    ) -> Tensor:
        """`rendered`[H,W,3], the person left out, with `image`[H,W,3] where something passes by: such pixels teach nothing.

        `drawn` has the depth; `done` is the share of the phase's steps.
        """
        if done < WARM_UP:
            return rendered
        passing = self(rendered.detach(), drawn.depth.detach(), drawn.alpha.detach(), image, frame)
        return torch.where(passing[..., None], image, rendered)

    def found(self, names: Sequence[str]) -> dict[str, float]:
        """The share of each frame that was last distrusted, by its name, where there was any."""
        return {name: round(share, 4) for name, share in zip(names, self.shares.tolist(), strict=True) if share}

    def _places(self, z: Tensor, row: int) -> Tensor:
        """Where the other frames show the cells of one, at depth z[h,w] m: [F,h,w,2] in -1..1, 2 where behind a camera."""
        at = torch.meshgrid(*(((torch.arange(n) + 0.5) / n).to(z) for n in z.shape), indexing="ij")
        pixels = torch.stack([at[1] * self.size[0], at[0] * self.size[1], torch.ones_like(z)], -1)
        local = pixels @ torch.linalg.inv(self.Ks[row]).T * z[..., None]
        world = (local - self.viewmats[row, :3, 3]) @ self.viewmats[row, :3, :3]
        there = torch.einsum("fij,hwj->fhwi", self.viewmats[:, :3, :3], world) + self.viewmats[:, None, None, :3, 3]
        before = there[..., 2:] > 1e-3 * z.mean()
        on = torch.einsum("fij,fhwj->fhwi", self.Ks, there / torch.where(before, there[..., 2:], 1.0))
        return torch.where(before, 2 * on[..., :2] / self.size - 1, 2.0)
