"""What the tests of the mathematics share."""

import numpy as np
import pytest

from stages.records import BodyModel
from tests.made.skeleton import PARENTS


def make_small_body(vertices=60, seed=0, posedirs=True):
    """A body model made of noise around a rough stick figure."""
    rng = np.random.default_rng(seed)
    joints = np.zeros((24, 3))
    for joint in range(1, 24):
        joints[joint] = joints[PARENTS[joint]] + rng.normal(0, 0.15, 3)
    nearest = rng.integers(0, 24, vertices)
    nearest[:24] = np.arange(24)
    weights = rng.random((vertices, 24)) ** 8 + 1e-3
    weights[np.arange(vertices), nearest] += 2
    regressor = rng.random((24, vertices)) ** 6
    return BodyModel(
        v_template=joints[nearest] + rng.normal(0, 0.05, (vertices, 3)),
        faces=np.array([rng.choice(vertices, 3, replace=False) for _ in range(2 * vertices)]),
        shapedirs=rng.normal(0, 0.02, (vertices, 3, 10)),
        posedirs=rng.normal(0, 0.01, (vertices, 3, 207)) * posedirs,
        J_regressor=regressor / regressor.sum(1, keepdims=True),
        lbs_weights=weights / weights.sum(1, keepdims=True),
        parents=np.array(PARENTS),
    )


@pytest.fixture
def small_body():
    """Makes a small SMPL-format body: SMPL's tree of 24 joints, random but reasonable arrays."""
    return make_small_body
