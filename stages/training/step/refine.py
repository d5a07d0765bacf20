"""What is learned per frame: small corrections of the person's pose and place, their face, and the camera and its exposure."""

from __future__ import annotations

from bisect import bisect_left

import torch
from torch import Tensor, nn

from stages.avatar.effects.camera_refinement import correct_cameras
from stages.gestures import FACE_NAMES
from stages.training.step.schedule import Options
from stages.training.views import FittedBody, Poses

SWING, JERK = 0.01, 0.03  # weights of the priors on the swing of clothes
MOVED, CHANGED = 5e-5, 1e-4  # likewise of faces: of a shape, and of the square of its change
OWN = 2.0  # standard deviations of an expression of the body, at most


class BodyCorrections(nn.Module):
    """Corrections of a body in F frames, 0 at first: pose [F,72] rad (added to the axis-angles), place [F,3] m.

    With `bones` of clothes, also of their swing [F,6 bones]; with shapes of a `face` their coefficients [F,face]. Rows have sparse
    gradients, so that a frame moves only when it is seen.
    """

    def __init__(self, frames: int, bones: int = 0, face: int = 0):
        super().__init__()
        self.pose = nn.Embedding(frames, 72, sparse=True)
        self.place = nn.Embedding(frames, 3, sparse=True)
        self.swing = nn.Embedding(frames, 6 * bones, sparse=True) if bones else None
        self.face = nn.Embedding(frames, face, sparse=True) if face else None
        for weight in self.parameters():
            nn.init.zeros_(weight)

    def pose_in(self, frame: int, body: FittedBody, options: Options) -> Poses:
        """The pose of a body in one frame, corrected as far as `options` say, with its face."""
        pose, row = body.poses.at(frame), torch.tensor(frame, device=body.transl.device)
        if options.refine_pose:
            turns = torch.cat(pose[:2]) + self.pose(row)
            pose = Poses(turns[:3], turns[3:], pose.transl + self.place(row), pose.face)
        return pose._replace(face=self.face(row)) if options.learn_face and self.face is not None else pose

    @torch.no_grad()
    def poses(self, body: FittedBody, options: Options, trained: Tensor, moments: Tensor | None) -> Poses:
        """`pose_in` all F frames; frames not trained[F] take their neighbours' correction and face."""
        poses = body.poses
        if options.refine_pose:
            turn, place = (spread(table.weight, trained, moments) for table in (self.pose, self.place))
            turned = poses.global_orient + turn[:, :3], poses.body_pose + turn[:, 3:], poses.transl + place
            poses = Poses(*turned, poses.face)
        if options.learn_face and self.face is not None:
            poses = poses._replace(face=spread(self.face.weight, trained, moments))
        return poses

    def swing_of(self, frame: int | None, told: Tensor | None) -> Tensor | None:
        """Swing [K,6] of the clothes: the part `told` by the pose plus the correction of a `frame`; without a frame `told` alone.

        None without clothes.
        """
        if told is None or frame is None or self.swing is None:
            return told
        return told + self.swing(torch.tensor(frame, device=told.device)).view_as(told)

    def prior(self, frame: int, train: list[int]) -> Tensor | float:
        """What swing and face of a frame cost, where they are learned from the frames `train`."""
        return self._swing_prior(frame, train) + self._face_prior(frame, train)

    def _swing_prior(self, frame: int, train: list[int]) -> Tensor | float:
        """SWING x mean square of a frame's swing, and JERK x that of its difference from the frames of `train` beside it.

        Clothes swing smoothly, and no more than the frames show. 0 without clothes.
        """
        if self.swing is None:
            return 0.0
        rows, gap = self._beside(self.swing, frame, train)
        return SWING * rows.square().mean() + JERK * gap.square().mean()

    def _face_prior(self, frame: int, train: list[int]) -> Tensor | float:
        """MOVED x the sum of how large a frame's coefficients are, and CHANGED x that of the squares of their difference from the
        frames of `train` beside it: a face moves by few shapes, and smoothly. 0 without a face.
        """
        if self.face is None:
            return 0.0
        row, gap = self._beside(self.face, frame, train)
        named, own = row[:, : len(FACE_NAMES)], row[:, len(FACE_NAMES) :]
        return MOVED * (named.sum() + own.abs().sum()) + CHANGED * gap.square().sum()

    @torch.no_grad()
    def clamp_face(self) -> None:
        """Keep coefficients of FACE_NAMES within 0 and 1, as face capture has them, and a body's own expressions within OWN."""
        if self.face is not None:
            self.face.weight[:, : len(FACE_NAMES)].clamp_(0, 1)
            self.face.weight[:, len(FACE_NAMES) :].clamp_(-OWN, OWN)

    @staticmethod
    def _beside(table: nn.Embedding, frame: int, train: list[int]) -> tuple[Tensor, Tensor]:
        """The row [1,D] of a frame, and its difference from the mean of the frames of `train` beside it, which has no gradient."""
        at = bisect_left(train, frame)
        beside = [*train[max(0, at - 1) : at], *train[at + 1 : at + 2]]
        row = table(torch.tensor([frame], device=table.weight.device))
        return row, row - table.weight.detach()[beside].mean(0) if beside else row


