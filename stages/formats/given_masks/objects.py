"""The objects in given masks, and which of them is the person: the largest and most frequent, or the one of `--person`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stages.contract import StageError
from stages.formats.given_masks.mask_set import MaskSet, Values
from stages.formats.given_masks.values import Levels, levels_of

TOUCHING = 0.8
"""Share of the pictures with both from which two labels that touch are parts of one person."""


@dataclass(frozen=True)
class Object:
    """One object: the id that picks it, "" for one without; in how many pictures it is, and its mean share of those pictures."""

    id: str
    pictures: int
    share: float
    levels: dict[int, Levels]
    """What the values of its masks mean, by their rows."""
    values_of: Callable[[int], Values | None]
    labels: frozenset[int] = frozenset()
    """The labels that are its parts, in label masks."""

    def __str__(self) -> str:
        parts = f" (labels {', '.join(map(str, sorted(self.labels)))})" if len(self.labels) > 1 else ""
        return f"{self.id}{parts} covers {self.share:.1%} in {self.pictures} pictures"

    def read(self, row: int) -> np.ndarray | None:
        """Its mask in a row of those given, uint8 [H,W], 255 = marked; None where there is none of it."""
        found = self.values_of(row) if row in self.levels else None
        return None if found is None else self.levels[row].marked(found[0], self.labels)


def pick(objects: Sequence[Object], person: str | int | None) -> Object:
    """The object of that id, or the first of the ranked `objects` if none is asked for; StageError for an unknown id.

    Numbers are compared as such, so that 1 picks the folder 001 where no folder is called 1.
    """
    if person is None:
        return objects[0]
    found = [one for one in objects if one.id == str(person)]
    found += [one for one in objects if is_number(one.id, str(person))]
    named = [str(one) for one in objects[:12] if one.id]
    if not found or not named:
        fact = f"there are: {'; '.join(named)}" if named else f"{objects[0].pictures} masks, each with one object"
        hint = "choose with `--person ID`" if named else "leave out --person"
        raise StageError(f"no person {person} in the given masks", hint, [fact])
    return found[0]


def is_number(a: str, b: str) -> bool:
    """True for equal whole numbers, whatever zeros they begin with."""
    return a.isdecimal() and b.isdecimal() and a.lstrip("0") == b.lstrip("0")


def objects_of(given: MaskSet, rows: Sequence[int]) -> list[Object]:
    """The objects in the `rows` of given masks, the largest and most often seen first; StageError where there are none.

    Without ids or labels it is one without a name.
    """
    found = []
    for name in given.objects:
        values_of = partial(given.read, name)
        whole = Object(name, len(rows), 0.0, levels_of(rows, values_of), values_of)
        if name == "":
            found += labeled_objects(whole) or [whole]
        elif whole.levels:
            masks = (mask for i in whole.levels if (mask := whole.read(i)) is not None)
            shares = [share for mask in masks if (share := float((mask > 127).mean()))]
            found.append(replace(whole, pictures=len(shares), share=sum(shares) / max(len(shares), 1)))
    found = [one for one in found if one.pictures]
    if not found:
        facts = [f"{len(given.objects)} objects"]
        raise StageError("no object in the given masks is in any frame", "check the masks", facts)
    return sorted(found, key=lambda one: (-one.pictures * one.share, one.id))


def labeled_objects(whole: Object) -> list[Object]:
    """The objects in label masks; labels that touch nearly always are parts of one, like the clothes of a person."""
    objects = []
    for levels in {id(one): one for one in whole.levels.values()}.values():
        if levels.few is None or not levels.labels or len(levels.few) <= 2:
            continue
        labels = [int(label) for label in levels.few if label != levels.background]
        group = {label: label for label in labels}
        for (a, b), touch in levels.together.items():
            if a in group and b in group and sum(touch) >= TOUCHING * len(touch):
                group = {label: group[a] if old == group[b] else old for label, old in group.items()}
        for first in sorted(set(group.values())):
            parts = [label for label in labels if group[label] == first]
            pictures = max(len(levels.areas[label]) for label in parts)
            share = sum(sum(levels.areas[label]) for label in parts) / pictures
            labels_of = frozenset(parts)
            objects.append(replace(whole, id=str(first), pictures=pictures, share=share, labels=labels_of))
    return objects
