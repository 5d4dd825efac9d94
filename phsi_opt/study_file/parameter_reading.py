"""Parameters of a study file: a number, or start, bounds and unit.

A plain number, or ``value``, is known; ``start`` is where the search begins. Recipes
for a start (``guess``) have the names of `phsi_opt.model.parameters`, as in saved fits.
"""

import math
from dataclasses import MISSING, fields
from typing import Any

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.estimation.model_content import GUESSES
from phsi_opt.model.parameters import Parameter, Scan, Share, Tried
from phsi_opt.study_file.part import Part, is_number

NUMBERS = ("share", "most")  # of a guess; lists of numbers are LISTS, the others texts
LISTS = ("sharper", "shares")


def read_parameter(section: Part, name: str) -> Parameter | None:
    """The parameter under a name; None, and what is wrong noted, where it is none."""
    content = section.content[name]
    if is_number(content):
        return _made(section, name, {"value": content, "fixed": True})
    if not isinstance(content, dict):
        section.complain(
            name, "expected a number, or a table such as { start = 1.0, lower = 0 }."
        )
        return None
    part = section.part(name, "parameters.*")
    settings: dict[str, Any] = {
        "lower": part.number("lower", -math.inf),
        "upper": part.number("upper", math.inf),
        "unit": part.text("unit"),
        "per_trajectory": part.flag("per_trajectory"),
        "guess": _guess(part),
        **_value(part),
    }
    return _made(section, name, settings)


def _value(part: Part) -> dict[str, Any]:
    """The value, and whether it is known."""
    start = part.number("start")
    known = part.number("value")
    if start is not None and known is not None:
        part.complain(
            "value",
            "there is a start too; keep value where it is known, start where not.",
        )
    is_fixed = part.flag("fixed") or known is not None
    return {"value": start if known is None else known, "fixed": is_fixed}


def _made(section: Part, name: str, settings: dict[str, Any]) -> Parameter | None:
    try:
        return Parameter(**settings)
    except ModelError as error:
        section.complain(name, str(error))
        return None


def _guess(parameter: Part) -> Scan | Share | Tried | None:
    if "guess" not in parameter.content:
        return None
    part = parameter.part("guess", "parameters.*.guess")
    kind = part.text("kind")
    if kind not in GUESSES:
        part.complain(
            "kind", f"expected {', '.join(GUESSES)}.{did_you_mean(kind, GUESSES)}"
        )
        return None
    settings: dict[str, Any] = {}
    for one in fields(GUESSES[kind]):
        if one.name in part.content:
            settings[one.name] = _setting(part, one.name)
        elif one.default is MISSING:
            part.complain(one.name, f"a guess of kind {kind!r} needs it.")
            return None
    return GUESSES[kind](**settings)


def _setting(part: Part, name: str) -> Any:
    if name in NUMBERS:
        return part.number(name, 0.0)
    if name in LISTS:
        return part.numbers(name)
    return part.text(name)
