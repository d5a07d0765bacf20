"""Fit person and scene to the training frames, jointly, and write both as Gaussians that need no network."""

from __future__ import annotations

import csv
import io
import json
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError, Stopped

if TYPE_CHECKING:
    import numpy as np
    import torch

    from stages.formats.clip import Clip
    from stages.training.deadline import Deadline
    from stages.training.finishing.bake import Finished
    from stages.training.fit import Fit
    from stages.training.views import Person

RESUMES = True
CHECKPOINT, CHECKPOINT_SECONDS = "checkpoint.pt", 60
JUDGED = 6  # held-out frames on the accuracy curve
SMALL, SMALL_UNDER = {"rounds": 1, "human_cap": 28_000, "scene_cap": 50_000}, 1200
LARGE, LARGE_FROM = {"human_cap": 60_000, "scene_cap": 160_000}, 9000
"""Sizes where fewer, or more, than so many steps of the settings' own sizes fit into the time."""
FEWEST = 200  # steps; fewer make no person
LOOK = "a wrong mask or body fit is the usual cause: look at what `masks` and `smpl` said; else try `--seed 1`"
COLUMNS = ("step", "seconds", "psnr", "ssim", "psnr_person", "ssim_person", "human", "scene", "memory_bytes")


class Params(contract.Params):
    steps: int = Field(4000, gt=0)
    """Training frames looked at. Time grows linearly."""
    seconds: float = Field(0, ge=0)
    """Time to spend, on this machine: `steps` and the sizes are then chosen by timing a few steps; 0 = not limited."""
    reserve: float = Field(0, ge=0)
    """Of `seconds`, the time of so many steps is left over, for what comes after training."""
    half_until: float = Field(0.4, ge=0, le=1)
    """Share of the steps, the first ones, that look at pictures of half the size."""
    frames_used: int = Field(0, ge=0)
    """Most training frames to learn from, spread evenly; 0 = all."""
    rounds: int = Field(1, ge=0, le=3)
    """Subdivisions of the 6,890 body vertices that become Gaussians: 0 -> 6,890, 1 -> 27,554, 2 -> 110,210."""
    human_cap: int = Field(40_000, gt=0)
    """Most Gaussians the person may have in training, unless it begins with more; an opaque lining is put under the skin."""
    scene_cap: int = Field(80_000, gt=0)
    """Most Gaussians the scene may have, unless it begins with more: its budget of memory, 0.2 KB each with gradients and
    moments, 0.9 KB with colours of the 3rd degree."""
    scene_fill: int = Field(20_000, ge=0)
    """Points added to those of SfM before training, where SfM saw no texture."""
    human_sh: int = Field(0, ge=0, le=3)
    """Degree of the person's view-dependent colour; 0 as in the paper."""
    scene_sh: int = Field(3, ge=0, le=3)
    """Degree of the scene's view-dependent colour where survey finds that the clip calls for it; else it is 0."""
    early_stop: float = Field(1e-4, gt=0, lt=1)
    """Share of the light below which training finishes a pixel; films and measuring keep to 1e-4, and so must a GPU."""
    channels: int = Field(32, gt=0)
    """Features of each triplane cell."""
    resolution: int = Field(128, gt=1)
    """Cells along each side of a triplane."""
    views_per_decode: int = Field(4, gt=0)
    """Training frames drawn for each run of the person's networks, whose gradients they share."""
    perceptual_every: int = Field(0, ge=0)
    """A perceptual (LPIPS) term on the person every so many steps; 0 = never. Slow without a GPU."""
    perceptual_net: Literal["alex", "vgg"] = "alex"
    """The network of that term: AlexNet, or VGG16 as in the paper, which takes seven times as long."""
    curve_points: int = Field(12, gt=0)
    """How often held-out accuracy is measured for the curve; the clock stands still meanwhile."""
    lbs_learning: bool = True
    """Skinning weights are learned; else they stay those of the body where each Gaussian began (see `hugs ablate`)."""
    human_densify: bool = True
    """Gaussians of the person are added and removed."""
    human_loss: bool = True
    """The person is also drawn alone and compared; else the whole picture teaches person and scene."""
    triplane: bool = True
    """Gaussians share corrections, by a triplane and networks; else each has only its own, as in plain splatting."""
    joint: bool = True
    """Person and scene learn together; else the scene has the first half of the steps, then the person before it."""


