"""The objects in given masks, and which of them is the person: the largest and most frequent, or the one of `--person`."""

from __future__ import annotations

from dataclasses import dataclass

from stages.contract import StageError
from stages.formats.given_masks.values import ForeignMasks

TOUCHING = 0.8
"""Share of the pictures with both from which two labels that touch are parts of one person."""


@dataclass(frozen=True)
class Object:
    """One object: the id that picks it, in how many pictures it is, and its mean share of those pictures."""

    id: str
    pictures: int
    share: float
    labels: frozenset[int] = frozenset()
    """The labels that are its parts, in label masks."""

    def __str__(self) -> str:
        parts = f" (labels {', '.join(map(str, sorted(self.labels)))})" if len(self.labels) > 1 else ""
        return f"{self.id}{parts} covers {self.share:.1%} in {self.pictures} pictures"


def ranked(objects: list[Object]) -> list[Object]:
    """The largest and most often seen first; objects that are nowhere are left out."""
    return sorted((one for one in objects if one.pictures), key=lambda one: (-one.pictures * one.share, one.id))


def pick(objects: list[Object], person: str | int | None) -> Object:
    """The object of that id, or the first of the ranked `objects` if none is asked for; StageError for an unknown id."""
    if person is None:
        return objects[0]
    found = [one for one in objects if same_id(one.id, str(person))]
    if not found:
        facts = [f"there are: {'; '.join(map(str, objects[:12]))}"]
        raise StageError(f"no person {person!r} in the given masks", "choose with `--person ID`", facts)
    return found[0]


def same_id(a: str, b: str) -> bool:
    """True for equal ids; numbers are compared as such, so that 1 picks the folder 001."""
    return a == b or (a.isdecimal() and b.isdecimal() and a.lstrip("0") == b.lstrip("0"))


def labeled_objects(given: ForeignMasks) -> list[Object]:
    """The objects in label masks; labels that touch nearly always are parts of one, like the clothes of a person."""
    objects = []
    for kind, levels in given.kinds.items():
        if levels.few is None or not given.is_labels(kind) or len(levels.few) <= 2:
            continue
        ground = given.background(kind)
        labels = [int(label) for label in levels.few if label != ground]
        group = {label: label for label in labels}
        for (a, b), touch in levels.together.items():
            if a in group and b in group and sum(touch) >= TOUCHING * len(touch):
                group = {label: group[a] if old == group[b] else old for label, old in group.items()}
        for first in sorted(set(group.values())):
            parts = [label for label in labels if group[label] == first]
            pictures = max(len(levels.areas[label]) for label in parts)
            share = sum(sum(levels.areas[label]) for label in parts) / pictures
            objects.append(Object(str(first), pictures, share, frozenset(parts)))
    return ranked(objects)
