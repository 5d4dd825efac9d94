"""The terms that a learned force may be written as."""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from phsi_opt.model.catalogue_losses import FRICTION_TURNOVER
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Term

PLACES = np.linspace(0.04, 0.96, 16)  # of corners and pulses: quantiles of the variable
WIDTHS = (0.05, 0.1, 0.2, 0.4)  # of pulses: shares of the variable's range
POWERS = ("{v}", "{v}*abs({v})", "{v}**2", "{v}**3", "{v}**4", "{v}**5")
SINES = ("sin({v})", "cos({v})")
# The sign of the variable, rounded as the catalogue's Coulomb friction is.
ROUNDED_SIGN = "{v}*({v}**4 + turnover**4)**(-0.25)"
CORNERS = ("max({v} - corner, 0)", "max(corner - {v}, 0)")
PULSE = "exp(-(({v} - centre)/width)**2)"
PRODUCTS = (
    *("{a}*{b}", "{a}**2*{b}", "{a}*{b}**2", "{a}**3*{b}", "{a}**2*{b}**2"),
    *("{a}*{b}**3", "{a}*abs({b})", "abs({a})*{b}"),
)


def candidates(names: Sequence[str], v: np.ndarray) -> Iterator[Term]:
    """A constant, the terms of each variable, and the products of two.

    Args:
        names: of the variables.
        v: their values, (n, n_variables).
    """
    yield Term("1")
    for name, values in zip(names, v.T, strict=True):
        for body in (*POWERS, *SINES):
            yield Term(body.format(v=name))
        size = float(np.sqrt(np.mean(values**2)))
        turnover = Parameter(FRICTION_TURNOVER * size, fixed=True)
        yield Term(ROUNDED_SIGN.format(v=name), None, {"turnover": turnover})
        for place in np.quantile(values, PLACES).tolist():
            yield from _at_a_place(name, Parameter(place), float(np.ptp(values)))
    for a, b in combinations(names, 2):
        for body in PRODUCTS:
            yield Term(body.format(a=a, b=b))


def _at_a_place(name: str, place: Parameter, spread: float) -> Iterator[Term]:
    """Corners and pulses of a variable that has such a spread."""
    for body in CORNERS:
        yield Term(body.format(v=name), None, {"corner": place})
    for share in WIDTHS:
        width = Parameter(share * spread, lower=0.0)
        inner = {"centre": place, "width": width}
        yield Term(PULSE.format(v=name), None, inner)
