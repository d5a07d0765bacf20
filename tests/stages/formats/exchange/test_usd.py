"""USD, where usd-core is: what is in the file, and OpenUSD's own validators on it."""

import numpy as np
import pytest

from stages.formats.exchange.usd import check_usd, write_usd
from stages.records import Scene

Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed (the extra `usd`)")


def some(shift: float = 0.0, n: int = 40) -> Scene:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(n, 4))
    parts = {
        "means": rng.normal(size=(n, 3)) + shift,
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": rng.uniform(0.01, 0.1, (n, 3)),
        "opacities": rng.random(n),
        "sh0": rng.normal(size=(n, 3)),
        "shN": rng.normal(size=(n, 3, 3)),
    }
    return Scene(**{name: part.astype(np.float32) for name, part in parts.items()})


def opened(path):
    """The file as its stage, and the values of its Gaussians by name; the validators have nothing to say."""
    from pxr import UsdValidation

    stage = Usd.Stage.Open(str(path))
    everything = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert [e.GetMessage() for e in UsdValidation.ValidationContext(everything).Validate(stage)] == []
    return stage, stage.GetPrimAtPath("/World/person")


def test_a_still_holds_everything_exactly(tmp_path):
    check_usd()
    splats = some()
    for name in ("a.usdc", "b.usdc"):
        write_usd(tmp_path / name, {"person": splats})
    assert (tmp_path / "a.usdc").read_bytes() == (tmp_path / "b.usdc").read_bytes()
    stage, prim = opened(tmp_path / "a.usdc")
    assert stage.GetMetadata("upAxis") == "Y" and stage.GetMetadata("metersPerUnit") == 1
    np.testing.assert_array_equal(prim.GetAttribute("positions").Get(), splats.means)
    np.testing.assert_array_equal(prim.GetAttribute("scales").Get(), splats.scales)
    first = prim.GetAttribute("orientations").Get()[0]
    np.testing.assert_allclose([first.real, *first.imaginary], splats.quats[0], atol=1e-7)
    coefficients = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()).reshape(40, 4, 3)
    np.testing.assert_array_equal(coefficients[:, 0], splats.sh0)
    np.testing.assert_array_equal(coefficients[:, 1:], splats.shN)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 1


def test_a_motion_has_a_sample_a_frame(tmp_path, held):
    write_usd(tmp_path / "a.usdc", {"room": some(9)}, {"person": (some(i) for i in range(3))}, fps=24)
    stage, prim = opened(tmp_path / "a.usdc")
    np.testing.assert_array_equal(stage.GetPrimAtPath("/World/room").GetAttribute("positions").Get(), some(9).means)
    assert stage.GetEndTimeCode() == 2
    places = prim.GetAttribute("positionsh")
    assert places.GetTimeSamples() == [0, 1, 2] and stage.GetTimeCodesPerSecond() == 24
    held(np.abs(np.array(places.Get(2)).astype(float) - some(2).means).max(), 2e-3, "half floats, m")


def test_the_box_holds_gaussians_to_three_sigmas(tmp_path):
    splats = some()
    write_usd(tmp_path / "a.usdc", {"person": splats})
    _, prim = opened(tmp_path / "a.usdc")
    low, high = (np.array(corner) for corner in prim.GetAttribute("extent").Get())
    reach = 3 * splats.scales.max(1)[:, None]
    np.testing.assert_allclose(low, (splats.means - reach).min(0), atol=1e-5)
    np.testing.assert_allclose(high, (splats.means + reach).max(0), atol=1e-5)


def test_nobody_has_no_box(tmp_path):
    write_usd(tmp_path / "a.usdc", {"person": some(n=0)})
    _, prim = opened(tmp_path / "a.usdc")
    assert len(prim.GetAttribute("positions").Get()) == 0 and not prim.GetAttribute("extent").HasAuthoredValue()
