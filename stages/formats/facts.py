"""The .json files between stages: read and checked, so that a stage sees the keys and types that it asks for."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from stages.contract import StageError

MADE_BY = {"split": "sfm", "metrics": "evaluate"}
"""The stage that writes a file, where the file is not named after it."""
NAME = "name"
"""The form of a text that becomes the name of a file."""
WORDS = {
    NAME: "a file name",
    str: "a text",
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    None: "null",
}


def read_facts(path: Path, wanted: Any) -> Any:
    """What a .json file holds; StageError, naming the place in it, where that is not as `wanted`.

    `wanted` shows the form: `str`, `NAME`, `float` (finite, whole ones too), `int`, `bool` or None; `[form]` for a list of any
    length; `{"key": form}` for these keys and any others, `"key?"` for one that may be missing; `{str: form}` for any keys;
    a tuple for any of several forms.
    """
    hint = f"run the stage again: `hugs run VIDEO {MADE_BY.get(path.stem, path.stem)} --force`"
    try:
        value = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise StageError(f"cannot read {path}", hint, [str(error)]) from error
    wrong = mismatch(value, wanted, "")
    if wrong:
        raise StageError(f"{path} is not as its stage writes it", hint, [wrong])
    return value


def mismatch(value: Any, wanted: Any, place: str) -> str:
    """The first place of a JSON value that is not of the form `wanted`, in words, or ''."""
    if isinstance(wanted, tuple):
        found = [mismatch(value, form, place) for form in wanted]
        return found[-1] if all(found) else ""
    if isinstance(wanted, list):
        if not isinstance(value, list):
            return f"{place or 'it'} is {short(value)}, not a list"
        return next(filter(None, (mismatch(one, wanted[0], f"{place}[{i}]") for i, one in enumerate(value))), "")
    if isinstance(wanted, dict):
        if not isinstance(value, dict):
            return f"{place or 'it'} is {short(value)}, not named values"
        if str in wanted:
            forms = dict.fromkeys(value, wanted[str])
        else:
            forms = {k.removesuffix("?"): form for k, form in wanted.items() if k[-1] != "?" or k[:-1] in value}
        missing = [key for key in forms if key not in value]
        if missing:
            return f"{place or 'it'} has no {missing[0]}"
        each = (mismatch(value[key], form, f"{place}.{key}".lstrip(".")) for key, form in forms.items())
        return next(filter(None, each), "")
    if wanted is None:
        fits = value is None
    elif wanted is NAME:
        fits = isinstance(value, str) and is_file_name(value)
    elif wanted is float:
        fits = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    elif wanted is int:
        fits = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 1 << 63
    else:
        fits = isinstance(value, wanted)
    return "" if fits else f"{place or 'it'} is {short(value)}, not {WORDS[wanted]}"


def is_file_name(text: str) -> bool:
    """True if the text names a file of the folder that it is put into, never one elsewhere."""
    return text not in ("", ".", "..") and not set(text) & set("/\\\0")


def short(value: Any) -> str:
    """A value in a few letters."""
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
