"""What the format of a file held at its limits, and what it has no place for, in words."""

from __future__ import annotations

from collections.abc import Mapping


def held(name: str, clamped: Mapping[str, int]) -> list[str]:
    """The sentence for the file `name`, none where nothing was `clamped`: what in words -> how many Gaussians."""
    said = ", ".join(f"{count} Gaussian{'s' * (count != 1)} {what}" for what, count in clamped.items())
    return [f"{name} has {said}: held at the limit"] if clamped else []


def unmarked(names: str) -> str:
    """The sentence for files or formats that hold Gaussians learned with anti-aliasing and have no mark for it."""
    return f"learned with anti-aliasing, for which {names} {'have' if ',' in names else 'has'} no mark: enable it in the viewer"
