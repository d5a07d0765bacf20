"""Shared by the tests of stages and estimators: the real clip's frames, and the trained networks."""

from __future__ import annotations

import pytest

from stages.formats.video import decode
from tests.made import tiny as tiny_clip
from tests.made.networks import fetched


@pytest.fixture(scope="session")
def blazepose():
    """A BlazePose with its networks, fetched if need be; skipped, with the reason printed, without a network."""
    from stages.estimators.person.blazepose import BlazePose

    fetched("pose_detection.tflite", "pose_landmark_full.tflite")
    return BlazePose()


@pytest.fixture(scope="session")
def kitchen(clips):
    """Every 10th frame of the kitchen clip: index -> uint8 [864,480,3]."""
    return {i: image for i, _, image in decode(clips / "kitchen" / "kitchen.mp4") if i % 10 == 0}


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """Folders of all stages up to train, of a clip with a scene; not to be written to."""
    return tiny_clip.make(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="session")
def tiny_human(tmp_path_factory):
    """The same without a scene."""
    return tiny_clip.make(tmp_path_factory.mktemp("tiny-human"), scene=False)
