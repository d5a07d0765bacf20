"""YAML as people mean it: 010, 1:30, 1_0, no and dates are text; and no file is too deep or unfolds without end."""

from __future__ import annotations

import re
from typing import Any, ClassVar

import yaml

DEEPEST = 50  # lists and mappings in one another; a pipeline needs five
MOST = 10_000  # values, those behind aliases counted again
FORMS = {
    "null": (r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    "bool": (r"true|True|TRUE|false|False|FALSE", "tTfF"),
    "int": (r"[-+]?(0|[1-9][0-9]*)", "-+0123456789"),
    "float": (r"[-+]?((0|[1-9][0-9]*)\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan", "-+.0123456789"),
    "merge": (r"<<", "<"),
}
"""Forms of values that are no text, with the letters that they begin with (YAML 1.2, without octal numbers)."""


class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Reads plain values only, in these forms."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {}


for name, (form, first) in FORMS.items():
    Loader.add_implicit_resolver(f"tag:yaml.org,2002:{name}", re.compile(rf"({form})\Z"), list(first))


def read(text: str, most: int = MOST) -> Any:
    """The value of a YAML document; ValueError or yaml.YAMLError where it has none or more than `most` values."""
    check_size(text, most)
    return yaml.load(text, Loader)


def check_size(text: str, most: int = MOST) -> None:
    """ValueError for a document that is too deep, too large with its aliases unfolded, or gives a key twice; builds nothing."""
    sizes: dict[str | None, int] = {}  # of what aliases stand for
    open_: list[tuple[str | None, int]] = []  # anchor of each list or mapping not yet ended, and values before it
    keys: list[list[Any]] = []  # of each: those that it has, None for a list, and whether one came last
    count = 0
    for event in yaml.parse(text, Loader):
        if isinstance(event, yaml.NodeEvent) and keys and keys[-1][0] is not None:
            keys[-1][1] = not keys[-1][1]
            if keys[-1][1] and isinstance(event, yaml.ScalarEvent) and event.value != "<<":
                if event.value in keys[-1][0]:
                    raise ValueError(f"{event.value} is given twice, again in line {event.start_mark.line + 1}")
                keys[-1][0].add(event.value)
        if isinstance(event, yaml.AliasEvent):
            count += sizes.get(event.anchor, 0)
        elif isinstance(event, yaml.NodeEvent):
            count += 1
            sizes[event.anchor] = 1 if isinstance(event, yaml.ScalarEvent) else most  # most: it may not hold itself
        if isinstance(event, yaml.CollectionStartEvent):
            open_.append((event.anchor, count))
            keys.append([set() if isinstance(event, yaml.MappingStartEvent) else None, False])
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_.pop()
            keys.pop()
            sizes[anchor] = count - before + 1
        if len(open_) > DEEPEST:
            raise ValueError(f"lists and mappings nested more than {DEEPEST} deep")
        if count > most:
            raise ValueError(f"more than {most} values, counted with aliases unfolded")