def run(job: Job, params: Params, *, sfm: Path, smpl: Path, survey: Path) -> None:
    """Fit person and scene Gaussians to the frames, jointly."""
    from stages.avatar.kernels.cache import compiled
    from stages.avatar.rasterize.rendering import T_STOP
    from stages.avatar.splats.neighbours import spread_evenly
    from stages.training.checkpoint import save
    from stages.training.effect_gains import worth

    if job.device != "cpu" and params.early_stop != T_STOP:
        hint = "leave `train.early_stop` out, or give `--device cpu`"
        raise StageError(f"a GPU finishes pixels at {T_STOP:g} of the light, not at {params.early_stop:g}", hint)
    if params.seconds and not params.joint:
        hint = "give `train.steps` in place of a time, or leave out `train.joint`"
        raise StageError("only a training of person and scene together can be fitted into a time", hint)
    deadline = _deadline(params) if params.seconds else None
    if job.device == "cpu" and not compiled():
        job.note("the drawing kernels are compiled for this processor first, once: half a minute")
    fit, clip, told = _begun(job, params, (sfm, smpl, survey), deadline)
    params = params.model_copy(update=told["sizes"])
    curve, seconds = told["curve"], told["seconds"]
    sizes = " and ".join(f"{count:,} of the {name}" for name, count in fit.sizes().items() if count)
    job.note(f"{len(fit.train)} training frames; starts with {sizes}")
    judged = [i for i in range(len(clip.names)) if clip.heldout[i] and (clip.mask(i) > 127).any()]
    judged = spread_evenly(judged, JUDGED)
    mark, saved = time.perf_counter(), time.perf_counter()
    while fit.step < fit.total:
        try:
            numbers = fit.advance()
        except (FloatingPointError, ValueError) as error:
            made_of = {"params": params.model_dump(), "sfm": str(sfm), "smpl": str(smpl), "survey": str(survey)}
            raise _broken_down(fit, clip.names[fit.frame], job, made_of, error) from error
        shown = {}
        if fit.step == fit.total or fit.share * params.curve_points >= len(curve) + 1:
            paused = time.perf_counter()
            seconds += paused - mark
            curve.append({"step": fit.step, "seconds": round(seconds, 3)} | _judged(fit, judged))
            mark = time.perf_counter()
            if deadline:
                deadline.judged(mark - paused)
            shown = {"psnr": curve[-1]["psnr"]}
        elif fit.step % 25 == 0:
            shown = {"loss": sum(numbers.values())}
        if deadline and fit.step % 25 == 0 and fit.step < fit.total:
            deadline.mark(fit)
        if shown:
            left = deadline and deadline.to_go
            job.progress(fit.step, fit.total, left, **shown, gaussians=sum(fit.sizes().values()))
        if job.stop_asked or time.perf_counter() - saved > CHECKPOINT_SECONDS:
            saved = time.perf_counter()
            told |= {"curve": curve, "seconds": seconds + saved - mark, "parts": fit.clock.seconds}
            told["deadline"] = deadline and deadline.state()
            save(job.out / CHECKPOINT, fit, told)
            if job.stop_asked:
                raise Stopped(f"stopped after step {fit.step} of {fit.total}; the next run goes on from there")
    try:
        effects = _told(worth(fit, judged), curve[-1]["seconds"], job)
    except (FloatingPointError, ValueError) as error:  # of a step taken to be timed: the training is over, and is kept
        job.warn(f"what effects are worth could not be measured: {error}")
        effects = {}
    _write(fit, clip, job, curve, effects)
    for name in (CHECKPOINT, "failure.npz"):
        (job.out / name).unlink(missing_ok=True)


def _deadline(params: Params) -> Deadline:
    from stages.training.deadline import Deadline

    return Deadline(params.seconds, params.reserve, time.perf_counter(), params.curve_points)


