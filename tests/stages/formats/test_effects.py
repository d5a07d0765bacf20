"""effects.npz gives back what was learned, and what cannot be is refused."""

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.effects import read_effects, write_effects
from stages.records import Effects
from tests.made.said import holds

SHADOW = {"light": [0.6, 0.8, 0.0], "darkness": 0.5, "softness": 0.03, "density": 1.4, "size": 0.6}


def test_what_is_known_comes_back_and_nothing_is_known_without_a_file(tmp_path):
    assert read_effects(tmp_path / "effects.npz").known() == {}
    written = Effects(**SHADOW, readout=-0.25)
    write_effects(tmp_path / "effects.npz", written)
    back = read_effects(tmp_path / "effects.npz")
    assert back.known().keys() == {*SHADOW, "readout"} and back.shutter is None
    assert all(np.array_equal(value, back.known()[name]) for name, value in written.known().items())


def test_who_cast_the_shadow_is_left_to_the_avatar_in_files_of_before(tmp_path):
    older = SHADOW | {"middles": np.ones((24, 3)), "covariances": np.ones((24, 3, 3))}
    np.savez(tmp_path / "effects.npz", **{name: np.asarray(value, float) for name, value in older.items()})
    assert read_effects(tmp_path / "effects.npz").known().keys() == SHADOW.keys()


@pytest.mark.parametrize(
    ("arrays", "facts"),
    [
        ({"light": [0.6, 0.8, 0.0]}, ("missing", "darkness, softness, density, size")),
        (SHADOW | {"light": [0.0, 0.0, 0.0]}, ("light", "[0.0, 0.0, 0.0]", 1)),
        (SHADOW | {"darkness": 1.5}, ("darkness", 1.5, "(0, 1)")),
        (SHADOW | {"light": [0.6, 0.8]}, (2, 3)),
        ({"shutter": np.nan}, ("nan",)),
        ({"readout": -1.5}, ("readout", -1.5, "(-1, 1)")),
        ({"readout": [0.1]}, (1, "single number")),
        ({"glare": 0.5}, ("glare",)),
    ],
)
def test_what_cannot_be_is_refused_with_its_name(tmp_path, arrays, facts):
    np.savez(tmp_path / "effects.npz", **{name: np.asarray(value, float) for name, value in arrays.items()})
    with pytest.raises(StageError) as error:
        read_effects(tmp_path / "effects.npz")
    assert holds(" ".join(error.value.facts), *facts) and "--force" in error.value.hint
