"""Lengths as people write them, 1.85, 1,85 m, 185cm, 6ft1, 6'1": heights, and a length of the page beside its true one."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

NUMBER = r"(\d+(?:[.,]\d*)?|[.,]\d+)"
METRIC = re.compile(rf"{NUMBER}\s*(m|cm|mm)?")
FEET = re.compile(rf"(\d+)\s*(?:ft|feet|foot|['’′])\s*(?:{NUMBER}\s*(?:in|inch|inches|\"|”|″|'')?)?")
UNITS = {None: 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
FOOT, INCH = 0.3048, 0.0254  # m
SHORTEST, TALLEST = 0.5, 2.75  # m, of people who stand
CENTIMETRES, LARGE = (50, 275), (4, 8)  # heights that were meant in cm, and in feet
RATIOS = 0.4, 2.5  # of a true length to that of the page: beyond, another unit is meant
CAMERAS = "cameras"


def read_length(given: object) -> float:
    """Metres of a number, or of a text such as `1.85`, `1,85 m`, `185cm`, `6ft1` or `5'11"`; a pydantic error for any other."""
    if isinstance(given, str):
        text = given.strip().lower()
        if found := METRIC.fullmatch(text):
            given = float(found[1].replace(",", ".")) * UNITS[found[2]]
        elif found := FEET.fullmatch(text):
            given = int(found[1]) * FOOT + float((found[2] or "0").replace(",", ".")) * INCH
    if isinstance(given, bool) or not isinstance(given, int | float) or not 0 < given < math.inf:
        raise PydanticCustomError("length", "no length: write 1.85, 185cm or 6ft1")
    return float(given)


def read_height(given: object) -> float:
    """As `read_length`, of somebody who stands; an error for a height that nobody has."""
    metres = read_length(given)
    if not SHORTEST <= metres <= TALLEST:
        hint = ""
        if CENTIMETRES[0] <= metres <= CENTIMETRES[1]:
            hint = f"; write {metres:g}cm"
        elif LARGE[0] <= metres < LARGE[1]:
            hint = f"; feet are written {int(metres)}ft"
        said = f"nobody is {metres:.4g} m tall: people are {SHORTEST} to {TALLEST} m{hint}"
        raise PydanticCustomError("height", "{said}", {"said": said})
    return metres


def read_heights(given: object) -> dict[int, float] | None:
    """Heights in metres by the number of the person, of one height, a list in the order of people, or some by number: `2=1.70`."""
    if given is None:
        return None
    if isinstance(given, Mapping):
        pairs: list[tuple[object, object]] = list(given.items())
    else:
        each = list(given) if isinstance(given, list | tuple) else [given]
        split = [one.partition("=") if isinstance(one, str) else (one, "", "") for one in each]
        pairs = [(str(who).strip(), tall) if mark else (n, who) for n, (who, mark, tall) in enumerate(split, 1)]
    heights: dict[int, float] = {}
    for who, tall in pairs:
        if not re.fullmatch(r"[1-9]\d?", str(who)):
            raise PydanticCustomError("person", "people have numbers: write 2=1.70 for the second")
        number = int(str(who))
        if number in heights:
            raise PydanticCustomError("twice", "two heights of person {who}", {"who": number})
        heights[number] = read_height(tall)
    return heights or None


def read_scale(given: object) -> str | tuple[float, float] | None:
    """`cameras`, or (length of the page, true length) in metres of a text such as `2.31=2.00`."""
    if given is None or given == CAMERAS:
        return CAMERAS if given else None
    pair = given.split("=") if isinstance(given, str) else given
    if not isinstance(pair, list | tuple) or len(pair) != 2:
        raise PydanticCustomError("scale", "write 2.31=2.00 for what the page calls 2.31 m and is 2.00 m, or cameras")
    shown, true = (read_length(one) for one in pair)
    if not RATIOS[0] <= true / shown <= RATIOS[1]:
        said = f"{shown:.4g} m of the page cannot be {true:.4g} m: bodies are known better; are both in metres?"
        raise PydanticCustomError("scale", "{said}", {"said": said})
    return shown, true


Heights = Annotated[dict[int, float] | None, BeforeValidator(read_heights)]
"""Metres, by the number of the person from 1 on."""
Scale = Annotated[Literal["cameras"] | tuple[float, float] | None, BeforeValidator(read_scale)]
"""The given cameras are in metres; or a length in the page's metres, and in true ones."""
