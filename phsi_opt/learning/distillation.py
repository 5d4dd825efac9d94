"""A curve along a record as a sum of a few terms: forward selection by BIC.

Curve and candidates are compared by their traces in the residuals of the measurements,
beside the physics: what the noise hides does not count, and a term that stands in for a
parameter of the physics leaves no trace.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import minimize

from phsi_opt.learning.force_samples import RANK_TOLERANCE, ForceSamples, Response
from phsi_opt.model.backends import NUMPY
from phsi_opt.model.expressions import evaluate
from phsi_opt.model.laws import FRICTION_TURNOVER
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Term
from phsi_opt.statistics import autocorrelation_time, rms

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


def short_form(
    names: Sequence[str],
    samples: ForceSamples,
    response: Response,
    curve: np.ndarray,
    most: int,
    share: float,
) -> list[Term]:
    """A few terms, each with its coefficient, that explain a share of a curve.

    A term is added while BIC = (squared traces that are left) / unit + (number of
    parameters) log n falls. The unit is the variance of the residuals beside the curve,
    and they count for the independent ones they are worth.

    Args:
        names: of the variables; ``samples``: their values, and the physics.
        response: of the residuals to a force.
        curve: (n,), the force along the record.
        most: number of terms; [] if so few do not explain enough.
        share: of the curve's squared trace that they must explain.
    """
    target = response.traces(curve[:, None])[:, 0]
    rest = response.residual - target
    together = autocorrelation_time([rest])
    # Residuals are in units of the noise: less than one is luck.
    unit = max(float(np.mean(rest**2)), 1.0) * together
    price = float(np.log(max(len(rest) / together, 2.0)))
    problem = _Problem(names, samples, response, target, unit, price)
    listed = problem.listed()
    chosen: list[_Trial] = []
    while len(chosen) < most:
        best = min(listed, key=lambda trial: problem.bic([*chosen, trial]))
        further = [*chosen, problem.refined(chosen, best)]
        if problem.bic(further) >= problem.bic(chosen):
            break
        chosen = further
    if not chosen or problem.left(chosen) > (1 - share) * problem.left([]):
        return []
    terms = []
    sizes = problem.coefficients(chosen).tolist()
    for trial, size in zip(chosen, sizes, strict=True):
        terms.append(replace(trial.term, coefficient=Parameter(size)))
    return terms


@dataclass(frozen=True, eq=False)
class _Trial:
    """A term without its coefficient, and its trace (n_values,) in the residuals."""

    term: Term
    trace: np.ndarray

    @property
    def free(self) -> list[str]:
        """Names of the inner parameters that may move."""
        inner = self.term.inner
        return [name for name, parameter in inner.items() if not parameter.fixed]


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is explained, and by what.

    Attributes:
        target: (n_values,), what is explained.
        unit: the squares of which each counts as one.
        price: of a parameter.
    """

    names: Sequence[str]
    samples: ForceSamples
    response: Response
    target: np.ndarray
    unit: float
    price: float

    def listed(self) -> list[_Trial]:
        """The candidates that the physics has not, with their traces."""
        terms = []
        columns = []
        for term in _candidates(self.names, self.samples.v):
            values = self.values(term)
            if values is not None:
                terms.append(term)
                columns.append(values)
        traces = self.response.traces(np.column_stack(columns)).T
        return list(map(_Trial, terms, traces))

    def values(self, term: Term) -> np.ndarray | None:
        """The term along the record, (n,).

        None where it is not finite, or nothing that the physics has not.
        """
        known = dict(zip(self.names, self.samples.v.T, strict=True))
        for name, parameter in term.inner.items():
            known[name] = parameter.start
        with np.errstate(all="ignore"):
            values = evaluate(term.body, known, NUMPY)
            values = np.broadcast_to(values, self.samples.w.shape)
            beyond = np.linalg.norm(self.samples.without_physics(values))
            size = np.linalg.norm(values / self.samples.std)
        is_new = np.isfinite(beyond) and beyond > RANK_TOLERANCE * size
        return values if is_new else None

    def coefficients(self, chosen: Sequence[_Trial]) -> np.ndarray:
        """Those with which the terms explain the target best, (n_terms,)."""
        traces = np.column_stack([trial.trace for trial in chosen])
        found = np.linalg.lstsq(traces, self.target, rcond=RANK_TOLERANCE)
        return found[0]

    def left(self, chosen: Sequence[_Trial]) -> float:
        """Squares of the target that the chosen terms leave."""
        left = self.target
        if chosen:
            traces = np.column_stack([trial.trace for trial in chosen])
            left = left - traces @ self.coefficients(chosen)
        return float(left @ left)

    def bic(self, chosen: Sequence[_Trial]) -> float:
        """The criterion of the chosen terms; less is better."""
        n_parameters = sum(1 + len(trial.free) for trial in chosen)
        return self.left(chosen) / self.unit + self.price * n_parameters

    def refined(self, chosen: Sequence[_Trial], trial: _Trial) -> _Trial:
        """The term with the place and width, near those tried, that leave least."""
        names = trial.free
        if not names:
            return trial
        start = np.array([trial.term.inner[name].start for name in names])
        scale = WIDTHS[0] * float(np.max(np.ptp(self.samples.v, axis=0)))
        tried = [trial]

        def left(step: np.ndarray) -> float:
            values = dict(zip(names, (start + scale * step).tolist(), strict=True))
            moved = self._moved(trial.term, values)
            if moved is None:
                return float(self.target @ self.target)
            tried.append(moved)
            return self.left([*chosen, moved])

        simplex = np.vstack([np.zeros(len(names)), np.eye(len(names))])
        options = {"maxfev": 40, "initial_simplex": simplex}
        minimize(left, simplex[0], method="Nelder-Mead", options=options)
        return min(tried, key=lambda one: self.left([*chosen, one]))

    def _moved(self, term: Term, values: dict[str, float]) -> _Trial | None:
        """The term at other inner values; None where they or it are not possible."""
        inner = dict(term.inner)
        for name, value in values.items():
            parameter = inner[name]
            if not parameter.lower < value < parameter.upper:
                return None
            inner[name] = replace(parameter, value=value)
        moved = replace(term, inner=inner)
        curve = self.values(moved)
        if curve is None:
            return None
        return _Trial(moved, self.response.traces(curve[:, None])[:, 0])


def _candidates(names: Sequence[str], v: np.ndarray) -> Iterator[Term]:
    """A constant, the terms of each variable, and the products of two.

    Their values are (n, n_variables).
    """
    yield Term("1")
    for name, values in zip(names, v.T, strict=True):
        for body in (*POWERS, *SINES):
            yield Term(body.format(v=name))
        size = rms(values)
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
