"""Numbers as a reader wants them: few digits, the error behind its value."""

import math
import re

TEXT_DIGITS = 4  # of a number in a text
MINUS = re.compile(r"(?<![\w.)])-(?=\d)")  # before a number, not in 1e-5
UNIT_POWER = re.compile(r"(?<=[A-Za-z%])\^([2-9])")  # formulas have ** for it
SUPERSCRIPTS = dict(zip("23456789", "²³⁴⁵⁶⁷⁸⁹", strict=True))
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


def estimate_text(value: float, std_error: float) -> str:
    """Value and standard error of an equation, in signs that can be typed.

    The value ends with the second digit of its error; further ones say nothing.
    """
    if not math.isfinite(std_error):
        return f"{value:.6g}"
    if std_error <= 0 or not math.isfinite(value):
        return f"{value:.6g} +- {std_error:.2g}"
    size = max(abs(value), std_error)
    n_digits = math.floor(math.log10(size)) - math.floor(math.log10(std_error)) + 2
    return f"{value:.{n_digits}g} +- {std_error:.2g}"


def p_value_words(p_value: float) -> str:
    """A p-value with two digits; below a millionth its size says nothing more."""
    if p_value < LEAST_P_VALUE:
        return f"below {LEAST_P_VALUE:g}"
    return f"{p_value:.2g}"


def typeset(text: str) -> str:
    """A sentence of a terminal as it is printed: ± for +-, rad/s² for rad/s^2."""
    signed = text.replace("+-", "\N{PLUS-MINUS SIGN}")
    return UNIT_POWER.sub(lambda found: SUPERSCRIPTS[found[1]], signed)


def said(text: str) -> str:
    """A sentence with the minus signs that the numbers of a report have."""
    return MINUS.sub("\N{MINUS SIGN}", typeset(text))


def capitalised(text: str) -> str:
    """The text with a capital first letter; the others stay as they are."""
    return f"{text[:1].upper()}{text[1:]}"
