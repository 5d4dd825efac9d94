"""What a diagnosis says in one phrase."""

from enum import StrEnum


class Verdict(StrEnum):
    """Whether something is missing in a model, and whether it is known what."""

    NOTHING_MISSING = "nothing missing"
    NAMED = "missing: named"
    PARTLY_NAMED = "missing: partly named"
    UNEXPLAINED = "missing: unexplained"
