"""An effect: a named physical phenomenon is a term in a slot of an equation.

The record only; which effects there are is in the tables of ``laws``.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain

from phsi_opt.arguments import require_known, typed
from phsi_opt.errors import ModelError
from phsi_opt.model.expressions import delays_in, is_linear, names_of
from phsi_opt.model.parameters import Scan, Share, Tried
from phsi_opt.model.slots import SLOTS
from phsi_opt.model.terms import Dictionary, Term, read_only
from phsi_opt.presentation.numbers import number_of
from phsi_opt.presentation.summary import Part, Summarised, Summary, printed_table


@typed
@dataclass(frozen=True)
class Effect:
    """A named effect that can be added to a model.

    Args:
        name: what it is called, such as ``"coulomb friction"``.
        slot: where it acts: ``"H"``, ``"R"``, ``"F"`` or ``"sensor"``.
        equation: the state in whose equation, or at whose sensor, it acts; in R and F
            also a direction, such as ``"p1 - p2"`` for what acts between two bodies.
        term: what it adds there.
        memory: further states that it needs, such as the lagged input, each with its
            rate of change.
        family: the name of its class, which a diagnosis uses if members of the class
            cannot be distinguished, such as ``"a loss that grows with speed"``.

    Raises:
        ModelError: an unknown slot, or no term.

    Examples:
        >>> pull = ph.formula("c/(1 - q)**2", c=ph.Parameter(0.1, unit="N m^2"))
        >>> magnet = ph.Effect("magnet", "F", "p", pull)
        >>> model.add(magnet).free
        ('k', 'R_p', 'c')
    """

    name: str
    slot: str
    equation: str
    term: Dictionary
    memory: Mapping[str, Dictionary] = field(default_factory=dict)
    family: str = ""

    def __post_init__(self) -> None:
        said = f"effect {self.name!r}: slot {self.slot!r} is unknown"
        require_known(self.slot, SLOTS, said)
        if not self.term.terms:
            raise ModelError(
                f"effect {self.name!r} has no term; "
                "write it with formula(...) or polynomials(...)."
            )
        object.__setattr__(self, "memory", read_only(self.memory))

    def __str__(self) -> str:
        return self.name if self.tells_place else f"{self.name} on {self.equation}"

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    @property
    def tells_place(self) -> bool:
        """Whether it acts along a direction of which its name tells the states."""
        if self.equation.isidentifier():
            return False
        words = set(re.findall(r"\w+", self.equation))
        return len(words.intersection(self.name.split())) > 1

    @property
    def names(self) -> set[str]:
        """All names in its terms and in the rates of its memory."""
        return set().union(*(names_of(term.body) for term in self.terms))

    @property
    def needs_clock(self) -> bool:
        """Whether its terms, or the rates of its memory, contain the time t."""
        return "t" in self.names

    @property
    def terms(self) -> list[Term]:
        """Its terms, and those of its memory's rates."""
        return list(chain(self.term, *self.memory.values()))

    @property
    def n_unknowns(self) -> int:
        """Number of its free parameters and of its memory's states."""
        names = set()
        for number, term in enumerate(self.terms):
            for inner, one in term.parameters.items():
                if not one.fixed:
                    names.add(inner or term.name or str(number))
        return len(names) + len(self.memory)


def is_scanned(effect: Effect) -> bool:
    """Whether the effect has an inner parameter that is scanned."""
    guesses = _guesses(effect.terms)
    return is_delay(effect) or any(isinstance(one, Scan | Tried) for one in guesses)


def is_wave(effect: Effect) -> bool:
    """Whether the effect's terms are parts of a wave: their frequency is scanned."""
    return any(isinstance(one, Scan) for one in _guesses(effect.term))


def moves_with_states(effect: Effect, states: Iterable[str]) -> bool:
    """Whether what it does depends on the states of a model, or on their efforts."""
    own = {f"{prefix}{state}" for prefix in ("", "dH_d") for state in states}
    return effect.slot in "HR" or bool(effect.names & own)


def is_delay(effect: Effect) -> bool:
    """Whether the effect has a time that is sought among multiples of the sampling."""
    if any(delays_in(term.body) for term in effect.terms):
        return True
    return "dt" in [getattr(one, "of", "") for one in _guesses(effect.terms)]


def is_decay(effect: Effect) -> bool:
    """Whether it is c (s - x), with s outside of it, in the equation of a state x."""
    x = effect.equation
    body = effect.term.terms[-1].body
    names = names_of(body)
    own = sorted({x, f"dH_d{x}"} & names)
    if effect.slot == "F":
        return bool(own) and not effect.memory and is_linear(body, own)
    return effect.slot == "R" and not names and x.isidentifier()


def _guesses(terms: Iterable[Term]) -> list[Scan | Share | Tried | None]:
    """Those of the parameters inside the terms."""
    return [one.guess for term in terms for one in term.inner.values()]


class EffectList(Summarised, list[Effect]):
    """Effects; in all but how it prints a list."""

    def _summary(self) -> Summary:
        rows = [(one.name, one.equation, one.slot, one.family) for one in self]
        table = printed_table(rows, columns=["effect", "equation", "slot", "family"])
        return Summary(number_of(len(self), "effect"), (Part(table=table),))
