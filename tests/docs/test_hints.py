"""Each command and option that the product says is done by a test, or it is written here why not."""

from __future__ import annotations

import ast

import pytest

from tests.docs.documents import ROOT, hints

HERE = "tests/hugs_cli/test_hints.py::"
DRAW, FLEET = f"{HERE}test_what_a_drawing_command_says_makes_it_go_through", "tests/hugs_cli/fleet/test_fleet.py::"
AGAIN = f"{HERE}test_a_stage_that_is_run_again_by_force_is_whole_although_its_stamp_said_so_before"
PICTURES = f"{HERE}test_the_folder_that_has_the_pictures_their_rate_and_a_place_for_results"
RUN = f"{HERE}test_what_a_run_says_makes_it_go_through"
SWEEP = "tests/hugs_cli/studies/test_sweep.py::test_a_budget_is_spent_in_order_on_what_fits_and_the_next_one_goes_on"
HEIGHT = "tests/stages/test_smpl.py::test_a_given_height_makes_body_floor_and_world_larger_and_nothing_else"
DONE = {
    "--avatar avatar.npz": DRAW,
    "--cameras views.npz": DRAW,
    "--force": DRAW,
    "--only human": DRAW,
    "--out": DRAW,
    "--out film.yaml": DRAW,
    "--out motion.mp4": DRAW,
    "hugs animate VIDEO moves.bvh": DRAW,
    "hugs compose --init work/kitchen/default work/dance/default": DRAW,
    "hugs compose film.yaml": DRAW,
    "--set stage.param=value": RUN,
    "--work": RUN,
    "--device cuda": f"{HERE}test_a_run_without_a_gpu_says_what_is_here",
    "hugs doctor": f"{HERE}test_a_run_without_a_gpu_says_what_is_here",
    "hugs gc": f"{HERE}test_results_that_nothing_uses_make_room",
    **dict.fromkeys(["--work X", "hugs run X", "--set frames.folder_fps=30"], PICTURES),
    **dict.fromkeys(
        [f"hugs run VIDEO {stage} --force" for stage in ("X", "masks", "sfm", "smpl", "survey", "train")], AGAIN
    ),
    "hugs run FOLDER frames --force": AGAIN,
    "hugs compose --init RUN RUN": "tests/hugs_cli/test_app_compose.py::test_what_init_writes_runs_as_it_is",
    "hugs accept": "tests/hugs_cli/cache/test_engine.py::test_accept_takes_code_changes_and_nothing_else",
    "--scene room.ply": "tests/stages/commands/test_compose.py::test_the_clips_person_in_a_scene_that_was_edited",
    "hugs animate --avatar FILE MOTION": "tests/stages/commands/test_compose.py::test_an_exported_avatar_performs_without_its_clip",
    "--masks X": "tests/stages/estimators/person/test_given.py::test_masks_that_lie_beside_the_pictures_are_those_of_the_folder",
    "--person ID": "tests/stages/estimators/person/test_given.py::test_another_person_is_picked_by_id",
    "--person N": "tests/stages/estimators/person/test_people.py::test_another_is_picked_by_number_and_an_unknown_one_is_refused",
    "--person all": "tests/stages/test_masks.py::test_all_people_of_given_masks_get_masks_of_their_own",
    "--set masks.invert=always": "tests/stages/test_masks.py::test_g15_polarity_is_found_and_can_be_forced",
    "--set sfm.camera=moving": "tests/stages/test_sfm.py::test_a_camera_that_is_said_to_move_is_mapped_although_it_seems_to_stand",
    **dict.fromkeys(
        ["--set sfm.cameras_from=0", "hugs run PICTURES/"],
        "tests/stages/estimators/cameras/test_given.py::test_frames_are_joined_by_number_or_by_name_and_doubt_is_refused",
    ),
    "--up X": "tests/stages/filming/test_motions.py::test_an_up_that_the_pelvis_contradicts_is_said_with_the_axis_that_it_has",
    "--up": "tests/stages/commands/test_compose.py::test_a_motion_that_does_not_say_how_fast_or_which_way",
    **dict.fromkeys(["--height", "--height 1.85"], HEIGHT),
    "--cameras PATH": "tests/hugs_cli/test_options.py::test_lengths_that_nobody_has_or_that_fit_nothing_are_refused_at_once",
    "--budget 120": SWEEP,
    "--sweep": SWEEP,
    "hugs costs --sweep": SWEEP,
    "--within": "tests/hugs_cli/test_within.py::test_training_gets_what_is_left_of_the_time_and_the_outcome_is_said",
    "hugs run VIDEO --within 10m": "tests/hugs_cli/test_within.py::test_its_results_have_a_name_for_other_commands",
    "hugs run VIDEO --pipeline X --within X": "tests/hugs_cli/test_within.py::test_its_results_have_a_name_for_other_commands",
    "--pipeline default.10m": "tests/hugs_cli/test_within.py::test_its_results_have_a_name_for_other_commands",
    "--name": f"{FLEET}test_ten_broken_clips_hurt_nobody_and_a_second_call_does_what_is_left",
    "--keep export,evaluate": f"{FLEET}test_only_what_is_kept_stays_and_only_what_failed_is_run_again",
    "--jobs": f"{FLEET}test_without_the_extra_it_says_what_to_install_and_runs_one_after_another",
    "python -m stages.train X": "tests/stages/test_train.py::"
    "test_h01_h05_a_training_that_breaks_down_leaves_what_is_needed_to_see_it_again",
    "hugs stages": "tests/docs/test_commands.py::test_cheap_commands_run",
    **dict.fromkeys(
        ["hugs stages X", "hugs stages export", "hugs stages train"],
        f"{HERE}test_the_settings_of_a_stage_are_listed_where_one_is_wrong",
    ),
    "ffmpeg -i X -vf bwdif=send_frame -crf 16 X-whole.mp4": "tests/stages/test_frames.py::test_interlaced_frames_are_said",
    "ffmpeg -i X -fps_mode passthrough pictures/%05d.png": "tests/stages/formats/test_video.py::"
    "test_i10_variable_frame_rate_keeps_each_time",
    "ffmpeg -framerate 30 -i X X": "tests/stages/formats/test_video.py::test_pictures_without_times_are_called_so",
    "ffmpeg -i X -vf scale=X:X equal.mp4": "tests/stages/formats/test_video.py::"
    "test_a_film_whose_pictures_change_their_size_is_refused",
}
"""The command -> the test that does what it says and finds the trouble gone."""
TRAINS = "a training, or what comes before one: minutes"
GIVES = "something that a person has to have: masks, a fit, a film"
NAMES = "a word for an option or a command in a text, no advice"
LEAVES = "advice to leave it out"
OTHERS = "a command of another program, which need not be here"
UNDONE = {
    **dict.fromkeys(
        ["--pipeline preview", "--pipeline human_only --set sfm.camera=fixed", "--seed 1", "--within 10m", "hugs demo"],
        TRAINS,
    ),
    **dict.fromkeys([f"--set {one}" for one in ("frames.count=160", "sfm.min_share=0.3", "sfm.overlap=24")], TRAINS),
    "--set survey.X=never": "tests/docs/test_trained.py::test_a_command_does_what_its_document_says",
    **dict.fromkeys(["--set survey.X=always", "--pipeline X", "hugs run FOLDER --pipeline X"], TRAINS),
    **dict.fromkeys(["hugs run VIDEO", "hugs run VIDEO --pipeline X", "hugs costs VIDEO --sweep"], TRAINS),
    **dict.fromkeys(
        [
            "--masks",
            "--masks DIR",
            "hugs run VIDEO --masks DIR",
            "hugs run VIDEO --smpl-fit FILE",
            "--cameras",
            "--landmarks",
        ],
        GIVES,
    ),
    **dict.fromkeys(
        ["hugs run PICTURES/ --cameras X", "--set frames.train_camera=N", "--scene work/kitchen/default"], GIVES
    ),
    **dict.fromkeys(
        [
            "--only both",
            "--face",
            "--person",
            "--who",
            "--plot",
            "--profile",
            "--set train.human_loss",
            "--set train.joint",
        ],
        LEAVES,
    ),
    **dict.fromkeys(["--json", "--keep", "hugs", "python -m hugs_cli.fleet.job RUN_FOLDER ROW STEP THREADS"], NAMES),
    **dict.fromkeys(
        [f"hugs {one}" for one in ("ablate", "animate", "compose", "costs", "export", "fleet", "render", "run", "why")],
        NAMES,
    ),
    **dict.fromkeys(
        ["hugs costs --json", "hugs costs --plot", "hugs fleet --json", "hugs animate VIDEO MOTION"], NAMES
    ),
    "hugs doctor --fetch": "a network",
    "python -m ensurepip": "a network, and a Python without pip",
    "ffmpeg -i X -vf X sdr.mp4": "a filter (zscale) that the libraries which we have lack",
    "ffmpeg -i LIST -c copy film.mp4": OTHERS,
    "npx @playcanvas/splat-transform FILE out.ply": OTHERS,
    "python demo.py --save_pkl": OTHERS,
}
"""The command -> why no test does it; `test_commands.py` looks whether it exists."""


def test_each_command_that_is_said_is_done_or_it_is_known_why_not():
    known = {*DONE, *UNDONE}
    assert not DONE.keys() & UNDONE.keys()
    assert known - hints().keys() == set(), "no longer said: take them out here"
    assert hints().keys() - known == set(), "new: name the test that does it, or why none does"


@pytest.mark.parametrize("test", sorted(set(DONE.values())))
def test_the_tests_that_do_them_are_there(test):
    file, name = test.split("::")
    tree = ast.parse((ROOT / file).read_text("utf-8"))
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