def _begun(
    job: Job, params: Params, folders: tuple[Path, Path, Path], deadline: Deadline | None
) -> tuple[Fit, Clip, dict[str, Any]]:
    """The training, at its first step or where a checkpoint left it, and what else a checkpoint tells."""
    import torch

    from stages.training.checkpoint import load, resume
    from stages.training.effect_gains import PAUSES, effects_of

    told = {"curve": [], "seconds": 0.0, "parts": {}, "sizes": {}, "deadline": None}
    path = job.out / CHECKPOINT
    try:
        saved = load(path, job.device, tuple(told))
    except ValueError as error:
        raise _unusable(error) from error
    fit, clip = _start(job, params.model_copy(update=saved["sizes"] if saved else {}), *folders)
    if deadline and (effects := effects_of(fit)):
        deadline.pauses += PAUSES * len(effects) + 1
    if saved:
        try:
            resume(fit, saved["fit"], path)
        except ValueError as error:
            raise _unusable(error) from error
        job.note(f"goes on after step {fit.step}")
        if saved["threads"] != (now := torch.get_num_threads()):
            job.warn(f"{saved['threads']} threads before, {now} now: sums differ in their last digits")
        told = {name: saved[name] for name in told}
        fit.clock.seconds = dict(told["parts"])
        if deadline:
            deadline.load(told["deadline"], fit)
    elif deadline:
        try:
            fit, clip, told["sizes"] = _timed(job, params, folders, deadline, fit, clip)
        except (FloatingPointError, ValueError) as error:
            raise StageError("training broke down in its first steps", LOOK, [str(error)]) from error
    return fit, clip, told


def _unusable(error: ValueError) -> StageError:
    hint = "begin again: `hugs run VIDEO train --force`"
    return StageError("the checkpoint of the stopped training cannot be used", hint, [str(error)])


def _timed(
    job: Job, params: Params, folders: tuple[Path, Path, Path], deadline: Deadline, fit: Fit, clip: Clip
) -> tuple[Fit, Clip, dict[str, int]]:
    """The training with as many steps as fit into the time, at sizes that are worth them."""
    from stages.training.deadline import short_of

    steps, sizes = deadline.start(fit), {}
    if steps < SMALL_UNDER or steps >= LARGE_FROM:
        pick, wanted = (min, SMALL) if steps < SMALL_UNDER else (max, LARGE)
        sizes = {name: pick(size, getattr(params, name)) for name, size in wanted.items()}
        if any(getattr(params, name) != size for name, size in sizes.items()):
            fit, clip = _start(job, params.model_copy(update=sizes), *folders)
            steps = deadline.start(fit, 1)  # once: the sizes stay, the steps are fitted into the time again and again
    if steps < FEWEST:
        lacking = math.ceil(FEWEST * deadline.pace.mean(0.0) - deadline.left)
        raise StageError(
            "the time is too short to train on this clip",
            facts=[f"{steps} steps would fit into {params.seconds:.0f} s, {FEWEST} are the least that makes sense"],
            hint=f"give {lacking} s more",
        )
    fit.retime(steps)
    caps = f"at most {fit.options.human_cap:,} Gaussians of the person and {fit.options.scene_cap:,} of the scene"
    job.note(f"{steps:,} steps of {1000 * deadline.pace.mean(0.0):.0f} ms fit into the time, with {caps}", at_once=True)
    if lost := round(short_of(steps), 1):
        job.note(f"about {lost} dB short of what 10,000 steps reach, going by our phone clip", at_once=True)
    return fit, clip, sizes


def _start(job: Job, params: Params, sfm: Path, smpl: Path, survey: Path) -> tuple[Fit, Clip]:
    from stages.avatar.splats.neighbours import spread_evenly
    from stages.formats.clip import load_clip
    from stages.formats.facts import Survey, read_facts

    facts = read_facts(survey / "survey.json", Survey)
    clip = load_clip(sfm, smpl)
    train = [i for i in range(len(clip.names)) if clip.training[i]]
    train = spread_evenly(train, params.frames_used or len(train))
    if not train:
        raise StageError(
            "no frame is left to train on",
            facts=[f"{len(clip.names)} frames registered, {int(clip.heldout.sum())} of them held out"],
            hint="give more frames to training in the data set's split",
        )
    return build(clip, train, params, facts.decisions, facts.starts, job), clip


