"""Numbers as a reader wants them: few digits, the error behind its value."""

import math

TEXT_DIGITS = 4  # of a number in a text
LEAST_P_VALUE = 1e-6  # below which it only says that chance is ruled out


def number(value: float | None, digits: int = TEXT_DIGITS) -> str:
    """The value with a few digits, "not known" where there is none."""
    if value is None or not math.isfinite(value):
        return "not known"
    return f"{value:.{digits}g}".replace("-", "\N{MINUS SIGN}", 1)


def with_error(value: float, std_error: float) -> str:
    """The value with its standard error, as many decimals as the error has digits."""
    if not math.isfinite(value):
        return "not known"
    if not math.isfinite(std_error) or std_error <= 0:
        return number(value)
    n_decimals = 1 - math.floor(math.log10(std_error))
    if abs(n_decimals) > TEXT_DIGITS + 1:
        return f"{number(value)} \N{PLUS-MINUS SIGN} {std_error:.2g}"
    n_decimals = max(n_decimals, 0)
    text = f"{value:.{n_decimals}f}".replace("-", "\N{MINUS SIGN}", 1)
    return f"{text} \N{PLUS-MINUS SIGN} {std_error:.{n_decimals}f}"


def p_value_words(p_value: float) -> str:
    """A p-value with two digits; below a millionth its size says nothing more."""
    if p_value < LEAST_P_VALUE:
        return f"below {LEAST_P_VALUE:g}"
    return f"{p_value:.2g}"
