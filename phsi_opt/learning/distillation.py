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

from phsi_opt.learning.orthogonal_network import (
    RANK_TOLERANCE,
    ForceSamples,
    Response,
)
from phsi_opt.model.expressions import NUMPY, evaluate
from phsi_opt.model.laws import FRICTION_TURNOVER
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Term
from phsi_opt.statistics import autocorrelation_time, rms

PLACES = np.linspace(0.04, 0.96, 16)  # of corners and pulses: quantiles of the variable
WIDTHS = (0.05, 0.1, 0.2, 0.4)  # of pulses: shares of the variable's range
OF_ONE = (
    *("{v}", "{v}*abs({v})", "{v}**2", "{v}**3", "{v}**4", "{v}**5"),
    *("sin({v})", "cos({v})"),
)
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

    A term is added while BIC = (unexplained squared traces) / unit + (number of
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
    problem = _Problem(names, samples, response, target)

    def bic(chosen: Sequence[_Trial]) -> float:
        n_parameters = sum(1 + len(trial.free) for trial in chosen)
        return problem.unexplained(chosen) / unit + price * n_parameters

    listed = problem.listed()
    chosen: list[_Trial] = []
    while len(chosen) < most:
        best = min(listed, key=lambda trial: bic([*chosen, trial]))
        further = [*chosen, problem.refined(chosen, best)]
        if bic(further) >= bic(chosen):
            break
        chosen = further
    enough = (1 - share) * problem.unexplained([])
    if not chosen or problem.unexplained(chosen) > enough:
        return []
    sizes = problem.coefficients(chosen).tolist()
    return [
        replace(trial.term, coefficient=Parameter(size))
        for trial, size in zip(chosen, sizes, strict=True)
    ]


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
    """A trace (n_values,), the target, that terms of variables explain."""

    names: Sequence[str]
    samples: ForceSamples
    response: Response
    target: np.ndarray

    def listed(self) -> list[_Trial]:
        """The candidates that the physics has not, with their traces."""
        known = [(term, self.values(term)) for term in _candidates(self)]
        new = [(term, values) for term, values in known if values is not None]
        columns = np.column_stack([values for _, values in new])
        traces = self.response.traces(columns).T
        return [_Trial(term, x) for (term, _), x in zip(new, traces, strict=True)]

    def values(self, term: Term) -> np.ndarray | None:
        """The term along the record, (n,); None: not finite, or in the physics."""
        known = dict(zip(self.names, self.samples.v.T, strict=True))
        inner = {name: parameter.start for name, parameter in term.inner.items()}
        with np.errstate(all="ignore"):
            values = evaluate(term.body, {**known, **inner}, NUMPY)
            values = np.broadcast_to(values, self.samples.w.shape)
            beyond = np.linalg.norm(self.samples.without_physics(values))
            size = np.linalg.norm(values / self.samples.std)
        is_new = np.isfinite(beyond) and beyond > RANK_TOLERANCE * size
        return values if is_new else None

    def coefficients(self, chosen: Sequence[_Trial]) -> np.ndarray:
        """Those with which the terms explain the target best, (n_terms,)."""
        traces = np.column_stack([trial.trace for trial in chosen])
        return np.linalg.lstsq(traces, self.target, rcond=RANK_TOLERANCE)[0]

    def unexplained(self, chosen: Sequence[_Trial]) -> float:
        """Squares of the target less what the chosen terms explain."""
        rest = self.target
        if chosen:
            traces = np.column_stack([trial.trace for trial in chosen])
            rest = rest - traces @ self.coefficients(chosen)
        return float(rest @ rest)

    def refined(self, chosen: Sequence[_Trial], trial: _Trial) -> _Trial:
        """The term with the best place and width near those tried."""
        names = trial.free
        if not names:
            return trial
        start = np.array([trial.term.inner[name].start for name in names])
        scale = WIDTHS[0] * float(np.max(np.ptp(self.samples.v, axis=0)))
        tried = [trial]

        def error(step: np.ndarray) -> float:
            moved = self._moved(trial.term, names, (start + scale * step).tolist())
            if moved is None:
                return float(self.target @ self.target)
            tried.append(moved)
            return self.unexplained([*chosen, moved])

        simplex = np.vstack([np.zeros(len(names)), np.eye(len(names))])
        options = {"maxfev": 40, "initial_simplex": simplex}
        minimize(error, simplex[0], method="Nelder-Mead", options=options)
        return min(tried, key=lambda one: self.unexplained([*chosen, one]))

    def _moved(
        self, term: Term, names: Sequence[str], values: Sequence[float]
    ) -> _Trial | None:
        """The term at other inner values; None where they or it are not possible."""
        inner = dict(term.inner)
        for name, value in zip(names, values, strict=True):
            parameter = inner[name]
            if not parameter.lower < value < parameter.upper:
                return None
            inner[name] = replace(parameter, value=value)
        moved = replace(term, inner=inner)
        curve = self.values(moved)
        if curve is None:
            return None
        return _Trial(moved, self.response.traces(curve[:, None])[:, 0])


def _candidates(problem: _Problem) -> Iterator[Term]:
    """A constant, the terms of each variable, and the products of two."""
    yield Term("1")
    for v, values in zip(problem.names, problem.samples.v.T, strict=True):
        for body in OF_ONE:
            yield Term(body.format(v=v))
        turnover = Parameter(FRICTION_TURNOVER * rms(values), fixed=True)
        yield Term(ROUNDED_SIGN.format(v=v), None, {"turnover": turnover})
        for place in map(Parameter, np.quantile(values, PLACES).tolist()):
            for body in CORNERS:
                yield Term(body.format(v=v), None, {"corner": place})
            for share in WIDTHS:
                width = Parameter(share * float(np.ptp(values)), lower=0.0)
                inner = {"centre": place, "width": width}
                yield Term(PULSE.format(v=v), None, inner)
    for a, b in combinations(problem.names, 2):
        for body in PRODUCTS:
            yield Term(body.format(a=a, b=b))
