"""Fits that have points in place of a pose: SAM 3D Body's, in every way that they are saved."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
import torch

from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit.evidence import STAND_INS, model_landmarks
from stages.estimators.bodyfit.given import import_fit
from stages.formats.given_fits.recognize import read_smpl_fit
from stages.formats.landmarks import NAMES
from tests.made import fits
from tests.made.truth import joints_of

TRUNK_AND_LIMBS = [1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21]


@pytest.fixture(scope="module")
def truth():
    return fits.make_truth(frames=6)


@pytest.fixture(scope="module")
def points(truth):
    """Where the true body has BlazePose's points [N,33,3] m in each camera."""
    names, regressor = model_landmarks(truth.model)
    seen = np.full((len(truth), 33, 3), np.nan)
    zero = torch.zeros(len(truth), 3, dtype=torch.float64)
    parts = (torch.as_tensor(part) for part in (truth.betas, truth.orient, truth.views.body_pose))
    vertices = Body(truth.model, dtype=torch.float64)(*parts, zero)[0].numpy()
    placed = regressor @ (vertices - truth.rest + truth.pelvis[:, None])
    for k, name in enumerate(names):
        for source in STAND_INS.get(name, (name,)):
            seen[:, NAMES.index(source)] = placed[:, k]
    return seen


def plain(value):
    return value.tolist() if isinstance(value, np.ndarray | np.floating) else value


def save(how, people, names, folder):
    """The outputs of all pictures on the disk; the path to give to --smpl-fit."""
    named = {f"{name}.png": there for name, there in zip(names, people, strict=True)}
    if how == "one pickle":
        path = folder / "outputs.pkl"
        path.write_bytes(pickle.dumps(named))
    elif how == "one JSON":
        path = folder / "video_outputs.json"
        rows = [
            {"frame": n, "outputs": [{k: plain(v) for k, v in one.items()} for one in there]}
            for n, there in named.items()
        ]
        path.write_text(json.dumps(rows))
    else:
        path = folder / "each"
        path.mkdir()
        for name, there in named.items():
            if how == "an .npz a picture":  # of one person
                np.savez(path / name.replace("png", "npz"), **{k: v for k, v in there[1].items() if v is not None})
            else:
                np.save(path / name.replace("png", "npy"), np.array(there, object), allow_pickle=True)
    return path


@pytest.mark.parametrize("how", ["one pickle", "one JSON", "an .npz a picture", "an .npy a picture"])
def test_the_limbs_are_where_the_points_say(truth, points, tmp_path, how):
    fit = read_smpl_fit(save(how, fits.sam_3d_body(truth, points), truth.names, tmp_path), truth.size)
    assert len(fit) == len(truth) * (1 if how == "an .npz a picture" else 2) and fit.tool == "SAM 3D Body"
    np.testing.assert_allclose(fit.focal, truth.focal, rtol=1e-3)
    poses, facts = import_fit(fit, fits.inputs_of(truth, truth.model, moving=False), 1 / fits.UNITS)
    gap = np.linalg.norm(joints_of(poses, truth.model) - truth.world_joints(), axis=-1)[:, TRUNK_AND_LIMBS]
    print(f"{how}: {100 * gap.mean():.2f} cm, worst {100 * gap.max():.2f} cm; overlap {facts['overlap']}")
    assert gap.mean() < 0.03 and gap.max() < 0.1 and facts["overlap"] > 0.7
    assert any("SAM 3D Body" in note and "points" in note for note in facts["notes"])
