"""Bodies in skeletons whose names say nothing: of any proportions, with twists, fingers, tails and ends, in any rest pose."""

import time
from contextlib import suppress
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.formats.body_model import read_body_model
from stages.formats.motions.bvh import Bvh
from stages.formats.motions.bvh_names import map_body
from stages.records import JOINT_NAMES
from tests.made.bvh import a_pose, bones_along_x
from tests.made.said import holds
from tests.made.skeleton import PARENTS

MODEL = read_body_model()
JOINTS = MODEL.J_regressor.astype(float) @ MODEL.v_template
RESTS = {"t": np.tile(np.eye(3), (24, 1, 1)), "a": a_pose(), "x": bones_along_x(JOINTS)}
MAPPED = (1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21)
PAIRS = [(1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19), (20, 21)]
FRAMES = 6
END = -2


class Maker:
    """A skeleton by chance; `index` says which joint of it is which of SMPL's."""

    def __init__(self, rest: str, seed: int, twists: bool, fingers: bool, more: bool, toes: bool = True):
        self.rest, self.rng = RESTS[rest], np.random.default_rng(seed)
        self.twists, self.fingers, self.more, self.toes = twists, fingers, more, toes
        self.nodes: list[tuple[int, int, np.ndarray]] = []
        self.index: dict[int, int] = {}
        self.sizes = np.exp(self.rng.normal(0, 0.05, 24))
        for left, right in PAIRS:
            self.sizes[right] = self.sizes[left] * np.exp(self.rng.normal(0, 0.02))
        self.put(0, self.add(-1, -1, np.zeros(3)) if more else -1)

    def add(self, joint: int, parent: int, step: np.ndarray) -> int:
        self.nodes.append((joint, parent, np.asarray(step, float)))
        return len(self.nodes) - 1

    def chain(self, parent: int, *steps: list[float]) -> None:
        for step in steps[:-1]:
            parent = self.add(-1, parent, step)
        self.add(END, parent, steps[-1])

    def put(self, joint: int, parent: int) -> None:
        above = PARENTS[joint]
        step = np.zeros(3) if above < 0 else self.rest[above] @ (JOINTS[joint] - JOINTS[above]) * self.sizes[joint]
        if self.twists and joint in (4, 5, 7, 8, 18, 19, 20, 21):
            step = step / 2
            parent = self.add(-1, parent, step)
        me = self.index[joint] = self.add(joint, parent, step)
        children = [one for one in range(22) if PARENTS[one] == joint and (self.toes or one not in (10, 11))]
        if self.more:
            self.rng.shuffle(children)
        for child in children:
            self.put(child, me)
        if joint in (20, 21) and self.fingers:
            for finger in range(5):
                steps = [self.rest[joint] @ [x, 0, 0.02 * (finger - 2)] for x in (0.08, 0.03, 0.03, 0.02)]
                self.chain(me, *(step if joint == 20 else -step for step in steps))
        elif not children:
            self.chain(me, [0, 0.05, 0])
        if self.more and joint == 15:
            self.chain(me, [0.03, 0.08, 0.08], [0, 0, 0.02])
            self.chain(me, [-0.03, 0.08, 0.08], [0, 0, 0.02])
        if self.more and joint == 0:
            self.chain(me, *([0, -0.05, -0.1] for _ in range(5)))

    def bvh(self, names: dict[int, str]) -> Bvh:
        """It turns somewhere and bends its limbs, in centimetres."""
        yaw = Rotation.from_euler("y", self.rng.uniform(-3, 3)).as_matrix()
        turns, world = np.tile(np.eye(3), (FRAMES, len(self.nodes), 1, 1)), []
        for i, (joint, parent, _) in enumerate(self.nodes):
            above = world[parent] if parent >= 0 else np.eye(3)
            world.append(yaw @ self.rest[joint].T if joint >= 0 else above)
            turns[:, i] = above.T @ world[i]
        for frame in range(1, FRAMES):
            for joint in (1, 2, 4, 5, 16, 17, 18, 19):
                axis = self.rest[joint].T @ ([1, 0, 0] if joint < 16 else [0, 1, 0.3])
                bend = Rotation.from_rotvec(self.rng.uniform(0, 1) * axis).as_matrix()
                turns[frame, self.index[joint]] = turns[frame, self.index[joint]] @ bend
        told = {self.index[joint]: name for joint, name in names.items()}
        called = ["" if joint == END else told.get(i, f"b{i:03d}") for i, (joint, *_) in enumerate(self.nodes)]
        places = np.tile(100 * np.array([step for *_, step in self.nodes]), (FRAMES, 1, 1))
        return Bvh(tuple(called), np.array([parent for _, parent, _ in self.nodes]), places, turns, 30.0)


