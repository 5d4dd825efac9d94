"""Terms of a study file: a formula, a table for what a formula is not, or a list.

A formula's names are states, inputs, the time, efforts, or parameters of the section
[parameters]. A table has the keys under which fits are saved (body, coefficient, inner,
name), or asks for polynomials or waves.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.expressions import names_of
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Dictionary, Term, polynomials, trigonometric
from phsi_opt.model.variables import Variables
from phsi_opt.study_file.parameter_reading import read_parameter
from phsi_opt.study_file.part import Part

TERM_WAYS = ("body", "polynomials", "trigonometric")


@dataclass(frozen=True)
class TermReader:
    """Reads terms; notes in ``used`` which parameters they ask for."""

    variables: Variables
    parameters: Mapping[str, Parameter | None]
    used: set[str]

    def read(self, part: Part, name: str, slot: str) -> Dictionary:
        """The terms under a key; what is wrong is noted, and left out.

        Args:
            part: the table in which they stand.
            name: the key.
            slot: where they act; it decides which names they may have.
        """
        content = part.content[name]
        listed = content if isinstance(content, list) else [content]
        terms: list[Term] = []
        for one in listed:
            try:
                terms += self._one(part, name, slot, one)
            except ModelError as error:
                part.complaints.add(part.path(name), str(error), one)
        try:
            return Dictionary(tuple(terms))
        except ModelError as error:
            part.complaints.add(part.path(name), str(error), content)
            return Dictionary()

    def _one(self, part: Part, name: str, slot: str, content: Any) -> Dictionary:
        if isinstance(content, str):
            return self._formula(part, name, slot, content)
        if isinstance(content, int | float) and not isinstance(content, bool):
            return self._formula(part, name, slot, str(content))
        if isinstance(content, Mapping):
            table = Part(part.path(name), content, part.complaints)
            table.check_known("term")
            return self._table(table, slot)
        part.complaints.add(
            part.path(name),
            'expected a formula in quotes, such as "c*dH_dp", or a list of them.',
            content,
        )
        return Dictionary()

    def _formula(self, part: Part, name: str, slot: str, text: str) -> Dictionary:
        own = self._own_names(part, name, slot, text, names_of(text))
        inner = {}
        for one, parameter in self.parameters.items():  # in the order of the file
            if one in own and parameter is not None:  # else it is noted what is wrong
                inner[one] = parameter
        return Dictionary((Term(text, None, inner),))

    def _own_names(
        self, part: Part, name: str, slot: str, text: str, names: frozenset[str]
    ) -> set[str]:
        """Those of a formula's names that are parameters; others are noted."""
        variables = self.variables.of_slot(slot)
        own = set()
        for one in sorted(names - variables):
            if one in self.parameters:
                self.used.add(one)
                own.add(one)
                continue
            known = {*variables, *self.parameters}
            part.complaints.add(part.path(name), self._unknown(one, slot, known), text)
        return own

    def _unknown(self, name: str, slot: str, known: set[str]) -> str:
        if slot == "H" and name in self.variables.of_slot("R"):
            return (
                f"{name!r} may not stand in H: an energy depends on the states alone; "
                "put the term into F."
            )
        hint = did_you_mean(name, known)
        return (
            f"{name!r} is not known here; known are {', '.join(sorted(known))}.{hint} "
            "A parameter stands in the section [parameters]: "
            f"{name} = {{ start = 1.0 }}."
        )

    def _table(self, part: Part, slot: str) -> Dictionary:
        way = part.exactly_one(TERM_WAYS)
        if way == "polynomials":
            return polynomials(
                part.texts("polynomials"),
                part.whole("degree", 2) or 2,
                part.flag("constant"),
            )
        if way == "trigonometric":
            n_pairs = part.whole("n", 1) or 1
            frequency = part.number("frequency")
            return trigonometric(part.texts("trigonometric"), n_pairs, frequency)
        if way == "body":
            return Dictionary((self._term(part),))
        return Dictionary()

    def _term(self, part: Part) -> Term:
        """One term with a coefficient; its inner parameters are its own."""
        told = Part(part.key, {"coefficient": {}, **part.content}, part.complaints)
        coefficient = read_parameter(told, "coefficient")
        section = part.part("inner", "parameters")
        inner = {}
        for name in section.content:
            parameter = read_parameter(section, name)
            if parameter is not None:
                inner[name] = parameter
        coefficient = coefficient or Parameter()
        return Term(part.text("body"), coefficient, inner, part.text("name"))
