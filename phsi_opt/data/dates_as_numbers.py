"""Dates that were written as one number, such as 20210131 for the 31st of January 2021.

As numbers their differences are no times: from the 31st to the next day it is 70.
Numbers of 8, 10, 12 or 14 digits are told to be dates where each of them has a year,
month, day, hour, minute and second that there can be. Seconds since 1970, and parts of
seconds, have other lengths or begin with no such year.
"""

import datetime as dt
import re
from typing import Any

import numpy as np

# The signs of strptime after the year, with the numbers that each may stand for.
DATE_PARTS = (
    ("%m", 1, 12),
    ("%d", 1, 31),
    ("%H", 0, 23),
    ("%M", 0, 59),
    ("%S", 0, 59),
)
FEWEST_DATE_PARTS = 2  # after the year: month and day
FIRST_YEAR = 1900
LAST_YEAR = 2100
WHOLE_NUMBER = re.compile(r"(\d+)(\.0*)?")


def format_of_dates(values: np.ndarray) -> str:
    """How numbers are dates, in the signs of strptime; "" where they are none.

    Args:
        values: (n_samples,), NaN where a cell is missing.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        return ""
    whole = np.floor(known)
    is_whole = bool(np.all(known == whole))
    # Only seconds have decimals.
    fewest = FEWEST_DATE_PARTS if is_whole else len(DATE_PARTS)
    for n_parts in range(fewest, len(DATE_PARTS) + 1):
        if _are_dates(whole, n_parts):
            signs = "".join(sign for sign, _, _ in DATE_PARTS[:n_parts])
            return f"%Y{signs}" if is_whole else f"%Y{signs}.%f"
    return ""


def _are_dates(values: np.ndarray, n_parts: int) -> bool:
    """Whether all values are a year and so many parts of two digits each."""
    rest = values
    for _, low, high in reversed(DATE_PARTS[:n_parts]):
        rest, part = np.divmod(rest, 100)
        if np.any((part < low) | (part > high)):
            return False
    return bool(np.all((rest >= FIRST_YEAR) & (rest <= LAST_YEAR)))


def moment_in(cell: Any, form: str) -> dt.datetime | None:
    """The date that a text or a number is; None where it is none of this form.

    Args:
        cell: of a table; spreadsheets write 20210131 as 20210131.0.
        form: in the signs of strptime.
    """
    text = str(cell).strip()
    whole = WHOLE_NUMBER.fullmatch(text)
    if whole is not None and not form.endswith("%f"):
        text = whole[1]
    elif whole is not None and not whole[2]:
        text += ".0"
    try:
        return dt.datetime.strptime(text, form)
    except ValueError:
        return None