@pytest.mark.parametrize(("rest", "twists", "fingers", "more"), [*product("tax", *3 * [(False, True)])])
def test_joints_are_found_whatever_they_are_called(rest, twists, fingers, more):
    for seed in range(4):
        made = Maker(rest, seed, twists, fingers, more)
        body = map_body(made.bvh({}), Path("x.bvh"))
        assert {joint: body.limbs[joint] for joint in MAPPED} == {joint: made.index[joint] for joint in MAPPED}, seed
        assert body.pelvis == made.index[0] and made.index[9] in body.spine and made.index[15] in body.neck
        (said,) = body.said
        assert holds(said, "left and right", "feet") and f"left hip b{made.index[1]:03d}" in said


@pytest.mark.parametrize("sides", [("links", "rechts"), ("L_", "R_"), ("left", "right")])
def test_sides_are_told_by_names_where_nothing_else_tells_them(sides):
    names = {joint: sides[JOINT_NAMES[joint].startswith("right")] + f"x{joint}" for joint in MAPPED}
    for rest, seed in product("ta", range(4)):
        made = Maker(rest, seed, twists=False, fingers=True, more=True, toes=False)
        body = map_body(made.bvh({} if sides[0] == "links" else names), Path("x.bvh"))
        found = [{body.limbs[joint] for joint in pair} for pair in zip(MAPPED[::2], MAPPED[1::2])]
        assert found == [{made.index[joint] for joint in pair} for pair in zip(MAPPED[::2], MAPPED[1::2])]
        if sides[0] != "links":
            assert all(body.limbs[joint] == made.index[joint] for joint in MAPPED)
        assert ("by their names" in body.said[0]) == (sides[0] != "links")


def test_names_that_the_tree_cannot_have_are_not_believed():
    made = Maker("t", 0, twists=False, fingers=False, more=False)
    names = {joint: JOINT_NAMES[joint].replace("knee", "shoulder").replace("elbow", "knee") for joint in range(22)}
    names |= {16: "left_elbow", 17: "right_elbow"}
    body = map_body(made.bvh(names), Path("x.bvh"))
    assert all(body.limbs[joint] == made.index[joint] for joint in MAPPED) and body.said


def test_a_skeleton_of_thousands_of_like_limbs_takes_no_time():
    parents = [-1, *(0 for _ in range(700))]
    for depth in range(4):
        parents += range(1 + 700 * depth, 1 + 700 * (depth + 1))
    names, places = tuple(f"b{i}" for i in range(len(parents))), np.zeros((1, len(parents), 3))
    places[..., 1] = 1 + 1e-4 * np.arange(len(parents))
    began = time.perf_counter()
    bvh = Bvh(names, np.array(parents), places, np.tile(np.eye(3), (1, len(parents), 1, 1)), 30.0)
    with suppress(StageError):
        map_body(bvh, Path("x.bvh"))
    assert time.perf_counter() - began < 5


@pytest.mark.parametrize("lost", [(1,), (16,), (4, 18)])
def test_what_has_no_two_legs_and_arms_is_refused(lost):
    made = Maker("t", 0, twists=False, fingers=False, more=False)
    bvh = made.bvh({})
    gone = {made.index[joint] for joint in lost}
    for i, parent in enumerate(bvh.parents.tolist()):
        gone |= {i} if parent in gone else set()
    kept = [i for i in range(len(bvh.names)) if i not in gone]
    parents = np.array([-1 if bvh.parents[i] < 0 else kept.index(bvh.parents[i]) for i in kept])
    cut = Bvh(tuple(bvh.names[i] for i in kept), parents, bvh.places[:, kept], bvh.rotations[:, kept], 30.0)
    with pytest.raises(StageError, match="legs and arms"):
        map_body(cut, Path("x.bvh"))