class FrameCorrections(nn.Module):
    """Corrections of F frames, 0 at first: log gain [F,3] of the exposure, turn [F,3] rad and shift [F,3] m of the camera.

    For cameras see `effects.camera_refinement`.
    """

    def __init__(self, frames: int):
        super().__init__()
        self.gain = nn.Embedding(frames, 3, sparse=True)
        self.turn = nn.Embedding(frames, 3, sparse=True)
        self.shift = nn.Embedding(frames, 3, sparse=True)
        for weight in self.parameters():
            nn.init.zeros_(weight)

    def gains(self, frame: int) -> Tensor:
        """Factors [3] on the drawn colours of one frame."""
        return self.gain(torch.tensor(frame, device=self.gain.weight.device)).exp()

    def camera(self, frame: int, viewmat: Tensor, trained: Tensor) -> Tensor:
        """The corrected camera [4,4] of a frame; the mean correction of the frames trained[F] is taken off."""
        row = torch.tensor(frame, device=viewmat.device)
        tables = self.turn, self.shift
        return correct_cameras(viewmat, *(table(row) - table.weight.detach()[trained].mean(0) for table in tables))

    @torch.no_grad()
    def all_gains(self, trained: Tensor, moments: Tensor | None) -> Tensor:
        """Exposure factors [F,3], of geometric mean 1 over the frames trained[F]; the others take their neighbours'."""
        table = self.gain.weight
        return spread(table - table[trained].mean(0), trained, moments).exp()

    @torch.no_grad()
    def cameras(self, viewmats: Tensor, trained: Tensor, moments: Tensor | None) -> Tensor:
        """The corrected cameras [F,4,4]; those not trained[F] take their neighbours', as far as these agree."""
        tables = [table.weight - table.weight[trained].mean(0) for table in (self.turn, self.shift)]
        known = trained[:, None].to(viewmats.device)
        shares = (torch.where(known, 1.0, agreement(table[trained])) for table in tables)
        return correct_cameras(viewmats, *(share * spread(t, trained, moments) for share, t in zip(shares, tables)))


def agreement(rows: Tensor) -> Tensor:
    """How much of a row [D] of rows[F,D] its neighbour tells, 0..1: the correlation of rows that follow each other.

    Errors that drift agree; errors of single frames say nothing of the next. 0 for rows of zeros.
    """
    return ((rows[1:] * rows[:-1]).sum() / rows.square().sum().clamp_min(1e-30)).clamp(0, 1)


def spread(table: Tensor, trained: Tensor, moments: Tensor | None = None) -> Tensor:
    """Rows [F,D], those of untrained frames (trained[F] bool) from their neighbours: linear, constant at the ends.

    Neighbours in time: `moments` [F] int64, not falling; None: the frames follow each other.
    """
    at = torch.arange(len(table), device=table.device) if moments is None else moments
    rows, known = trained.nonzero()[:, 0].to(at.device), at[trained]
    if len(known) == 0:
        return torch.zeros_like(table)
    right = torch.searchsorted(known, at).clamp(max=len(known) - 1)
    left = (right - 1).clamp(min=0)
    left = torch.where(known[right] <= at, right, left)
    gap = (known[right] - known[left]).clamp_min(1)
    part = ((at - known[left]) / gap).clamp(0, 1).to(table)[:, None]
    return table[rows[left]] * (1 - part) + table[rows[right]] * part
