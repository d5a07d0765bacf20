"""What a message says, whatever its words: the facts in it."""

from __future__ import annotations

import re


def holds(text: str, *facts: str | float) -> bool:
    """Whether a text has all the facts, numbers, names or single words, in that order."""
    pattern = ".*?".join(rf"(?<!\w){re.escape(str(fact))}(?!\w)" for fact in facts)
    return re.search(pattern, text, re.DOTALL) is not None


def any_holds(texts: list[str], *facts: str | float) -> bool:
    """Whether one of the texts `holds` the facts."""
    return any(holds(text, *facts) for text in texts)
