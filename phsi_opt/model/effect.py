"""TODO."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from phsi_opt.errors import ModelError
from phsi_opt.model.parameters import Scan, Tried
from phsi_opt.model.slots import SLOTS
from phsi_opt.model.terms import Dictionary


@dataclass(frozen=True)
class Effect:
    """A named effect: ``term`` acts in ``slot`` ('H', 'R', 'F' or 'sensor') of
    ``equation`` (a state).

    ``memory`` holds further states that the effect needs, such as the lagged input,
    each with its rate of change.
    """

    name: str
    slot: str
    equation: str
    term: Dictionary
    memory: Mapping[str, Dictionary] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.slot not in SLOTS:
            raise ModelError(
                f"effect {self.name!r}: slot {self.slot!r} is unknown; expected {', '.join(SLOTS)}."
            )
        if not isinstance(self.term, Dictionary) or not self.term.terms:
            raise ModelError(
                f"effect {self.name!r} has no term; write it with formula(...) or polynomials(...)."
            )
        object.__setattr__(self, "memory", MappingProxyType(dict(self.memory)))

    def __reduce__(self) -> tuple[object, ...]:  # a mappingproxy cannot be pickled
        return Effect, (
            self.name,
            self.slot,
            self.equation,
            self.term,
            dict(self.memory),
        )

    def __str__(self) -> str:
        return f"{self.name} on {self.equation}"


def is_scanned(effect: Effect) -> bool:
    """Whether the effect has an inner parameter that is scanned."""
    terms = [
        *effect.term,
        *(term for rates in effect.memory.values() for term in rates),
    ]
    return any(
        isinstance(p.guess, Scan | Tried) for term in terms for p in term.inner.values()
    )


def is_wave(effect: Effect) -> bool:
    """Whether the effect has a frequency that is scanned, so that its terms are parts
    of a wave.
    """
    return any(
        isinstance(p.guess, Scan) for term in effect.term for p in term.inner.values()
    )
