"""Rates of motions that were rounded when they were written."""

import pytest

from stages.formats.motions.rates import COMMON, FILM, usual_rate


@pytest.mark.parametrize("rate", [*range(1, 31), *COMMON, *FILM])
@pytest.mark.parametrize("digits", [4, 5, 6, 7, 8])
def test_a_time_rounded_to_any_digits_is_the_rate_that_it_was(rate, digits):
    """Where rounding leaves no doubt: no other whole or usual rate is written alike."""
    written = f"{1 / rate:.{digits}f}"
    alike = [one for one in (*range(1, 241), *FILM) if f"{1 / one:.{digits}f}" == written]
    whole = [one for one in alike if one == round(one)] or alike
    if len(whole) == 1:
        assert usual_rate(written, seconds=True) == pytest.approx(whole[0], rel=1e-12)


@pytest.mark.parametrize(
    ("written", "rate"),
    [
        ("0.033", 30),
        ("0.03", 30),
        ("0.017", 60),
        ("3.3333e-2", 30),
        (".04", 25),
        ("0.0345", 29),
        ("0.007", 144),  # of several whole ones the usual one
        ("0.011", 90),
        ("0.00834", 120000 / 1001),  # of none
        ("0.01668", 60000 / 1001),
        ("0.0077", 130),
        ("1e9", 1e-9),
    ],
)
def test_times_as_files_have_them(written, rate):
    assert usual_rate(written, seconds=True) == pytest.approx(rate, rel=1e-12 if rate != 130 else 2e-3)


@pytest.mark.parametrize(
    ("written", "rate"), [("30", 30), ("30.0", 30), ("29.97", 30000 / 1001), ("23.976", 24000 / 1001), ("24.5", 24.5)]
)
def test_rates_as_files_have_them(written, rate):
    assert usual_rate(written) == rate


@pytest.mark.parametrize("written", ["", "x", "0", "-0.04", "nan", "inf", "1e400", "9" * 5000])
def test_what_is_no_rate_is_refused(written):
    with pytest.raises(ValueError, match=r"number|\b0\b"):
        usual_rate(written, seconds=True)
