"""Takes stabilisers out of the code, one by one, and shows that the test of each turns red.

    python -m tests.tools.mutants        prints a table (`make mutants`); exit code 1 if any test stayed green
    python -m tests.tools.mutants FILE   small mistakes of every kind in one file, see file_mutants.py (`make mutants FILE=...`)

Every row of MUTANTS puts back a mistake that is easily made: the entries of the torture set of the hard cases (14-1 to
14-16), and single cases. Two copies of the tree are worked on at a time, each with a cache of its own for compiled kernels.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
COPIED = ("hugs", "hugs_cli", "stages", "tests", "pipelines.yaml", "pyproject.toml")
WORKERS = 2


class Mutant(NamedTuple):
    """`text`, which stands once in `file`, becomes `instead`; then `test` must fail.

    `test` is a file and the name of a test in it, without "test_" and the numbers of its cases.
    """

    name: str
    file: str
    text: str
    instead: str
    test: str


MUTANTS = (
    Mutant(
        "14-1 A01 the determinant as a difference",
        "stages/avatar/rasterize/reference.py",
        "det = sharp + blur * (aa + bb - blur)",
        "det = aa * bb - ab * ab",
        "tests/stages/avatar/rasterize/test_projection.py::a_needle_along_a_row_of_pixels_is_nowhere_above_its_opacity",
    ),
    Mutant(
        "14-1 A01 an exponent that cancels",
        "stages/avatar/rasterize/blend.py",
        "power = fma(u * u, qa, fma(dy * dy, qc, log_opacity))\n            seen = power",
        "power = log_opacity + fma(dx, dx * qa + dy * ((qa + qa) * slant), dy * dy * (qc + qa * slant * slant))\n"
        "            seen = power",
        "tests/stages/avatar/rasterize/test_projection.py::a_needle_along_a_row_of_pixels_is_nowhere_above_its_opacity",
    ),
    Mutant(
        "14-1 A16 the compensation without a floor",
        "stages/avatar/rasterize/reference.py",
        "(sharp / det).clamp_min(COMPENSATION_MIN**2).sqrt()",
        "(sharp / det).sqrt()",
        "tests/stages/avatar/rasterize/test_projection.py::flat_and_pointlike_gaussians",
    ),
    Mutant(
        "14-1 A15 antialiased with the blur of pictures that are not",
        "stages/avatar/rasterize/projection.py",
        "blur = PIXEL if antialias else BLUR\n    bad",
        "blur = BLUR\n    bad",
        "tests/stages/avatar/rasterize/test_projection.py::antialiasing_makes_a_small_picture_the_mean_of_the_large_one",
    ),
    Mutant(
        "14-2 A23 a row that is not finite",
        "stages/avatar/rasterize/projection.py",
        "if not math.isfinite(probe):",
        "if probe == 1e300:",
        "tests/stages/avatar/rasterize/test_projection.py::a_bad_row_is_counted_and_harms_no_other",
    ),
    Mutant(
        "14-2 C03 a colour seen from within",
        "stages/avatar/splats/gaussians.py",
        "squared.clamp_min(1e-12).rsqrt()",
        "squared.rsqrt()",
        "tests/stages/avatar/model/test_scene.py::a_gaussian_on_the_camera_has_a_colour_and_a_gradient",
    ),
    Mutant(
        "14-3 A09 the gradient beyond the clamp",
        "stages/avatar/rasterize/projection.py",
        "if u == x / z:",
        "if z > 0:",
        "tests/stages/avatar/rasterize/test_projection.py::the_kernel_has_that_gradient_too",
    ),
    Mutant(
        "14-3 A11 a principal point in the middle",
        "stages/avatar/rasterize/reference.py",
        "u.clamp((-cx - FRUSTUM_MARGIN * width) / fx, (width - cx + FRUSTUM_MARGIN * width) / fx)",
        "u.clamp(-0.65 * width / fx, 0.65 * width / fx)",
        "tests/stages/avatar/rasterize/test_projection.py::a_crop_is_a_window_of_the_whole",
    ),
    Mutant(
        "14-4 A13 a length in metres",
        "stages/avatar/splats/gaussians.py",
        "rms.clamp(SMALLEST * extent, 0.1 * extent)",
        "rms.clamp(SMALLEST, 0.1)",
        "tests/stages/training/test_training_hard.py::pictures_steps_and_growth_do_not_depend_on_the_unit_of_length",
    ),
    Mutant(
        "14-4 H05 the extent of a tripod",
        "stages/avatar/model/scene.py",
        "return max(spread, 0.5 * front.median().item() if len(front) else 1.0)",
        "return spread",
        "tests/stages/avatar/model/test_scene.py::extent_follows_the_cameras_and_survives_a_tripod",
    ),
    Mutant(
        "14-5 B02 an opacity of 1",
        "stages/avatar/rasterize/rendering.py",
        "ALPHA_MAX = 0.999",
        "ALPHA_MAX = 1.0",
        "tests/stages/avatar/rasterize/test_blend.py::the_early_stop_leaves_no_hole",
    ),
    Mutant(
        "14-6 B13 a reset of opacities",
        "stages/training/step/densify.py",
        "scene.log_scales[rows.child] -= math.log(SHRINK)",
        "scene.logit_opacities.fill_(-4.6)",
        "tests/stages/training/test_training_hard.py::growth_resets_no_opacity",
    ),
    Mutant(
        "14-7 D01 a floor of 1e-12 for 6D",
        "stages/avatar/body/rotations.py",
        "FLOOR_6D = 1e-3",
        "FLOOR_6D = 1e-12",
        "tests/stages/avatar/body/test_rotations.py::paths_into_degenerate_rows_stay_rotations",
    ),
    Mutant(
        "14-8 D04 Rodrigues without its series",
        "stages/avatar/body/rotations.py",
        "SERIES_BELOW = 1e-4",
        "SERIES_BELOW = 0.0",
        "tests/stages/avatar/body/test_rotations.py::rotvec_is_a_rotation_with_true_gradient_at_every_singular_point",
    ),
    Mutant(
        "14-8 D12 z turned to -z in one go",
        "stages/avatar/body/rotations.py",
        "down = n[..., 2:] < 0",
        "down = n[..., 2:] < -2",
        "tests/stages/avatar/body/test_rotations.py::z_reaches_every_normal",
    ),
    Mutant(
        "14-9 E12 a blend made a rotation",
        "stages/avatar/body/skinning.py",
        "+ blend[..., 3], linear",
        "+ blend[..., 3], torch.linalg.qr(linear)[0]",
        "tests/stages/avatar/body/test_skinning.py::a_bent_elbow_takes_the_covariance_of_its_blend",
    ),
    Mutant(
        "14-10 E04 weights without a shift",
        "stages/avatar/body/skinning.py",
        "exponents.softmax(-1).to(points)",
        "(exponents.exp() / exponents.exp().sum(-1, keepdim=True)).to(points)",
        "tests/stages/avatar/body/test_skinning.py::neighbour_weights_near_and_far",
    ),
    Mutant(
        "14-11 F01 points outside the box",
        "stages/avatar/model/triplane.py",
        "inside = points + (points.detach().clamp(self.lower, self.upper) - points.detach())",
        "inside = points",
        "tests/stages/avatar/model/test_triplane.py::outside_reads_the_face_and_can_return",
    ),
    Mutant(
        "14-12 G01 SSIM without a shift",
        "stages/avatar/measures/ssim.py",
        "mean = target.mean((0, 1)).numpy()",
        "mean = np.zeros(3, np.float32)",
        "tests/stages/training/test_training_hard.py::faint_texture_on_a_bright_wall_is_measured_to_the_last_digits",
    ),
    Mutant(
        "14-12 G06 a frame without a person",
        "stages/training/views.py",
        "    if not found:\n        return 0, 0, width, height\n",
        "",
        "tests/stages/training/step/test_fit.py::person_box_is_always_a_window_of_the_picture",
    ),
    Mutant(
        "14-13 H01 a gradient that is not finite",
        "stages/training/step/guard.py",
        "grad[bad] = 0",
        "pass",
        "tests/stages/training/step/test_fit.py::a_bad_gradient_stays_in_its_row_and_is_forgotten",
    ),
    Mutant(
        "14-7 H02 an absurd gradient",
        "stages/training/step/guard.py",
        "ABSURD = 300.0",
        "ABSURD = 1e300",
        "tests/stages/training/step/test_guard.py::one_enormous_gradient_freezes_nothing",
    ),
    Mutant(
        "14-13 H02 what begins at 0 may not wake",
        "stages/training/step/guard.py",
        "QUIET = 0.01",
        "QUIET = 0.0",
        "tests/stages/training/step/test_guard.py::what_begins_at_nothing_is_let_through_when_it_wakes",
    ),
    Mutant(
        "14-13 H02 a first step that is believed",
        "stages/training/step/guard.py",
        "least = ABSURD**2 * _common(grads) if",
        "least = LARGEST if",
        "tests/stages/training/step/test_guard.py::one_enormous_row_is_found_at_every_age",
    ),
    Mutant(
        "14-14 H11 a checkpoint without the order of frames",
        "stages/training/step/fit.py",
        '"order": self.order.clone(),',
        '"order": self.order[:0],',
        "tests/stages/training/step/test_fit.py::resumed_equals_uninterrupted_bit_for_bit",
    ),
    Mutant(
        "14-15 I01 a camera that only turns",
        "stages/estimators/cameras/motion.py",
        'verdict = "rotation only" if believable and residual < limit else "moving"',
        'verdict = "moving"',
        "tests/stages/estimators/cameras/test_motion.py::a_turning_camera_is_named_and_calibrated",
    ),
    Mutant(
        "14-16 I07 frames joined by position",
        "stages/formats/clip.py",
        "order = [row[name] for name in cameras.names]",
        "order = list(range(len(cameras)))",
        "tests/stages/formats/test_clip.py::bodies_are_put_in_the_order_of_the_cameras",
    ),
    Mutant(
        "A04 a radius that overflows",
        "stages/avatar/rasterize/projection.py",
        "np.ceil(math.sqrt(cut * longest))",
        "math.ceil(math.sqrt(cut * longest))",
        "tests/stages/avatar/rasterize/test_projection.py::enormous_scales_are_drawn_and_infinite_ones_dropped",
    ),
    Mutant(
        "A05 a scale that goes flat",
        "stages/avatar/model/human.py",
        "scale = scale / torch.hypot(torch.ones_like(ratio), ratio)",
        "scale = SCALE_RANGE * torch.tanh(ratio)",
        "tests/stages/avatar/model/test_human.py::scales_are_positive_and_alive_whatever_the_network_says",
    ),
    Mutant(
        "B15 black that sinks",
        "stages/avatar/splats/sh.py",
        "torch.where((colors < 0) & (slope > 0), 0, slope)",
        "slope",
        "tests/stages/avatar/splats/test_sh.py::black_that_is_wanted_darker_still_does_not_sink",
    ),
    Mutant(
        "C04 an opacity that freezes",
        "stages/training/step/fit.py",
        "self.scene.clamp_opacities()",
        "pass",
        "tests/stages/training/test_training_hard.py::training_holds_opacities_where_they_move",
    ),
    Mutant(
        "H09 a training frame that is never visited",
        "stages/training/step/fit.py",
        "frame, self.order = self.train[int(self.order[0])], self.order[1:]",
        "frame, self.order = self.train[max(int(self.order[0]), 1)], self.order[1:]",
        "tests/stages/training/step/test_fit.py::every_training_frame_is_seen_once_in_each_round_and_no_other",
    ),
    Mutant(
        "D03 a learned place with the other sign",
        "stages/training/step/refine.py",
        "poses.body_pose + turn[:, 3:], poses.transl + place",
        "poses.body_pose + turn[:, 3:], poses.transl - place",
        "tests/stages/training/step/test_fit.py::what_is_learned_of_poses_is_written_with_its_sign",
    ),
    Mutant(
        "H07 children of axes on their side",
        "stages/training/step/densify.py",
        "(axes[rows.source] @ noise)",
        "(axes[rows.source].mT @ noise)",
        "tests/stages/training/step/test_densify.py::new_gaussians_are_drawn_from_the_ellipsoid_of_their_parent",
    ),
    Mutant(
        "settling: a gradient that is not finite",
        "stages/training/finishing/settle.py",
        'learner.guard.contain(f"settling of {learner.name}", slopes._asdict())',
        "pass",
        "tests/stages/training/finishing/test_settle.py::a_gradient_that_is_not_finite_changes_nobody_else",
    ),
    Mutant(
        "settling: an opacity of 1 that cancels",
        "stages/training/finishing/settle.py",
        "odds = opacities * self.opacity.exp()\n        return odds / (odds + (1 - opacities))",
        "odds = self.opacity.exp()\n        return opacities * odds / (1 + opacities * (odds - 1))",
        "tests/stages/training/finishing/test_settle.py::opacities_of_0_and_1_stay_and_have_a_gradient",
    ),
    Mutant(
        "settling: thin before a wall of the same colour",
        "stages/training/finishing/settle.py",
        "loss = loss + ALONE * losses.person_only(",
        "loss = loss + 0 * losses.person_only(",
        "tests/stages/training/finishing/test_settle.py::who_is_seen_through_becomes_opaque_though_the_scene_behind_has_their_colours",
    ),
    Mutant(
        "settling: axes along the view",
        "stages/training/finishing/painted.py",
        "cosines = (sight[:, None] @ splats.axes)",
        "cosines = (sight[:, None] @ splats.axes.mT)",
        "tests/stages/training/finishing/test_bake.py::frames_tell_what_lies_across_the_view",
    ),
    Mutant(
        "recolouring: skin under cloth keeps what it learned",
        "stages/training/finishing/bake.py",
        "return torch.where(under, ",
        "return torch.where(under & ~skin, ",
        "tests/stages/training/finishing/test_bake.py::skin_that_shines_through_cloth_takes_the_colours_around",
    ),
    Mutant(
        "what nothing covers: the blur twice",
        "stages/training/finishing/painted.py",
        "blur = 0.0 if splats.antialias else BLUR",
        "blur = BLUR",
        "tests/stages/training/finishing/test_bake.py::what_nothing_covers_paints_as_many_pixels_as_its_ellipse_has",
    ),
    Mutant(
        "first Gaussians: as many on each triangle",
        "stages/avatar/model/skin.py",
        "np.searchsorted(areas.cumsum(), at).clip(max=len(faces) - 1)",
        "rng.integers(len(faces), size=tried)",
        "tests/stages/avatar/model/test_skin.py::fine_triangles_have_no_more_than_coarse_ones",
    ),
    Mutant(
        "shortening: by another one's length",
        "stages/training/finishing/bake.py",
        "SHORT * length[~stray]",
        "SHORT * length[: int((~stray).sum())]",
        "tests/stages/training/finishing/test_bake.py::finishing_cuts_axes_by_the_length_they_began_with",
    ),
    Mutant(
        "shortening: smaller, not only shorter",
        "stages/training/finishing/bake.py",
        "person._replace(scales=torch.minimum(person.scales, most))",
        "person._replace(scales=person.scales * (most / person.scales.amax(1, keepdim=True)).clamp_max(1))",
        "tests/stages/training/finishing/test_bake.py::long_axes_are_cut_and_the_others_stay",
    ),
    Mutant(
        "snapping: dots beside an outline",
        "stages/training/finishing/depths.py",
        "back += torch.where(proud, out, 0)[:, None] * normals",
        "back += 0 * normals",
        "tests/stages/training/finishing/test_depths.py::what_is_seen_edge_on_stays_but_for_dots_far_out",
    ),
    Mutant(
        "snapping: hems that are worn down",
        "stages/training/finishing/depths.py",
        "level.median(1).values",
        "around.median(1).values",
        "tests/stages/training/finishing/test_depths.py::seen_from_more_sides_a_step_stays_and_what_is_alone_goes_back",
    ),
    Mutant(
        "snapping: hairs across the skin",
        "stages/training/finishing/depths.py",
        "pressed = which & (less > 0)",
        "pressed = which & (less > 2)",
        "tests/stages/training/finishing/test_depths.py::what_is_seen_from_one_side_is_pressed_flat_and_stays_as_wide",
    ),
    Mutant(
        "masks: a doubt that is a hole",
        "stages/estimators/person/outline.py",
        "np.maximum(share, deep)",
        "share",
        "tests/stages/estimators/person/test_outline.py::doubts_deep_inside_and_haze_far_outside_cover_all_or_nothing",
    ),
    Mutant(
        "masks: an outline that moves",
        "stages/estimators/person/outline.py",
        "share = (STEEP * (sure - 0.5) + 0.5)",
        "share = (STEEP * sure)",
        "tests/stages/estimators/person/test_outline.py::coverage_keeps_the_outline_where_it_is_and_makes_it_steeper",
    ),
    Mutant(
        "clothes: a leg that carries what is beside it",
        "stages/avatar/effects/clothing.py",
        "far = moved[..., ::2].norm(dim=-1, keepdim=True).clamp_min(PUSHED)",
        "far = PUSHED",
        "tests/stages/avatar/effects/test_clothing.py::cloth_beside_a_leg_goes_with_it_as_straight_as_the_leg_moves_towards_it",
    ),
    Mutant(
        "cloth that grows by the wrong axis",
        "stages/avatar/body/stretch.py",
        "vx, vy, vz = vx + v * x, vy + v * y, vz + v * z",
        "vx, vy, vz = vx + u * x, vy + v * y, vz + v * z",
        "tests/stages/avatar/body/test_stretch.py::the_kernel_gives_what_the_specification_gives_in_value_and_gradient",
    ),
    Mutant(
        "cloth that grows with a wrong gradient",
        "stages/avatar/body/stretch.py",
        "given = shares.mT @ upstream[rows].mT",
        "given = shares.mT @ upstream[rows]",
        "tests/stages/avatar/body/test_stretch.py::the_kernel_gives_what_the_specification_gives_in_value_and_gradient",
    ),
    Mutant(
        "clothes: a swing whose turns are another bone's",
        "stages/avatar/drawing/avatar.py",
        "return clothing.swung(rest_relative_transforms(joints, turns, avatar.parents), swung, shifts)",
        "return clothing.swung(rest_relative_transforms(joints, turns, avatar.parents), swung.flip(-3), shifts)",
        "tests/stages/avatar/drawing/test_avatar.py::bones_of_clothes_swing_as_in_training",
    ),
    Mutant(
        "backs: a logo goes around",
        "stages/training/finishing/unseen.py",
        "quarter, pattern, told = rows.shape[1] // 4,",
        "quarter, pattern, told = 0,",
        "tests/stages/training/finishing/test_unseen.py::stripes_and_hems_go_around_and_a_logo_does_not",
    ),
    Mutant(
        "backs: any limb",
        "stages/training/finishing/unseen.py",
        "APART * place.limb[:, None]",
        "0 * place.limb[:, None]",
        "tests/stages/training/finishing/test_unseen.py::a_trunk_does_not_take_the_colours_of_arms_at_its_height",
    ),
    Mutant(
        "backs: another limb where few are seen",
        "stages/training/finishing/unseen.py",
        "told[asked] = away[:, middle][:, -1] < LEVEL",
        "told[asked] = away[:, 0] < LEVEL",
        "tests/stages/training/finishing/test_unseen.py::few_that_are_seen_of_a_hand_are_not_outvoted_by_what_is_no_hand",
    ),
    Mutant(
        "backs: light twice",
        "stages/training/finishing/unseen.py",
        "told[hidden, None, None] * light",
        "light",
        "tests/stages/training/finishing/test_unseen.py::what_takes_what_is_around_is_not_lit_twice",
    ),
    Mutant(
        "backs: no light",
        "stages/training/finishing/unseen.py",
        "return continued(light, near, hidden, part)",
        "return light[hidden]",
        "tests/stages/training/finishing/test_unseen.py::the_light_beside_goes_on_over_a_back",
    ),
    Mutant(
        "face: hidden by a mask, seen in one crop",
        "stages/estimators/person/face_network.py",
        "return min(",
        "return max(",
        "tests/stages/estimators/person/test_face_network.py::a_face_is_there_if_the_tight_and_the_wide_crop_show_it",
    ),
    Mutant(
        "face: a score that is no probability",
        "stages/estimators/person/face_network.py",
        "float(1 / (1 + np.exp(-score.item())))",
        "float(score.item())",
        "tests/stages/estimators/person/test_face_network.py::noise_and_nothing_are_no_face",
    ),
    Mutant(
        "face: a crop that is upright in the picture",
        "stages/estimators/detectors/face.py",
        "float(np.arctan2(dx[0, i], -dy[0, i]))",
        "0.0",
        "tests/stages/estimators/detectors/test_face.py::the_crop_is_the_faces_and_turned_as_the_head_is_in_the_picture",
    ),
    Mutant(
        "face: small ones are looked at",
        "stages/estimators/detectors/face.py",
        "if not found.called_for:",
        "if False:",
        "tests/stages/estimators/detectors/test_face.py::only_a_large_face_is_looked_at_by_the_network",
    ),
    Mutant(
        "face: any frame will do",
        "stages/estimators/detectors/face.py",
        "if share >= SEEN:",
        "if share > 0:",
        "tests/stages/estimators/detectors/test_face.py::half_of_the_frames_must_show_the_face",
    ),
    Mutant(
        "backs: a face on the back of a head",
        "stages/training/finishing/unseen.py",
        "limb, along = torch.where(scalp, HEAD, limb), torch.where(scalp, 0.0, along)",
        "pass",
        "tests/stages/training/finishing/test_unseen.py::the_back_of_a_head_is_scalp_and_not_face",
    ),
    Mutant(
        "backs: light crosses from face to hair",
        "stages/training/finishing/unseen.py",
        "torch.where(part[own] == part[other], 1.0, SEALED)",
        "torch.where(part[own] == part[other], 1.0, 1.0)",
        "tests/stages/training/finishing/test_unseen.py::what_goes_on_is_even_and_stops_at_another_part",
    ),
    Mutant(
        "backs: arms by height",
        "stages/training/finishing/unseen.py",
        "along = torch.where(bone == joint, (person.means - joints[first]) @ way, along)",
        "pass",
        "tests/stages/training/finishing/test_unseen.py::limbs_begin_at_a_joint_and_go_to_the_next",
    ),
    Mutant(
        "backs: nothing is hidden",
        "stages/training/finishing/bake.py",
        "hidden = (own < 0.5) & (",
        "hidden = (own < 0.0) & (",
        "tests/stages/training/finishing/test_unseen.py::a_front_view_alone_gives_hair_behind",
    ),
    Mutant(
        "a stamp written in place",
        "stages/contract.py",
        'part = out.with_name(f".hugs-{os.urandom(6).hex()}{out.suffix[-16:] if ending is None else ending}")',
        "part = out",
        "tests/hugs_cli/cache/test_workspace.py::a_small_file_is_replaced_in_one_step",
    ),
    Mutant(
        "a checkpoint that survives --force",
        "hugs_cli/cache/engine.py",
        "        and Forced() not in verdict.reasons\n        and not any(",
        "        and not any(",
        "tests/hugs_cli/cache/test_engine.py::force_discards_what_a_stage_would_go_on_from",
    ),
    Mutant(
        "a result that knows no --smpl-fit",
        "hugs_cli/cache/freshness.py",
        "for need in sorted(stage.needs)}",
        'for need in sorted(stage.needs) if need != "smpl_fit"}',
        "tests/hugs_cli/cache/test_engine.py::a_result_is_that_of_each_file_that_its_stage_reads",
    ),
    Mutant(
        "a stage without the lock",
        "hugs_cli/cache/launcher.py",
        "pass_fds=(self.write, lock),",
        "pass_fds=(self.write,),",
        "tests/hugs_cli/cache/test_launcher.py::the_lock_is_handed_to_the_stage",
    ),
    Mutant(
        "J09 a tensor one number too long",
        "stages/formats/tool_pickles.py",
        "if 0 not in shape and last >= len(storage):",
        "if 0 not in shape and last > len(storage):",
        "tests/stages/formats/test_tool_pickles.py::hostile_pickles_are_refused",
    ),
    Mutant(
        "J09 a tensor one stride too long",
        "stages/formats/tool_pickles.py",
        "last = offset + sum((n - 1) * step for",
        "last = offset + sum((n - 1) * step - step for",
        "tests/stages/formats/test_tool_pickles.py::hostile_pickles_are_refused",
    ),
    Mutant(
        "J09 sizes of numpy, which wrap",
        "stages/formats/tool_pickles.py",
        "offset, shape, stride = int(offset), tuple(map(int, shape)), tuple(map(int, stride))",
        "pass",
        "tests/stages/formats/test_tool_pickles.py::hostile_pickles_are_refused",
    ),
    Mutant(
        "J09 a view taken for a storage",
        "stages/formats/tool_pickles.py",
        " or not storage.flags.c_contiguous:",
        ":",
        "tests/stages/formats/test_tool_pickles.py::hostile_pickles_are_refused",
    ),
    Mutant(
        "J09 a function that comes out",
        "stages/formats/safe_pickle.py",
        "if callable(value) and not",
        "if False and not",
        "tests/stages/formats/test_tool_pickles.py::hostile_pickles_are_refused",
    ),
    Mutant(
        "J09 a function that is changed",
        "stages/formats/safe_pickle.py",
        "elif isinstance(holder, self.stand_ins):",
        "elif True:",
        "tests/stages/formats/test_tool_pickles.py::hostile_pickles_are_refused",
    ),
    Mutant(
        "J09 content as long as it likes",
        "stages/formats/safe_pickle.py",
        " or len(content) != length or",
        " or",
        "tests/stages/formats/test_body_model.py::an_array_that_is_longer_or_shorter_than_its_shape_is_refused_before_numpy_sees_it",
    ),
    Mutant(
        "L08 a packed array of any size",
        "stages/formats/arrays.py",
        'budget.spend(member.file_size, f"array {key!r}")',
        "pass",
        "tests/stages/formats/test_arrays.py::a_packed_archive_larger_than_its_budget_takes_no_memory",
    ),
    Mutant(
        "L08 a picture of any size",
        "stages/formats/images.py",
        "Budget(path).spend(spec.width * spec.height * spec.depth * pixel, what)",
        "pass",
        "tests/stages/formats/test_images.py::a_small_file_of_an_enormous_picture_is_refused_before_it_is_unpacked",
    ),
    Mutant(
        "L08 joints of any number of frames",
        "stages/formats/motions/bvh.py",
        'Budget(path, len(text)).spend(JOINT * joints * len(rows), f"{joints} joints in {len(rows)} frames")',
        "pass",
        "tests/stages/formats/motions/test_bvh.py::joints_without_channels_take_no_more_memory_than_a_motion_needs",
    ),
    Mutant(
        "L08 a polygon of any number of sides",
        "stages/formats/given_masks/coco.py",
        'budget.spend(CROSSING * int(counts.sum()), f"a polygon of {len(corners)} corners")',
        "pass",
        "tests/stages/formats/given_masks/test_coco.py::a_polygon_of_many_sides_is_refused_before_it_takes_memory",
    ),
    Mutant(
        "A23 a camera that is not finite",
        "stages/avatar/rasterize/__init__.py",
        "if not part.detach().isfinite().all():",
        "if False:",
        "tests/stages/avatar/rasterize/test_rasterize.py::a_camera_that_is_not_finite_is_refused",
    ),
    Mutant(
        "A23 a place that is no number",
        "stages/avatar/rasterize/projection.py",
        "if not (px + reach_x > 0 and px - reach_x < width and py + reach_y > 0 and py - reach_y < height):",
        "if px + reach_x <= 0 or px - reach_x >= width or py + reach_y <= 0 or py - reach_y >= height:",
        "tests/stages/avatar/rasterize/test_rasterize.py::what_the_projection_makes_of_an_absurd_camera_is_nowhere_in_the_picture",
    ),
    Mutant(
        "L08 a number of thousands of digits",
        "stages/formats/motions/bvh.py",
        " or len(words[0]) > DIGITS or",
        " or",
        "tests/stages/formats/motions/test_bvh.py::a_number_of_frames_with_thousands_of_digits_is_refused",
    ),
    Mutant(
        "L08 a name of thousands of digits",
        "stages/formats/pictures.py",
        " if digits and len(digits[-1]) <= DIGITS else",
        " if digits else",
        "tests/stages/formats/given_masks/test_values.py::names_and_ids_of_odd_digits_are_compared_and_no_more",
    ),
    Mutant(
        "L08 a camera of any size",
        "stages/formats/cameras.py",
        'Budget(path).spend(width * height * PIXEL, f"a picture of {width}x{height} px")',
        "pass",
        "tests/stages/formats/test_cameras.py::wrong_cameras_are_refused_by_name",
    ),
    Mutant(
        "L08 a run length of any number of letters",
        "stages/formats/given_masks/coco.py",
        "if counts.max() > LETTERS:",
        "if False:",
        "tests/stages/formats/given_masks/test_coco.py::a_run_length_of_many_letters_is_refused_at_once",
    ),
    Mutant(
        "L08 masks of any number of pixels",
        "stages/formats/given_masks/coco.py",
        'budget.spend(image.height * image.width, f"the mask of annotation {i}, a byte a pixel,")',
        "pass",
        "tests/stages/formats/given_masks/test_coco.py::masks_together_larger_than_any_clip_are_refused",
    ),
    Mutant(
        "hidden: what frames show is filled, too",
        "stages/training/finishing/hidden.py",
        "often[person] = times",
        "often[person] = 0",
        "tests/stages/training/finishing/test_hidden.py::what_a_frame_shows_stays",
    ),
    Mutant(
        "hidden: what one frame shows is left to training",
        "stages/training/finishing/hidden.py",
        "SELDOM = 0.1",
        "SELDOM = 0.0",
        "tests/stages/training/finishing/test_hidden.py::what_one_frame_shows_is_taken_from_it_and_not_invented",
    ),
    Mutant(
        "hidden: the ghost stays",
        "stages/training/finishing/hidden.py",
        "lost = (inside > INSIDE * (inside + outside))",
        "lost = (inside < 0)",
        "tests/stages/training/finishing/test_hidden.py::the_wall_goes_on_where_somebody_always_stood",
    ),
    Mutant(
        "hidden: one place alone",
        "stages/training/finishing/hidden.py",
        "PLACES = 3",
        "PLACES = 1",
        "tests/stages/training/finishing/test_hidden.py::somebody_who_stands_here_and_then_there_leaves_two_places",
    ),
    Mutant(
        "hidden: as deep as what is left there",
        "stages/training/finishing/hidden.py",
        "membrane(_over_depth(_drawn([splats], views, frame)), hole)",
        "_over_depth(_drawn([splats], views, frame))",
        "tests/stages/training/finishing/test_hidden.py::a_hole_is_as_deep_as_what_is_around_it_whatever_floats_there",
    ),
    Mutant(
        "hidden: before the person",
        "stages/training/finishing/hidden.py",
        "np.where(hole, np.minimum(inverse, behind), inverse)",
        "inverse",
        "tests/stages/training/finishing/test_hidden.py::nothing_is_put_before_the_person",
    ),
    Mutant(
        "hidden: a neighbour's patch, not what is beside it",
        "stages/avatar/kernels/patches.py",
        "found[row[ny, nx], 0] + y - ny",
        "found[row[ny, nx], 0]",
        "tests/stages/avatar/kernels/test_patches.py::what_goes_on_beside_a_patch_that_was_found_is_found_at_once",
    ),
    Mutant(
        "hidden: all patches over a pixel count the same",
        "stages/avatar/kernels/patches.py",
        "np.exp((least - costs[t]) / (2 * spread))",
        "1.0",
        "tests/stages/avatar/kernels/test_patches.py::a_pixel_is_the_mean_of_what_patches_over_it_say_or_that_of_the_best",
    ),
    Mutant(
        "hidden: a membrane that sags",
        "stages/training/finishing/completion.py",
        "diags(count) -",
        "diags(count + 0.1) -",
        "tests/stages/training/finishing/test_completion.py::a_plane_stays_a_plane",
    ),
    Mutant(
        "hidden: a picture that is never halved",
        "stages/training/finishing/completion.py",
        "max(1, math.ceil",
        "min(0, math.ceil",
        "tests/stages/training/finishing/test_completion.py::a_pattern_goes_on_through_a_hole",
    ),
)


def node(test: str, root: Path = ROOT) -> str:
    """The pytest node id that a row's `test` means; LookupError unless there is exactly one."""
    file, _, name = test.partition("::")
    found = re.findall(rf"^def (test_(?:[a-l]\d\d_)*{name})\(", (root / file).read_text(), re.M)
    if len(found) != 1:
        raise LookupError(f"{len(found)} tests are called {name} in {file}")
    return f"{file}::{found[0]}"