def build(
    clip: Clip,
    train: list[int],
    params: Params,
    decisions: dict[str, Any],
    starts: dict[str, list[float]],
    job: Job,
) -> Fit:
    """Everything that is trained, at its initial value; `decisions` and `starts` are those of survey.json, by effect."""
    from stages.training.start import Start

    shown = [i for i in train if clip.shows_person(i)]
    if not shown:
        raise StageError(
            "no training frame shows a person",
            facts=[f"the masks of all {len(train)} training frames are empty"],
            hint="give masks of your own: `hugs run VIDEO --masks DIR`",
        )
    if not any(clip.body.confidence[i] > 0 for i in shown):
        raise StageError(
            "no training frame has a body fit to learn from",
            facts=[f"{len(shown)} of {len(train)} training frames show the person, the fit trusts its pose in none"],
            hint="give a fit of your own: `hugs run VIDEO --smpl-fit FILE`",
        )
    start = Start(clip, train, params, decisions, starts, job.seed, job.device, job.note)
    fit = start.fit(_perceptual(params, job.device))
    if fit.scene is None and not (params.human_loss and params.joint):
        raise StageError(
            "there is no scene to train the person with",
            facts=[f"human_loss: {params.human_loss}, joint: {params.joint}; without a scene both are needed"],
            hint="leave out `--set train.human_loss` and `--set train.joint`",
        )
    return fit


def _perceptual(params: Params, device: str):
    if not params.perceptual_every:
        return None
    import numpy as np

    from stages.avatar.measures.lpips import Lpips
    from stages.estimators.assets import fetch

    with np.load(fetch(f"lpips_{params.perceptual_net}.npz")) as arrays:
        return Lpips(arrays).to(device)


def _broken_down(fit: Fit, name: str, job: Job, run: dict[str, Any], error: Exception) -> StageError:
    """The error to raise for a step on the frame of that name; failure.npz holds what its `replay` needs."""
    import torch

    from stages.formats.failure import write_failure
    from stages.training.checkpoint import snapshot

    before, file, path = fit.before or snapshot(fit), io.BytesIO(), job.out / "failure.npz"
    torch.save(before, file)
    facts = {"error": str(error), "step": before["numbers"][0], "frame": name, "seed": job.seed, "device": job.device}
    write_failure(path, file.getvalue(), facts | {"threads": torch.get_num_threads()} | run)
    return StageError(
        "training broke down",
        facts=[
            f"step {facts['step']}, frame {name}: {error}",
            f"gradients or steps left out so far: {fit.guard.left_out}",
            f"`python -m stages.train {path}` takes that step again",
        ],
        hint=LOOK,
    )


def replay(path: Path) -> None:
    """Take the step again that broke a training, from its `failure.npz` and the inputs where they were: the same error.

    Bit for bit on a CPU. StageError when the step goes well, as it may after a change of the code.
    """
    import torch

    from stages.formats.failure import read_failure
    from stages.training.checkpoint import restore

    state, facts = read_failure(path)
    torch.set_num_threads(facts.threads)
    job, params = Job(path.parent, facts.device, facts.seed), Params(**facts.params)
    fit, _ = _start(job, params, *map(Path, (facts.sfm, facts.smpl, facts.survey)))
    restore(fit, torch.load(io.BytesIO(state), map_location=job.device, weights_only=True))
    fit.advance()
    raise StageError(f"step {facts.step} went well this time", facts=[f"it had failed with: {facts.error}"])


def _judged(fit: Fit, frames: list[int]) -> dict[str, Any]:
    """What the curve tells of one step, but for the step and its time."""
    import resource

    from stages.training.accuracy import judge

    numbers = {key: "" if value is None else round(value, 4) for key, value in judge(fit, frames).items()}
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {key: numbers[key] for key in COLUMNS[2:6]} | fit.sizes() | {"memory_bytes": memory}


