"""A curve along a record as a sum of a few terms: forward selection by the Bayesian
information criterion.

Curve and candidates are compared by their traces in the residuals of the measurements,
beside the physics: what the noise hides does not count, and a term that stands in for a
parameter of the physics leaves no trace.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.optimize import minimize

from phsi_opt.learning.orthogonal_network import NOTHING, Record, Response
from phsi_opt.model.backends import NUMPY
from phsi_opt.model.catalogue_losses import FRICTION_TURNOVER
from phsi_opt.model.expressions import evaluate
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Term
from phsi_opt.statistics import autocorrelation_time

PLACES, WIDTHS = (
    np.linspace(0.04, 0.96, 16),
    (0.05, 0.1, 0.2, 0.4),
)  # of corners and pulses: quantiles, shares of range
N_REFINING = 40  # values of place and width that are tried for a chosen term
# share of a term's size beyond the physics below which the physics has the term
SPANNED = 1e-6
PRODUCTS = (
    (1, 1),
    (2, 1),
    (1, 2),
    (3, 1),
    (2, 2),
    (1, 3),
)  # exponents of two variables


def short_form(
    names: Sequence[str],
    record: Record,
    response: Response,
    curve: np.ndarray,
    most: int,
    share: float,
) -> list[Term]:
    """At most ``most`` terms, each with its coefficient, that explain a share of a
    curve (n,); [] if there are none.

    A term is added while BIC = (squared traces that are left) / unit + (number of
    parameters) log n falls. The unit is the variance of the residuals beside the curve,
    and they count for the independent ones they are worth.
    """
    target = response.traces(curve[:, None])[:, 0]
    rest = response.residual - target
    unit = max(float(np.mean(rest**2)), 1.0) * autocorrelation_time([rest])
    price = np.log(max(len(rest) / autocorrelation_time([rest]), 2.0))  # of a parameter
    listed = [
        (term, c)
        for term in candidates(names, record.v)
        if (c := _values(names, record, term)) is not None
    ]
    traces = response.traces(np.column_stack([values for _, values in listed]))
    terms: list[Term] = []
    columns, left = np.zeros((len(target), 0)), float(target @ target)
    whole, bic = left, left / unit
    while len(terms) < most:
        spent = sum(map(_n_parameters, terms))
        scores = [
            _misfit(columns, traces[:, i], target) / unit
            + price * (spent + _n_parameters(listed[i][0]))
            for i in range(len(listed))
        ]
        best = int(np.argmin(scores))
        term, column = _refined(
            listed[best][0], traces[:, best], names, record, response, columns, target
        )
        now = _misfit(columns, column, target)
        if now / unit + price * (spent + _n_parameters(term)) >= bic:
            break
        left, bic = now, now / unit + price * (spent + _n_parameters(term))
        terms, columns = [*terms, term], np.column_stack([columns, column])
    if not terms or left > (1 - share) * whole:
        return []
    sizes = _coefficients(columns, target).tolist()
    return [
        replace(term, coefficient=Parameter(size))
        for term, size in zip(terms, sizes, strict=True)
    ]


def candidates(names: Sequence[str], v: np.ndarray) -> Iterator[Term]:
    """Powers, sines, dry friction, corners and pulses of each variable, v (n,
    n_variables), and products of two.
    """
    yield Term("1")
    for name, values in zip(names, v.T, strict=True):
        powers = [f"{name}**{n}" for n in range(2, 6)]
        for body in (
            name,
            f"{name}*abs({name})",
            *powers,
            f"sin({name})",
            f"cos({name})",
        ):
            yield Term(body)
        turnover = Parameter(
            FRICTION_TURNOVER * float(np.sqrt(np.mean(values**2))), fixed=True
        )
        yield Term(
            f"{name}*({name}**4 + turnover**4)**(-0.25)", None, {"turnover": turnover}
        )
        for at in np.quantile(values, PLACES).tolist():
            yield Term(f"max({name} - corner, 0)", None, {"corner": Parameter(at)})
            yield Term(f"max(corner - {name}, 0)", None, {"corner": Parameter(at)})
            for width in WIDTHS:
                inner = {
                    "centre": Parameter(at),
                    "width": Parameter(width * float(np.ptp(values)), lower=0.0),
                }
                yield Term(f"exp(-(({name} - centre)/width)**2)", None, inner)
    for a, b in combinations(names, 2):
        for i, j in PRODUCTS:
            yield Term(f"{a}**{i}*{b}**{j}".replace("**1", ""))
        yield Term(f"{a}*abs({b})")
        yield Term(f"abs({a})*{b}")


def _refined(
    term: Term,
    column: np.ndarray,
    names: Sequence[str],
    record: Record,
    response: Response,
    columns: np.ndarray,
    target: np.ndarray,
) -> tuple[Term, np.ndarray]:
    """The term with the place and width, near those that were tried, that leave least;
    and its trace.
    """
    free = [name for name, parameter in term.inner.items() if not parameter.fixed]
    start = np.array([term.inner[name].start for name in free])
    scale = WIDTHS[0] * float(np.max(np.ptp(record.v, axis=0)))
    best, least = (term, column), _misfit(columns, column, target)

    def left(step: np.ndarray) -> float:
        nonlocal best, least
        values = dict(zip(free, (start + scale * step).tolist(), strict=True))
        if any(
            not term.inner[name].lower < value < term.inner[name].upper
            for name, value in values.items()
        ):
            return float(target @ target)
        inner = {
            name: replace(p, value=values.get(name, p.value))
            for name, p in term.inner.items()
        }
        made = replace(term, inner=inner)
        curve = _values(names, record, made)
        if curve is None:
            return float(target @ target)
        trace = response.traces(curve[:, None])[:, 0]
        misfit = _misfit(columns, trace, target)
        if misfit < least:
            best, least = (made, trace), misfit
        return misfit

    if free:
        simplex = np.vstack([np.zeros(len(free)), np.eye(len(free))])
        minimize(
            left,
            simplex[0],
            method="Nelder-Mead",
            options={"maxfev": N_REFINING, "initial_simplex": simplex},
        )
    return best


def _values(names: Sequence[str], record: Record, term: Term) -> np.ndarray | None:
    """The term along the record, (n,); None where it is not finite, or nothing that the
    physics has not.
    """
    known = dict(zip(names, record.v.T, strict=True)) | {
        name: p.start for name, p in term.inner.items()
    }
    with np.errstate(all="ignore"):
        values = np.broadcast_to(evaluate(term.body, known, NUMPY), record.w.shape)
    scaled = values / record.std
    beyond = np.linalg.norm(scaled - record.physics @ (record.physics.T @ scaled))
    return (
        values
        if np.isfinite(beyond) and beyond > SPANNED * np.linalg.norm(scaled)
        else None
    )


def _n_parameters(term: Term) -> int:
    return 1 + sum(not parameter.fixed for parameter in term.inner.values())


def _coefficients(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.lstsq(columns, target, rcond=NOTHING)[0])


def _misfit(columns: np.ndarray, further: np.ndarray, target: np.ndarray) -> float:
    both = np.column_stack([columns, further])
    return float(np.sum((target - both @ _coefficients(both, target)) ** 2))
