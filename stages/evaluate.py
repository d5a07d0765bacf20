"""Measure the result on frames that training never saw, under named protocols."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from stages import contract
from stages.contract import Job
from stages.formats.facts import MASKED_REGIONS, REGIONS, Trained, read_facts
from stages.formats.people import folder_of, people_of

if TYPE_CHECKING:
    import torch

    from stages.avatar.drawing.avatar import PosedAvatar
    from stages.avatar.drawing.cast import Cast, Moment
    from stages.avatar.measures.lpips import Lpips
    from stages.formats.clip import Clip

LOADS = contract.TORCH
PROTOCOL = (
    "'heldout': poses of the body fit, corrected as the neighbouring training frames were. "
    "'heldout_fitted', where there is one: the pose alone is then fitted to the held-out picture, the Gaussians stay "
    "as they are. 'heldout_far': 'heldout' in the third of the frames whose poses are farthest from those of training. "
    "full: whole picture (undistorted); person_crop: tight box of the mask; person_white: the person over white, "
    "the picture cut out by its mask, in the same box. Means over frames; PSNR over all channels at once, SSIM 11x11 "
    "with sigma 1.5, LPIPS AlexNet v0.1 on [-1,1] (lpips_legacy: on [0,1], as HUGS's code feeds it); psnr_per_channel: "
    "the mean of each channel's own. Equal pictures count 100 dB. Where the mask is empty nobody is drawn."
)
PEOPLE = (
    "Several people: full shows all of them; the other two regions are of one person each, under `people` of each but the first, "
    "and what is another person's in person_white is not compared."
)
MASKED = "masked_full: picture and person alone, both times the mask, over black; masked_crop: the same in its box."
NUMBERS = ("psnr", "psnr_per_channel", "ssim", "lpips", "lpips_legacy")
LR_POSE = {"turn": 0.008, "place": 0.012}  # rad and m a step, falling to 0
# Adam's (0.9, 0.999) over 60 steps ends 0.04 dB (phone clip, set on it) to 0.16 dB (courtyard, asked) higher than these over 30
MOMENTUM = (0.6, 0.95)
SHOWN = 6
MARGIN = 16  # px around the person while its pose is fitted
EQUAL = 100.0  # dB that stand for equal pictures: JSON knows no infinity


class Params(contract.Params):
    fit_steps: int = Field(30, ge=0)
    """Steps in which a held-out pose is fitted to its picture, for the second protocol; 0 = no second protocol."""
    masked: bool = False
    """Also measure the masked person over black, as is usual on ZJU-MoCap."""


SHORTER = {"fit_steps": 0}
SCORE, POSE_STEP = 3.3, 0.5
"""Training steps of full size that it takes to score a held-out frame once, and to fit its pose by one step.
The kitchen clip, a short training, 2 cores, November 2026."""


def cost(params: Params, folders: Mapping[str, Path]) -> float:
    """See `contract.StageModule`."""
    from stages.formats.clip import load_clip

    heldout = int(load_clip(folders["sfm"], folders["smpl"]).heldout.sum()) * len(people_of(folders["sfm"]))
    score = SCORE * (1 + params.masked * len(MASKED_REGIONS) / len(REGIONS))
    return heldout * (score * (1 + bool(params.fit_steps)) + POSE_STEP * params.fit_steps)


def published(dataset: str, sequence: str) -> Mapping[str, tuple[float | None, ...]]:
    """See `contract.StageModule`."""
    from stages.formats.datasets import published

    return published.published(dataset, sequence)


def run(job: Job, params: Params, *, sfm: Path, smpl: Path, train: Path) -> None:
    """Write metrics.json, and heldout/*.png: the clip, the result, the person alone."""
    import numpy as np

    from stages.avatar.measures.lpips import Lpips
    from stages.estimators.assets import path
    from stages.filming.clip_cast import load_cast

    began = time.perf_counter()
    clips, cast = load_cast(sfm, smpl, train, job.device)
    clip, scene = clips[0], cast.scene
    facts = read_facts(train / "train.json", Trained)
    with np.load(path("lpips_alex.npz")) as weights:
        lpips = Lpips(weights).to(job.device)
    held = [
        int(i)
        for i in np.flatnonzero(clip.heldout)
        if scene is not None or any(one.shows_person(int(i)) for one in clips)
    ]
    each = list(_measured(job, params, clips, cast, facts, held, lpips))
    seconds = {name: record.seconds for name, record in job.upstream.items()}
    seconds["evaluate"] = round(time.perf_counter() - began, 3)
    memory = [*(record.peak_memory_bytes for record in job.upstream.values()), contract.peak_memory()]
    regions = (*REGIONS, *(MASKED_REGIONS if params.masked else ()))
    means, *of_others = [{protocol: _means(found, regions) for protocol, found in rows.items()} for rows in each]
    gaussians = sum(len(one.avatar.resting.means) for one in cast.people)
    metrics = means | {
        "frames": len(held),
        "gaussians": {"human": gaussians, "scene": len(scene.means) if scene else 0},
        "seconds": seconds | {"total": round(sum(seconds.values()), 3)},
        "peak_memory_bytes": max(memory),
        "device": job.device,
        "seed": job.seed,
        "versions": _versions(),
        "protocol": " ".join([clip.split.rule, PROTOCOL, *[PEOPLE] * bool(of_others), MASKED * params.masked]).strip(),
        "per_frame": {protocol: rows for protocol, rows in each[0].items() if protocol != "heldout_far"},
    }
    if of_others:
        metrics["people"] = {str(k): theirs for k, theirs in enumerate(of_others, 2)}
    (job.out / "metrics.json").write_text(json.dumps(metrics, indent=1, allow_nan=False))
    for number, theirs in enumerate([means, *of_others], 1):
        job.note(f"person {number}, " * bool(of_others) + _sentence(theirs["heldout"], theirs["heldout_far"]))
    if not held:
        job.warn(f"nothing could be measured: no held-out frame to compare in {len(clip.names)} registered frames")


def _measured(
    job: Job,
    params: Params,
    clips: Sequence[Clip],
    cast: Cast[PosedAvatar],
    facts: Trained,
    held: list[int],
    lpips: Lpips,
) -> Iterator[dict[str, list[dict[str, Any]]]]:
    """Of each person the rows of all `held` frames, by protocol. Writes pictures of SHOWN of these frames."""
    import numpy as np

    from stages.avatar.drawing.pixels import to_uint8
    from stages.avatar.measures.poses import farthest
    from stages.avatar.splats.neighbours import spread_evenly
    from stages.formats.images import write_image

    shown = set(spread_evenly(held, SHOWN))
    protocols = ("heldout", "heldout_fitted") if params.fit_steps else ("heldout",)
    for k, clip in enumerate(clips):
        rows: dict[str, list[dict[str, Any]]] = {protocol: [] for protocol in protocols}
        strips = folder_of(job.out, k + 1) / "heldout"
        strips.mkdir(parents=True)
        for done, i in enumerate(held):
            job.progress(k * len(held) + done, len(held) * len(clips))
            shot = Shot(clips, cast, k, i, facts.exposure.get(clip.names[i]))
            for protocol in protocols:
                moment = shot.moment if protocol == "heldout" else shot.posed(*fit_pose(shot, params.fit_steps))
                drawn = shot.draw(moment)
                found = dict(_scores(shot, drawn, lpips)) | dict(_masked(shot, moment, lpips) if params.masked else ())
                rows[protocol].append({"name": clip.names[i]} | found)
                if protocol == "heldout" and i in shown:
                    strip = np.concatenate([clip.images(i), *(to_uint8(d.cpu().numpy()) for d in drawn)], 1)
                    write_image(strips / f"{clip.names[i]}.png", strip)
        there = [i for i in held if clip.shows_person(i)]
        far = {clip.names[i] for i in farthest(clip.body.body_pose, there, clip.training)}
        yield rows | {"heldout_far": [row for row in rows["heldout"] if row["name"] in far]}


class Shot:
    """One held-out frame as person `k` is measured in it: picture, mask, camera, and the `moment` before any fitting."""

    def __init__(self, clips: Sequence[Clip], cast: Cast[PosedAvatar], k: int, i: int, gain: list[float] | None):
        import numpy as np
        import torch

        from stages.avatar.measures.metrics import person_crop

        clip, self.person = clips[k], cast.people[k].row(i)
        like = self.person.transl
        there = [n for n, one in enumerate(cast.people) if one.shown(i)]
        self.row, self.lit = there.index(k) if k in there else None, cast.effects.lit
        self.pose = self.person.global_orient[0], self.person.body_pose[0], self.person.transl[0]
        with torch.no_grad():
            self.moment = cast.at(i)
        self.image = torch.tensor(clip.images(i)).to(like) / 255
        self.mask = torch.tensor(clip.own_mask(i)).to(like) / 255
        theirs = [torch.tensor(clips[n].own_mask(i)).to(like) for n in there if n != k]
        self.theirs = torch.stack([0 * self.mask, *theirs]).amax(0)[..., None] > 0
        self.viewmat, self.K = (torch.as_tensor(np.asarray(m)).to(like) for m in (clip.viewmats[i], clip.Ks[i]))
        self.gain = torch.as_tensor(gain or [1.0, 1.0, 1.0]).to(like)
        self.box = person_crop(self.mask)

    def posed(self, *pose: torch.Tensor) -> Moment:
        """The moment with the person in another pose [3], [69], [3]; shadows and speeds stay, as they are not fitted."""
        from dataclasses import replace

        if self.row is None:
            return self.moment
        orient, body_pose, transl = (part[None] for part in pose)
        there = replace(self.person, global_orient=orient, body_pose=body_pose, transl=transl)
        people = list(self.moment.people)
        people[self.row] = self.lit(there.splats(0))
        return self.moment._replace(people=people)

    def alone(self, moment: Moment) -> Moment:
        """The person of a moment alone, or nobody."""
        rows = [] if self.row is None else [self.row]
        speeds = None if moment.speeds is None else [moment.speeds[row] for row in rows]
        return moment._replace(people=[moment.people[row] for row in rows], scene=None, speeds=speeds)

    def render(self, moment: Moment, box: tuple[slice, slice], white: bool) -> torch.Tensor:
        """The pixels of `box` (rows, columns) at the frame's exposure, [h,w,3], over white or black."""
        from stages.avatar.drawing.pixels import exposed
        from stages.avatar.rasterize import Camera, Layer

        rows, columns = box
        K = self.K.clone()
        K[0, 2] -= columns.start
        K[1, 2] -= rows.start
        size = columns.stop - columns.start, rows.stop - rows.start
        ground = self.gain.new_full((3,), float(white))
        (drawn,) = moment.draw(Camera(self.viewmat, K, *size), [Layer(background=ground)])
        return exposed(drawn.image, drawn.alpha, ground, self.gain)

    def draw(self, moment: Moment) -> tuple[torch.Tensor, torch.Tensor]:
        """Person and scene together, and the person alone over white; both [H,W,3] within 0..1.

        Without a scene the two are the same; where the mask shows nobody, nobody is drawn.
        """
        import torch

        everything = (slice(0, self.mask.shape[0]), slice(0, self.mask.shape[1]))
        with torch.no_grad():
            alone = torch.ones_like(self.image)
            if self.row is not None:
                alone = self.render(self.alone(moment), everything, white=True).clamp(0, 1)
            both = alone = torch.where(self.theirs, 1.0, alone)
            if moment.scene is not None:
                both = self.render(moment, everything, white=False).clamp(0, 1)
        return both, alone


def fit_pose(shot: Shot, steps: int) -> Sequence[torch.Tensor]:
    """The best pose [3], [69], [3] in `steps` of Adam on the absolute difference around the person; no Gaussian moves."""
    import torch

    from stages.avatar.measures.metrics import over_white

    if shot.row is None or shot.box is None:
        return shot.pose
    (rows, columns), (height, width) = shot.box, shot.mask.shape
    box = (
        slice(max(0, rows.start - MARGIN), min(height, rows.stop + MARGIN)),
        slice(max(0, columns.start - MARGIN), min(width, columns.stop + MARGIN)),
    )
    pose = [part.clone().requires_grad_() for part in shot.pose]
    groups = [{"params": pose[:2], "lr": LR_POSE["turn"]}, {"params": pose[2:], "lr": LR_POSE["place"]}]
    optimiser = torch.optim.Adam(groups, betas=MOMENTUM)
    falling = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.0, max(1, steps))
    alone = shot.moment.scene is None
    truth = (over_white(shot.image, shot.mask) if alone else shot.image)[box]
    known = (~shot.theirs if alone else torch.ones_like(shot.theirs))[box]  # alone: not where another may hide them
    best, least = shot.pose, float("inf")
    for _ in range(steps):
        optimiser.zero_grad()
        moment = shot.posed(*pose)
        loss = ((shot.render(shot.alone(moment) if alone else moment, box, white=alone) - truth) * known).abs().mean()
        if loss.item() < least:
            now = [part.detach().clone() for part in pose]
            best, least = (now[0], now[1], now[2]), loss.item()
        loss.backward()
        optimiser.step()
        falling.step()
    return best


def _finite(image: torch.Tensor, truth: torch.Tensor, lpips: Lpips | None) -> dict[str, float | None]:
    from stages.avatar.measures.metrics import scores

    found = scores(image.contiguous(), truth.contiguous(), lpips)
    return {name: EQUAL if value == float("inf") else value for name, value in found.items()}


def _scores(
    shot: Shot, drawn: tuple[torch.Tensor, torch.Tensor], lpips: Lpips | None
) -> Iterator[tuple[str, dict[str, float | None]]]:
    import torch

    from stages.avatar.measures.metrics import over_white

    both, alone = drawn
    if shot.moment.scene is not None:
        yield "full", _finite(both, shot.image, lpips)
        if shot.box is not None:
            yield "person_crop", _finite(both[shot.box], shot.image[shot.box], lpips)
    if shot.box is not None:
        white = torch.where(shot.theirs, 1.0, over_white(shot.image, shot.mask))
        yield "person_white", _finite(alone[shot.box], white[shot.box], lpips)


def _masked(shot: Shot, moment: Moment, lpips: Lpips | None) -> Iterator[tuple[str, dict[str, float | None]]]:
    """Scores of the person over black against the picture, both times the mask: whole, and in its box."""
    import torch

    if shot.box is None:
        return
    everything = (slice(0, shot.mask.shape[0]), slice(0, shot.mask.shape[1]))
    with torch.no_grad():
        alone = shot.render(shot.alone(moment), everything, white=False).clamp(0, 1)
    found, truth = (picture * shot.mask[..., None] for picture in (alone, shot.image))
    yield "masked_full", _finite(found, truth, lpips)
    yield "masked_crop", _finite(found[shot.box], truth[shot.box], lpips)


def _means(rows: list[dict[str, Any]], regions: tuple[str, ...]) -> dict[str, dict[str, float | None]]:
    """Means over the frames that have the number; None where no frame has it."""
    from statistics import fmean

    found: dict[str, dict[str, float | None]] = {}
    for region in regions:
        found[region] = {}
        for name in NUMBERS:
            values = [row[region][name] for row in rows if region in row and row[region][name] is not None]
            found[region][name] = round(fmean(values), 5) if values else None
    return found


def _sentence(held: dict[str, dict[str, float | None]], far: dict[str, dict[str, float | None]]) -> str:
    parts = []
    for region in REGIONS:
        psnr, there = held[region]["psnr"], far[region]["psnr"]
        if psnr:
            new = f" ({there:.1f} in the poses farthest from training)" if there and region != "full" else ""
            parts.append(f"{region.replace('_', ' ')} {psnr:.1f} dB{new}")
    return "held out: " + (", ".join(parts) or "no person in any held-out frame")


def _versions() -> dict[str, str]:
    import platform
    from importlib import metadata

    names = ("torch", "numba", "numpy", "pycolmap", "opencv-contrib-python-headless")
    ours = {"hugs": contract.version(), "python": platform.python_version()}
    return ours | {name: metadata.version(name) for name in names}
