"""Reasons why a candidate is not named, as short as a cell of a table wants them."""

import re

UNCLEAR_SIZE = re.compile(r"the size of .*?, .*?, (may as well be zero|is not clear)")
BY_CHANCE = "no better than chance"


def brief_reason(lost: str) -> str:
    """The reason without the effect and the size that the row tells anyway."""
    found = UNCLEAR_SIZE.match(lost)
    if found is not None:
        return f"its size {found[1]}"
    if lost.startswith(BY_CHANCE):
        return BY_CHANCE
    return lost