def mutated(mutant: Mutant, root: Path = ROOT) -> str:
    """The file's source with the mistake in it; LookupError unless the text stands in it exactly once."""
    source = (root / mutant.file).read_text()
    if source.count(mutant.text) != 1:
        raise LookupError(f"{mutant.name}: found {source.count(mutant.text)} times in {mutant.file}: {mutant.text}")
    return source.replace(mutant.text, mutant.instead)


def copy_tree(to: Path) -> Path:
    """The tree under test, its times kept: compiled kernels are known by them."""
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, to / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            to.mkdir(exist_ok=True)
            shutil.copy2(ROOT / name, to / name)
    return to


def ran(tree: Path, seconds: float | None, *arguments: str) -> tuple[int, list[str]]:
    """Pytest in the tree, up to its first failure: its exit code, 1 where it takes longer, and the lines that it prints."""
    environment = {"PYTHONPATH": str(tree), "HUGS_CACHE": str(tree / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *arguments]
    try:
        done = subprocess.run(
            command, cwd=tree, env=os.environ | environment, capture_output=True, text=True, timeout=seconds
        )
    except subprocess.TimeoutExpired:
        return 1, [f"no end after {seconds:.0f} s"]
    return done.returncode, (done.stdout + done.stderr).strip().splitlines() or [f"exit code {done.returncode}"]


def outcome(tree: Path, *nodes: str) -> str:
    """What pytest says of the tests in the tree: red, GREEN, or its last line where it could not run them."""
    code, lines = ran(tree, None, *nodes)
    return {0: "GREEN", 1: "red"}.get(code, lines[-1])


def judge(mutant: Mutant, trees: SimpleQueue[Path]) -> str:
    """The outcome of a mutant's test in one of the trees, which is whole again afterwards."""
    tree = trees.get()
    source, whole = mutated(mutant, tree), shutil.move(tree / mutant.file, tree / "whole")
    try:
        (tree / mutant.file).write_text(source)
        return outcome(tree, node(mutant.test, tree))
    finally:
        shutil.move(whole, tree / mutant.file)
        trees.put(tree)


def main() -> int:
    """Judge all mutants, or those whose name contains a word of the command line, and print the table."""
    words = sys.argv[1:]
    if words and words[0].endswith(".py"):
        from tests.tools import file_mutants

        return file_mutants.main(*words[:1], *map(int, words[1:]))
    chosen = [m for m in MUTANTS if not words or any(word in m.name for word in words)]
    with tempfile.TemporaryDirectory(prefix="hugs-mutants-") as scratch, ThreadPoolExecutor(WORKERS) as pool:
        trees: SimpleQueue[Path] = SimpleQueue()
        copies = [copy_tree(Path(scratch, str(number))) for number in range(WORKERS)]
        nodes = sorted({node(m.test) for m in chosen})
        clean = list(pool.map(lambda tree: outcome(tree, *nodes), copies))
        if clean != ["GREEN"] * WORKERS:
            print(f"the tests must pass before anything is taken out: {clean}")
            return 1
        for tree in copies:
            trees.put(tree)
        stayed = 0
        for mutant, found in zip(chosen, pool.map(lambda m: judge(m, trees), chosen)):
            stayed += found != "red"
            print(f"{mutant.name:52}{found:7}{node(mutant.test).removeprefix('tests/')}", flush=True)
    print(f"\n{len(chosen)} mutants, {stayed} not noticed")
    return int(stayed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
