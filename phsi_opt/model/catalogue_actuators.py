"""Effects between an input and its force: gain, dead zone, saturation, lag and delay.

They are terms of F. Those of an input that the model uses already multiply ``dF_du``,
the slope of the model's own force in the input, so that they need no size of their own.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from phsi_opt.model.base import BaseModel
from phsi_opt.model.catalogue_parts import (
    DELAYS,
    LARGEST_SHARE,
    Delay,
    one_term,
    tried,
)
from phsi_opt.model.effect import Effect
from phsi_opt.model.expressions import names_of
from phsi_opt.model.roles import WORDS, role_of
from phsi_opt.model.terms import Dictionary, formula

INPUT_SIZE = "an error in the size of the input"
INPUT_FORCE_SIZE = "an error in the size of the input's force"
INPUT_DELAY = "a delay of the input"

# Half widths of a dead zone to try, as shares of the largest input.
DEAD_ZONES = (0.005, 0.01, 0.02, 0.04, 0.08, 0.15, 0.25, 0.4, 0.6, 0.8)
# Limits of a saturation to try, as shares of the largest input.
SATURATIONS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98)


def actuators(model: BaseModel, equation: str) -> list[Effect]:
    """What may be between each input and its force in the equation."""
    used: set[str] = set()
    for term in model.terms_at("F", equation):
        used |= names_of(term.body)
    is_force = WORDS[role_of(model, equation)].source == "force"
    effects = []
    for u in model.inputs:
        suffix = "" if len(model.inputs) == 1 else f" of {u}"
        path = _Path(u, equation, suffix, is_force)
        effects += [path.quadratic(), *(path.changes() if u in used else [path.new()])]
    return effects


@dataclass(frozen=True)
class _Path:
    """From an input to the force in an equation."""

    u: str
    equation: str
    suffix: str  # of the effects' names, where there are several inputs
    is_force: bool  # or a flow, a voltage, heat

    @property
    def slope(self) -> str:
        return f"dF_d{self.u}"

    def quadratic(self) -> Effect:
        name = f"quadratic_input_{self.u}_{self.equation}"
        return self._effect("quadratic input", one_term(f"{self.u}**2", name))

    def new(self) -> Effect:
        """A force in proportion to an input that has none yet."""
        return self._gain(self.u)

    def changes(self) -> list[Effect]:
        """What may happen on the way of an input that has a force."""
        return [
            self._gain(f"{self.slope}*{self.u}"),
            self._dead_zone(),
            self._saturation(),
            self._lag(),
            self._delay(),
        ]

    def _effect(
        self,
        kind: str,
        term: Dictionary,
        memory: Mapping[str, Dictionary] | None = None,
    ) -> Effect:
        name = f"{kind}{self.suffix}"
        family = INPUT_FORCE_SIZE if self.is_force else INPUT_SIZE
        if memory:
            family = INPUT_DELAY
        return Effect(name, "F", self.equation, term, memory or {}, family)

    def _parameter(self, kind: str) -> str:
        return f"{kind}_{self.u}_{self.equation}"

    def _gain(self, body: str) -> Effect:
        return self._effect("input gain", one_term(body, self._parameter("input_gain")))

    def _dead_zone(self) -> Effect:
        width = self._parameter("dead_zone")
        body = f"-{self.slope}*{_limited(self.u, width)}"
        inner = {width: tried(self.u, DEAD_ZONES, LARGEST_SHARE)}
        return self._effect("input dead zone", formula(body, **inner))

    def _saturation(self) -> Effect:
        limit = self._parameter("saturation")
        body = f"-{self.slope}*({self.u} - {_limited(self.u, limit)})"
        inner = {limit: tried(self.u, SATURATIONS, LARGEST_SHARE)}
        return self._effect("input saturation", formula(body, **inner))

    def _lag(self) -> Effect:
        """The force follows the lagged input z: lag dz/dt = u - z."""
        lag = self._parameter("lag")
        lagged = f"{self.u}_lagged_{self.equation}"
        force = formula(f"{self.slope}*({lagged} - {self.u})")
        inner = {lag: tried("dt", DELAYS, unit="s")}
        rate = formula(f"({self.u} - {lagged})/{lag}", **inner)
        return self._effect("input lag", force, {lagged: rate})

    def _delay(self) -> Effect:
        state = f"{self.u}_delayed_{self.equation}"
        delay = Delay(self.u, self._parameter("delay"), state)
        return self._effect("input delay", delay.change(self.slope), delay.memory())


def _limited(u: str, limit: str) -> str:
    return f"min(max({u}, -{limit}), {limit})"
