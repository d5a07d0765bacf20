"""What a message holds."""

from __future__ import annotations

from tests.made.said import any_holds, holds


def test_facts_are_whole_words_and_numbers_in_their_order():
    text = "3 of 10 frames (000006 to 000012) are blurred,\nfirst 000006"
    assert holds(text, "3 of 10", "000006", "blurred") and holds(text, 3, 10)
    assert not holds(text, 1) and not holds(text, "blur") and not holds(text, "blurred", "000012")
    assert any_holds(["nothing", text], "frames", "blurred") and not any_holds(
        ["frames", "blurred"], "frames", "blurred"
    )
