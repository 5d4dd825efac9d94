"""The terms that a learned force may be written as."""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from phsi_opt.model.catalogue_losses import FRICTION_TURNOVER
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Term

PLACES = np.linspace(0.04, 0.96, 16)  # of corners and pulses: quantiles of the variable
WIDTHS = (0.05, 0.1, 0.2, 0.4)  # of pulses: shares of the variable's range
HIGHEST_POWER = 5
# Exponents of the products of two variables.
PRODUCTS = ((1, 1), (2, 1), (1, 2), (3, 1), (2, 2), (1, 3))


def candidates(names: Sequence[str], v: np.ndarray) -> Iterator[Term]:
    """A constant, the terms of each variable, and the products of two.

    Args:
        names: of the variables.
        v: their values, (n, n_variables).
    """
    yield Term("1")
    for name, values in zip(names, v.T, strict=True):
        yield from _smooth(name)
        yield _dry_friction(name, values)
        for place in np.quantile(values, PLACES).tolist():
            yield from _corners(name, place)
            yield from _pulses(name, place, float(np.ptp(values)))
    for a, b in combinations(names, 2):
        yield from _products(a, b)


def _smooth(name: str) -> Iterator[Term]:
    """Powers and sines."""
    yield Term(name)
    yield Term(f"{name}*abs({name})")
    for power in range(2, HIGHEST_POWER + 1):
        yield Term(f"{name}**{power}")
    yield Term(f"sin({name})")
    yield Term(f"cos({name})")


def _dry_friction(name: str, values: np.ndarray) -> Term:
    """The sign of the variable, rounded as the catalogue's Coulomb friction is."""
    size = float(np.sqrt(np.mean(values**2)))
    turnover = Parameter(FRICTION_TURNOVER * size, fixed=True)
    body = f"{name}*({name}**4 + turnover**4)**(-0.25)"
    return Term(body, None, {"turnover": turnover})


def _corners(name: str, place: float) -> Iterator[Term]:
    yield Term(f"max({name} - corner, 0)", None, {"corner": Parameter(place)})
    yield Term(f"max(corner - {name}, 0)", None, {"corner": Parameter(place)})


def _pulses(name: str, place: float, spread: float) -> Iterator[Term]:
    for share in WIDTHS:
        width = Parameter(share * spread, lower=0.0)
        inner = {"centre": Parameter(place), "width": width}
        yield Term(f"exp(-(({name} - centre)/width)**2)", None, inner)


def _products(a: str, b: str) -> Iterator[Term]:
    for i, j in PRODUCTS:
        yield Term(f"{a}**{i}*{b}**{j}".replace("**1", ""))
    yield Term(f"{a}*abs({b})")
    yield Term(f"abs({a})*{b}")
