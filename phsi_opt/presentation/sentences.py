"""Sentences by templates, so that what is said stands in one place, and reads as said.

A template is a file of macros beside the room's code, each an `Answer`: its lead and,
behind "||", its detail. Lines may be broken and indented as the template's own reader
likes; in the answer blanks are single, and none stands before a stop or a comma.
"""

import re
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from phsi_opt.presentation.content import Answer
from phsi_opt.presentation.numbers import capitalised, lowered, number, with_error

BEHIND_LEAD = "||"
# Blanks before a stop or a comma, and inside of brackets.
UNWANTED = re.compile(r" (?=[.,;:](?:\s|$)|\))|(?<=\() ")
FILTERS = {
    "number": number,
    "estimate": with_error,
    "capital": capitalised,
    "lowered": lowered,
}


def environment(package: str, folder: str = "", **settings: Any) -> Environment:
    """The templates of a package, with the filters that all of them use."""
    loader = PackageLoader(package, folder)
    found = Environment(loader=loader, undefined=StrictUndefined, **settings)
    found.filters |= FILTERS
    found.tests["startingwith"] = str.startswith
    return found


@cache
def _words(package: str) -> Template:
    return environment(package).get_template("words.jinja")


def say(package: str, name: str, **facts: Any) -> Answer:
    """What the macro of a name in the package's ``words.jinja`` says of facts."""
    macro = getattr(_words(package).make_module(facts), name)
    lead, _, detail = macro().partition(BEHIND_LEAD)
    return Answer(_one_line(lead), _one_line(detail))


def _one_line(text: str) -> str:
    return UNWANTED.sub("", " ".join(text.split()))