def _told(found: dict[str, dict[str, Any]], seconds: float, job: Job) -> dict[str, dict[str, Any]]:
    """What train.json says of the effects that training had: dB on the curve's frames, and of its `seconds`."""
    told = {}
    for name, effect in found.items():
        gains = {key: None if effect[key] is None else round(effect[key], 3) for key in ("psnr", "psnr_person")}
        told[name] = gains | {"seconds": round(effect["share"] * seconds, 1)}
        known = " / ".join(f"{gain:+.1f}" for gain in gains.values() if gain is not None)
        gained = f"{known} dB on held-out frames, " if known else ""
        cost = f"{round(told[name]['seconds'])} s" if told[name]["seconds"] > 0 else "no measurable time"
        job.note(f"{name.replace('_', ' ')}: {gained}{cost} of training")
    return told


def _write(fit: Fit, clip: Clip, job: Job, curve: list[dict[str, Any]], effects: dict[str, dict[str, Any]]) -> None:
    """Write the results: avatar.npz, scene.npz, body.npz, curve.csv and train.json; effects.npz, cameras.npz if learned."""
    from stages.training.finishing.bake import unseen

    person = fit.person._replace(**dict(zip(("global_orient", "body_pose", "transl"), fit.bodies(), strict=True)))
    worn = {"clothing": fit.effects.clothing, "antialias": fit.options.antialias}
    kept = _write_person(fit, clip, job, person._replace(**worn))
    broken = kept.broken + (_write_scene(fit, job) if fit.scene else 0)
    never, behind = int(unseen(fit.taught).sum()), 0 if fit.behind is None else int(fit.behind.sum())
    if never:
        job.note(f"{never:,} Gaussians of the person that no frame shows have the place and shape of the body")
    if behind:
        job.note(f"{behind:,} Gaussians of the scene that the person hides or shades took the colours seen around them")
    if broken:
        job.warn(f"{broken} Gaussians left out of the result because they are not finite")
    _write_clip(fit, clip, job, person)
    with (job.out / "curve.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(curve)
    distrusted = {} if fit.transients is None else fit.transients.found(clip.names)
    if distrusted:
        most = max(distrusted, key=distrusted.get)
        job.note(
            f"something passes by in {len(distrusted)} of {len(fit.train)} training frames and was not learned, "
            f"{100 * distrusted[most]:.0f} % of frame {most}"
        )
    gains = {}
    if fit.options.exposure:
        gains = dict(zip(clip.names, _array(fit.gains()).round(5).tolist(), strict=True))
    facts = {
        "steps": fit.step,
        "sizes": {"human_cap": fit.options.human_cap, "scene_cap": fit.options.scene_cap},
        "seconds": curve[-1]["seconds"],
        "seconds_by_part": _by_part(fit.clock.seconds, curve[-1]["seconds"]),
        "effects": effects,
        "extent_m": fit.options.extent,
        "gaussians": fit.sizes() | {"human": len(kept.person.means)},
        "broken": broken,
        "strays": kept.strays,
        "evened": kept.evened,
        "leant": kept.leant,
        "unseen": never,
        "behind": behind,
        "lining": kept.lining,
        "left_out": fit.guard.left_out,
        "clipped": fit.guard.clipped,
        "not_drawn": fit.undrawn,
        "distrusted": distrusted,
        "train_frames": [clip.names[i] for i in fit.train],
        "heldout_poses": "the fit of the smpl stage plus the correction learned by the neighbouring training frames",
        "exposure": gains,
    }
    (job.out / "train.json").write_text(json.dumps(facts, indent=1))
    if fit.guard.left_out:
        job.warn(f"{fit.guard.left_out} gradients or steps were not finite or absurdly large and were left out")
    if fit.guard.clipped:
        job.note(
            f"{fit.guard.clipped} gradients of networks or effects were far larger than usual and were scaled down"
        )
    if fit.undrawn:
        job.warn(f"Gaussians that were not finite were left out of the picture {fit.undrawn} times")


def _write_person(fit: Fit, clip: Clip, job: Job, person: Person) -> Finished:
    """Finish the person and write avatar.npz."""
    from dataclasses import fields

    from stages.avatar.body.rotations import quat_from_matrix
    from stages.formats.splats import write_splats
    from stages.records import Avatar, Clothes
    from stages.training.finishing.bake import finished

    baked, _ = fit.baked()
    seen = fit.full._replace(viewmats=fit.cameras())
    kept = finished(baked, fit.human.skinning_outliers(baked.weights), person, seen, fit.train)
    if kept.strays:
        job.note(f"{kept.strays} Gaussians left out that strayed from the body, float beside it or do not move with it")
    if kept.leant:
        job.note(f"{kept.leant:,} Gaussians that no frame shows well take the colours seen around them")
    if kept.evened:
        job.note(f"{kept.evened:,} Gaussians put back that stood out of the surface where no frame looks from the side")
    job.note(f"{kept.lining:,} Gaussians put under the skin, so that no pose tears holes")
    c, clothes, worn = kept.person, None, person.clothing
    if worn is not None:
        clothes = Clothes(**{f.name: _array(getattr(worn, f.name)) for f in fields(Clothes)})
    parts = (c.means, quat_from_matrix(c.rotations), c.scales, c.opacities, c.sh[:, 0], c.sh[:, 1:])
    avatar = Avatar(
        *map(_array, parts),
        lbs_weights=_array(c.weights),
        joints=_array(person.joints),
        parents=person.parents,
        betas=clip.body.betas,
        canonical_pose=_array(person.canonical_pose),
        antialias=person.antialias,
        clothes=clothes,
    )
    write_splats(job.out / "avatar.npz", avatar)
    return kept


def _write_scene(fit: Fit, job: Job) -> int:
    """Write scene.npz; returns how many Gaussians are not finite and left out."""
    from stages.avatar.splats.gaussians import finite_rows
    from stages.formats.splats import write_splats
    from stages.records import Scene

    s = fit.scene
    quats = s.quats / s.quats.norm(dim=1, keepdim=True)
    parts = (s.means, quats, s.log_scales.exp(), s.logit_opacities.sigmoid(), s.sh0, s.shN)
    finite = finite_rows(parts)
    write_splats(job.out / "scene.npz", Scene(*(_array(t[finite]) for t in parts), antialias=s.antialias))
    return int((~finite).sum())


def _write_clip(fit: Fit, clip: Clip, job: Job, person: Person) -> None:
    """Write what was learned of how the clip was taken: body.npz, and effects.npz and cameras.npz where they were."""
    from dataclasses import replace

    import numpy as np

    from stages.formats.cameras import write_cameras
    from stages.formats.effects import write_effects
    from stages.formats.poses import write_poses
    from stages.records import Effects

    poses = {name: _array(getattr(person, name)) for name in ("global_orient", "body_pose", "transl")}
    write_poses(job.out / "body.npz", replace(clip.body, **poses))
    if known := fit.effects.known():
        write_effects(job.out / "effects.npz", Effects(**known))
        numbers = (f"{name} {value:.2f}" for name, value in known.items() if isinstance(value, float))
        job.note(f"learned of how the clip was taken: {', '.join(numbers)}")
    if fit.options.refine_camera:
        viewmats = _array(fit.cameras()).astype(np.float64)
        viewmats[:, :3, 3] /= clip.body.world_from_sfm
        write_cameras(job.out / "cameras.npz", replace(clip.cameras, viewmats=viewmats))


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _by_part(parts: dict[str, float], total: float) -> dict[str, float]:
    """Seconds of each part of training, the most first, and what is left of `total` as 'other'; sums to `total`."""
    longest = dict(sorted(parts.items(), key=lambda part: -part[1]))
    return {name: round(s, 3) for name, s in (longest | {"other": total - sum(parts.values())}).items()}


if __name__ == "__main__":
    replay(Path(sys.argv[1]))
