"""What a finished training hands on: records of plain arrays, and facts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.rotations import quat_from_matrix
from stages.avatar.drawing.attach import attach
from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.model.person import bone_transforms
from stages.avatar.model.scene import SceneModel
from stages.avatar.splats.gaussians import finite_rows
from stages.formats.clip import Clip
from stages.formats.hands_face import read_hands_face
from stages.records import Avatar, BodyPoses, Cameras, Clothes, Effects, Scene
from stages.training.finishing.bake import COUNTED, Finished, as_trained, finish
from stages.training.finishing.hidden import fill_hidden
from stages.training.finishing.settle import settle
from stages.training.finishing.swing import fit_swing
from stages.training.seen import unseen
from stages.training.step.fit import Fit
from stages.training.step.person import PersonLearner
from stages.training.timing.finishing import HIDDEN, SETTLING, SHAPING, Finishing
from stages.training.views import FittedBody

HARM = 0.1  # dB of the person in the poses farthest from training that an effect may cost
UNFINISHED = (ValueError, IndexError, RuntimeError, ArithmeticError, MemoryError)
"""What finishing raises where somebody cannot be finished: the training is over, and is kept."""


@dataclass(frozen=True)
class Result:
    """A trained clip: avatar and poses of each of its people, in their order.

    `scene` is None where there is none; `effects` and `cameras` (SfM units) are None where none were learned. `curve` has a row
    for each measurement of accuracy, `facts` are those of train.json.

        avatar, poses = result.people[0]
    """

    people: Sequence[tuple[Avatar, BodyPoses]]
    scene: Scene | None
    effects: Effects | None
    cameras: Cameras | None
    curve: list[dict[str, Any]]
    facts: dict[str, Any]


def learned_numbers(effects: FrameEffects, scene: SceneModel | None) -> dict[str, float]:
    """What training learned of lamp and camera, by name; a shadow that falls on no scene stays as it was measured."""
    kept = {} if scene is not None or effects.shadow is None else effects.shadow.known()
    return {name: value for name, value in effects.known().items() if isinstance(value, float) and name not in kept}


def result_of(
    fit: Fit, clips: Sequence[Clip], curve: list[dict[str, Any]], effects: dict[str, dict[str, Any]], say: Finishing
) -> Result:
    """Finish what was trained on `clips`, the same with the body of each person; `effects` is what train.json has of their gains,
    `say` hears about the rest.
    """
    invented, clip = None if fit.scene is None else _filled(fit, fit.scene, say), clips[0]
    finished = [_person(fit, who, one, say) for who, one in zip(fit.people, clips, strict=True)]
    people, counts = [(avatar, poses) for avatar, poses, _ in finished], sum((one[2] for one in finished), Counter())
    scene, invalid = (None, 0) if fit.scene is None or invented is None else _scene(fit.scene, invented)
    settled = fit.densifier.settled
    counts.update(broken=invalid, behind=0 if settled is None else int(settled.sum()))
    distrusted = {} if fit.transients is None else fit.transients.found(clip.names)
    _say(fit, counts, distrusted, say)
    known, cameras, gains = fit.effects.known(), None, {}
    if fit.options.refine_camera:
        viewmats = _array(fit.cameras()).astype(np.float64)
        viewmats[:, :3, 3] /= clip.body.world_from_sfm
        cameras = replace(clip.cameras, viewmats=viewmats)
    if fit.options.exposure:
        gains = dict(zip(clip.names, _array(fit.gains()).round(5).tolist(), strict=True))
    facts = {
        "steps": fit.progress.step,
        "sizes": {"human_cap": fit.params.human_cap, "scene_cap": fit.params.scene_cap},
        "seconds": curve[-1]["seconds"],
        "seconds_by_part": _by_part(fit.clock.seconds, curve[-1]["seconds"]),
        "effects": effects,
        "extent_m": fit.options.extent,
        "gaussians": fit.sizes() | {"human": sum(len(avatar) for avatar, _ in people)},
        **{name: counts[name] for name in (*COUNTED, "behind")},
        "filled": 0 if invented is None else int(invented.sum()),
        "left_out": fit.guard.left_out,
        "clipped": fit.guard.clipped,
        "not_drawn": fit.undrawn,
        "distrusted": distrusted,
        "train_frames": [clip.names[i] for i in fit.train],
        "heldout_poses": "the fit of the smpl stage plus the correction learned by the neighbouring training frames",
        "exposure": gains,
    }
    if len(people) > 1:
        facts["people"] = [len(avatar) for avatar, _ in people]
    return Result(people, scene, Effects(**known) if known else None, cameras, curve, facts)


def _say(fit: Fit, counts: Counter[str], distrusted: dict[str, float], say: Finishing) -> None:
    """What is worth knowing of the whole; what is of one person is said of each."""
    if counts["behind"]:
        behind = f"{counts['behind']:,} Gaussians of the scene"
        say.note(f"{behind} that the person always hides or shades have the colours of their surroundings")
    if counts["broken"]:
        say.warn(f"{counts['broken']} Gaussians left out of the result because they are not finite")
    if numbers := learned_numbers(fit.effects, fit.scene):
        told = ", ".join(f"{name} {value:.2f}" for name, value in numbers.items())
        say.note(f"learned about the recording: {told}")
    if distrusted:
        most = max(distrusted, key=lambda name: distrusted[name])
        say.note(
            f"something passes by in {len(distrusted)} of {len(fit.train)} training frames and was not learned, "
            f"{100 * distrusted[most]:.0f} % of frame {most}"
        )
    left_out, clipped = fit.guard.left_out, fit.guard.clipped
    if left_out:
        say.warn(f"{left_out} gradients or steps were not finite or absurdly large and were left out")
    if clipped:
        say.note(f"{clipped} gradients of networks or effects were far larger than usual and were scaled down")
    if fit.undrawn:
        say.warn(f"Gaussians that were not finite were left out of the picture {fit.undrawn} times")


def _filled(fit: Fit, scene: SceneModel, say: Finishing) -> Tensor:
    """Fills what people hide of the scene; which of its Gaussians are invented then, bool [N]."""
    say.begins(HIDDEN)
    try:
        invented = fill_hidden(scene, fit.seen(), fit.train, fit.cast()._replace(scene=None))
    except UNFINISHED as error:
        say.warn(f"the scene behind the person could not be filled and stays as it was: {error}")
        return torch.zeros(len(scene), dtype=torch.bool, device=scene.means.device)
    if filled := int(invented.sum()):
        say.note(f"{filled:,} Gaussians of the scene are invented: they fill what the person hides in every frame")
    return invented


def _person(fit: Fit, who: PersonLearner, clip: Clip, say: Finishing) -> tuple[Avatar, BodyPoses, Counter[str]]:
    """The avatar of a person, their poses, and what finishing COUNTED."""
    *learned, faces = fit.poses(who)
    sound, fitted = finite_rows(learned)[:, None], who.body[:3]
    orient, body_pose, transl = (torch.where(sound, *pair) for pair in zip(learned, fitted, strict=True))
    if not sound.all():
        lost = [name for name, kept in zip(clip.names, sound[:, 0].tolist(), strict=True) if not kept]
        say.warn(f"the learned pose of frames {', '.join(lost)} is not finite: that of the smpl stage is kept")
    body = who.body._replace(global_orient=orient, body_pose=body_pose, transl=transl, expressions=faces)
    if len(fit.people) > 1:
        say.note(f"{who.name}:")
    if body.clothing is not None and who.corrections.swing is not None:
        _settle_swing(fit, body, body.clothing, who.corrections.swing.weight, say)
    kept = _finished(fit, who, body, say)
    counts = kept.counts + Counter(unseen=int(unseen(who.color_grad_sum).sum()))
    for name, words in COUNTED.items():
        if words and counts[name]:
            say.note(f"{counts[name]:,} Gaussians {words}")
    poses = replace(clip.body, global_orient=_array(orient), body_pose=_array(body_pose), transl=_array(transl))
    if faces is not None:
        poses = replace(poses, face=_array(faces))
    avatar = _avatar(kept, who, body, clip.body.betas, fit.options.antialias)
    return _with_gestures(avatar, clip, say), poses, counts


def _with_gestures(avatar: Avatar, clip: Clip, say: Finishing) -> Avatar:
    """The avatar with the fingers, as the clip shows them, and the face of its body, where that has any."""
    rig = read_hands_face(clip.body_model)
    if rig is None:
        say.note(
            f"no fingers and no face that moves: the body model {clip.body_model.name} has none, the free body has"
        )
        return avatar
    if not len(rig.face_points):
        say.note(f"no face that moves: the body model {clip.body_model.name} has none")
    try:
        return attach(avatar, clip.body_model, rig, clip.hand_shape)
    except UNFINISHED as error:
        say.warn(f"the person got no fingers and no face that moves: {error}")
        return avatar


def effect_facts(
    found: dict[str, dict[str, Any]], seconds: float, note: Callable[[str], None], warn: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """What train.json says of `effect_gains`: dB on the curve's frames, and each one's part of `seconds`.

    An effect may win in the clip's poses and lose in new ones: that is a warning.
    """
    facts = {}
    for name, effect in found.items():
        keys = ("psnr", "psnr_person", "psnr_far")
        gains = {key: None if effect[key] is None else round(effect[key], 3) for key in keys}
        facts[name] = gains | {"seconds": (spent := round(effect["share"] * seconds, 1))}
        known = " / ".join(f"{gains[key]:+.1f}" for key in keys[:2] if gains[key] is not None)
        gained = f"{known} dB on held-out frames, " if known else ""
        if gains["psnr_far"] is not None:
            gained += f"{gains['psnr_far']:+.1f} in the poses farthest from training, "
        cost = f"{round(spent)} s" if spent > 0 else "no measurable time"
        note(f"{name.replace('_', ' ')}: {gained}{cost} of training")
        if (far := gains["psnr_far"]) is not None and far < -HARM:
            others = f"{-far:.1f} dB better without {name.replace('_', ' ')}"
            warn(f"poses farthest from training are {others}: new poses may be, too; try `--set survey.{name}=never`")
    return facts


def _settle_swing(fit: Fit, body: FittedBody, clothing: Clothing, table: Tensor, say: Finishing) -> None:
    bones = [bone_transforms(body.joints, body.parents, *pose) for pose in zip(body.global_orient, body.body_pose)]
    try:
        untold = fit_swing(clothing, table.unflatten(1, (-1, 6)), fit.trained, torch.stack(bones), body.body_pose)
    except UNFINISHED as error:
        say.warn(f"the swing of the clothes could not be computed from the pose: {error}")
        return
    told = f"{100 * untold:.0f} % of their swing in the frames is not explained by the pose"
    say.note(f"{len(clothing)} bones of clothes; {told}")


def _finished(fit: Fit, who: PersonLearner, body: FittedBody, say: Finishing) -> Finished:
    say.begins(SHAPING)
    baked, _ = who.baked()
    seen = who.masked(fit.seen())
    dressed = body._replace(antialias=fit.options.antialias)
    frames = fit.train if who.outline is None else who.outline.clear(fit.train)
    try:
        kept = finish(baked, who.human.initial(), dressed, seen, frames)
    except UNFINISHED as error:
        say.warn(f"the person could not be finished and stays as trained: {error}")
        return as_trained(baked, who.human.initial())
    say.begins(SETTLING)
    clear = frames if fit.transients is None else [i for i in frames if not fit.transients.shares[i]]
    try:
        one, loss = fit.baked(who), fit.params.human_loss
        done = settle(one, kept.person, kept.known, clear, fit.cast([one]), fit.seen(), loss, fit.progress.total)
        kept = kept._replace(person=done)
    except UNFINISHED as error:
        say.warn(f"the Gaussians of the person could not be refined and stay as they were: {error}")
    return kept


def _avatar(kept: Finished, who: PersonLearner, body: FittedBody, betas: np.ndarray, antialias: bool) -> Avatar:
    person, clothes, (middles, covariances) = kept.person, None, who.casters
    if body.clothing is not None:
        clothes = Clothes(**{field.name: _array(getattr(body.clothing, field.name)) for field in fields(Clothes)})
    return Avatar(
        means=_array(person.means),
        quats=_array(quat_from_matrix(person.rotations)),
        scales=_array(person.scales),
        opacities=_array(person.opacities),
        sh0=_array(person.sh[:, 0]),
        shN=_array(person.sh[:, 1:]),
        lbs_weights=_array(person.weights),
        joints=_array(body.joints),
        parents=np.asarray(body.parents),
        betas=betas,
        canonical_pose=_array(body.canonical_pose),
        antialias=antialias,
        clothes=clothes,
        casters=(_array(middles), _array(covariances)),
        normals=_array(person.normals),
    )


def _scene(model: SceneModel, invented: Tensor) -> tuple[Scene, int]:
    """The scene to keep, with what is `invented` [N], and how many Gaussians are left out because they are not finite."""
    quats = model.quats / model.quats.norm(dim=1, keepdim=True)
    scales, opacities = model.log_scales.exp(), model.logit_opacities.sigmoid()
    parts = (model.means, quats, scales, opacities, model.sh0, model.shN)
    finite = finite_rows(parts)
    kept = Scene(*(_array(t[finite]) for t in parts), antialias=model.antialias, invented=_array(invented[finite]))
    return kept, int((~finite).sum())


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _by_part(parts: dict[str, float], total: float) -> dict[str, float]:
    """Seconds of each part of training, the most first, and what is left of `total` as 'other'; sums to `total`."""
    longest = dict(sorted(parts.items(), key=lambda part: -part[1]))
    return {name: round(s, 3) for name, s in (longest | {"other": total - sum(parts.values())}).items()}
