"""Sentences by templates, so that what is said stands in one place, and reads as said.

A template is a file of macros beside the room's code, called ``tell_`` and a name. Each
is an `Answer`: its lead and, each behind "||", its detail and how a program does it.
Lines may be broken and indented at will; in the answer blanks are single, and none
stands before a stop or a comma.
"""

import re
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

from phsi_opt.errors import some_of
from phsi_opt.presentation.content import Answer, unestablished_words, verdict_words
from phsi_opt.presentation.numbers import (
    called,
    capitalised,
    enumerated,
    lowered,
    number,
    p_value_words,
    percent,
    proper_names,
    said,
    typeset,
    with_error,
    with_interval,
)
from phsi_opt.presentation.units import (
    date_words,
    frequency_words,
    scale_of,
    scale_of_errors,
    spaced,
)

if TYPE_CHECKING:
    from jinja2 import Environment

BEHIND_LEAD = "||"
# Blanks before a stop or a comma, and inside of brackets.
UNWANTED = re.compile(r" (?=[.,;:](?:\s|$)|\))|(?<=\() ")
GLOBALS = (frequency_words, p_value_words, scale_of, scale_of_errors, spaced)
FILTERS = {
    "number": number,
    "percent": percent,
    "estimate": with_error,
    "with_interval": with_interval,
    "capital": capitalised,
    "enumerated": enumerated,
    "lowered": lowered,
    "unestablished": unestablished_words,
    "verdict": verdict_words,
    "typeset": typeset,
    "said": said,
    "proper": proper_names,
    "some_of": some_of,
    "date": date_words,
    "called": called,
}


@cache
def environment(package: str, folder: str = "", **settings: Any) -> "Environment":
    """The templates of a package; lines with a statement alone leave no trace."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # slow to load

    lines = {"trim_blocks": True, "lstrip_blocks": True}
    loader = PackageLoader(package, folder)
    found = Environment(loader=loader, undefined=StrictUndefined, **lines | settings)
    found.filters |= FILTERS
    found.globals |= {one.__name__: one for one in GLOBALS}
    return found


def say(
    package: str, name: str, numbers: Mapping[str, Any] | None = None, **facts: Any
) -> Answer:
    """What the macro of a name in the package's ``words.jinja`` says of facts.

    Those that are numbers are kept with the answer.
    """
    numbers = numbers or {}
    parts = _told(package, "words.jinja", name, {**numbers, **facts}).split(BEHIND_LEAD)
    lead, detail, how = (*map(_one_line, parts), "", "")[:3]
    return Answer(lead, detail, how=how, numbers=numbers)


def lines(package: str, name: str, **facts: Any) -> str:
    """What the macro of a name in ``answers.jinja`` says, whose lines are kept."""
    return _told(package, "answers.jinja", name, facts).rstrip("\n")


def _told(package: str, file: str, name: str, facts: dict[str, Any]) -> str:
    is_by_lines = file == "answers.jinja"
    found = environment(package, trim_blocks=is_by_lines, lstrip_blocks=is_by_lines)
    module = found.get_template(file).make_module(facts)
    return str(getattr(module, f"tell_{name}")())


def _one_line(text: str) -> str:
    return UNWANTED.sub("", " ".join(text.split()))
