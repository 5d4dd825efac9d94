"""What several effects of the catalogue share: a term, a scanned parameter, a delay."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from phsi_opt.model.parameters import Parameter, Tried
from phsi_opt.model.terms import Dictionary, Term, formula

# Rims and clipping limits to try, as shares of the largest level or value; closer to
# each other near the largest one, where a limit is passed briefly.
LIMITS = (0.5, 0.6, 0.7, 0.8, 0.88, 0.94, 0.97)
# Upper bound, as a share of the largest value: no rim, play or limit beyond it does
# anything.
LARGEST_SHARE = 1.0
# Lags and delays to try, in times between samples: from a share of one sample on, each
# about 1.6 times the last one.
DELAYS = (
    *(0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0),
    *(13.0, 21.0, 34.0, 55.0, 89.0, 144.0, 233.0),
)


def one_term(
    body: str,
    name: str,
    inner: Mapping[str, Parameter] | None = None,
    lower: float = -np.inf,
) -> Dictionary:
    """A term with a free coefficient of that name, and its lower bound."""
    return Dictionary((Term(body, Parameter(lower=lower), inner or {}, name),))


def underscored(kind: str) -> str:
    """The name of an effect as part of a parameter's name."""
    return kind.replace(" ", "_")


def tried(
    of: str, shares: tuple[float, ...], most: float = np.inf, unit: str = ""
) -> Parameter:
    """A positive parameter that starts at the best of several values, see `Tried`."""
    return Parameter(lower=0.0, unit=unit, guess=Tried(of, shares, most))


@dataclass(frozen=True)
class Delay:
    """A signal s(t - tau), as a term in states that remember the signal.

    Pade's approximation of order three has three states a, b = a', c = a''::

        c' = 120/tau^3 (s - a) - 60/tau^2 b - 12/tau c
        s(t - tau) = s - 2 (s - a) + tau^2/5 c

    The phase is right to 1 % up to tau times the frequency = 4.

    Args:
        signal: name of s.
        tau: name of the delay.
        state: name of a; those of b and c are made from it.
    """

    signal: str
    tau: str
    state: str

    @property
    def _inner(self) -> dict[str, Parameter]:
        return {self.tau: tried("dt", DELAYS, unit="s")}

    @property
    def _rate(self) -> str:
        return f"{self.state}_rate"

    @property
    def _bend(self) -> str:
        return f"{self.state}_bend"

    def change(self, factor: str = "") -> Dictionary:
        """The term s(t - tau) - s(t), times the factor if there is one."""
        change = f"2*({self.state} - {self.signal}) + {self.tau}**2/5*{self._bend}"
        body = f"{factor}*({change})" if factor else change
        return formula(body, **self._inner)

    def memory(self) -> dict[str, Dictionary]:
        """The three states, each with its rate of change."""
        jerk = (
            f"120/{self.tau}**3*({self.signal} - {self.state}) "
            f"- 60/{self.tau}**2*{self._rate} - 12/{self.tau}*{self._bend}"
        )
        return {
            self.state: formula(self._rate),
            self._rate: formula(self._bend),
            self._bend: formula(jerk, **self._inner),
        }
