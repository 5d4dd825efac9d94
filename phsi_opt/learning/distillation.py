"""A curve along a record as a sum of a few terms: forward selection by BIC.

Curve and candidates are compared by their traces in the residuals of the measurements,
beside the physics: what the noise hides does not count, and a term that stands in for a
parameter of the physics leaves no trace.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from phsi_opt.learning.force_response import Response
from phsi_opt.learning.force_samples import RANK_TOLERANCE, ForceSamples
from phsi_opt.learning.term_candidates import WIDTHS, candidates
from phsi_opt.model.backends import NUMPY
from phsi_opt.model.expressions import evaluate
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Term
from phsi_opt.statistics import autocorrelation_time

N_REFINING = 40  # values of place and width that are tried for a chosen term
# Share of a term's size beyond the physics below which the physics has the term.
SPANNED = 1e-6


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
        names: of the variables.
        samples: their values, and the physics.
        response: of the residuals to a force.
        curve: (n,), the force along the record.
        most: number of terms.
        share: of the curve's squared trace that the terms must explain.

    Returns:
        The terms; [] if there are none.
    """
    target = response.traces(curve[:, None])[:, 0]
    problem = _Problem(names, samples, response, target, _criterion(response, target))
    listed = problem.listed()
    empty = np.zeros((len(target), 0))
    nothing = float(target @ target)
    chosen = _Selection((), empty, nothing, problem.criterion.of(nothing, 0))
    while len(chosen.terms) < most:
        best = min(listed, key=lambda trial: problem.bic(chosen, trial))
        further = problem.with_term(chosen, problem.refined(chosen, best))
        if further.bic >= chosen.bic:
            break
        chosen = further
    if not chosen.terms or chosen.left > (1 - share) * nothing:
        return []
    terms = []
    coefficients = _least_squares(chosen.traces, target).tolist()
    for term, coefficient in zip(chosen.terms, coefficients, strict=True):
        terms.append(replace(term, coefficient=Parameter(coefficient)))
    return terms


@dataclass(frozen=True)
class _Criterion:
    """BIC of squares that are left.

    Attributes:
        unit: the squares of which each counts as one: variance of the residuals, times
            how many of them are worth one that is independent.
        price: of a parameter: log of the number of independent residuals.
    """

    unit: float
    price: float

    def of(self, squares: float, n_parameters: int) -> float:
        """The criterion; less is better."""
        return squares / self.unit + self.price * n_parameters


def _criterion(response: Response, target: np.ndarray) -> _Criterion:
    rest = response.residual - target
    together = autocorrelation_time([rest])
    # Residuals are in units of the noise: less than one is luck.
    unit = max(float(np.mean(rest**2)), 1.0) * together
    return _Criterion(unit, float(np.log(max(len(rest) / together, 2.0))))


@dataclass(frozen=True, eq=False)
class _Trial:
    """A term and its trace (n_values,) in the residuals."""

    term: Term
    trace: np.ndarray


@dataclass(frozen=True, eq=False)
class _Selection:
    """The terms so far.

    Attributes:
        terms: without coefficients.
        traces: (n_values, n_terms), theirs.
        left: sum of the squares of the target that they do not explain.
        bic: the criterion.
    """

    terms: tuple[Term, ...]
    traces: np.ndarray
    left: float
    bic: float

    @property
    def n_parameters(self) -> int:
        """Of all terms, their coefficients included."""
        return sum(_n_parameters(term) for term in self.terms)


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is explained, by what, and by which criterion."""

    names: Sequence[str]
    samples: ForceSamples
    response: Response
    target: np.ndarray
    criterion: _Criterion

    def listed(self) -> list[_Trial]:
        """The candidates that the physics has not, with their traces."""
        terms = []
        columns = []
        for term in candidates(self.names, self.samples.v):
            values = self.values(term)
            if values is not None:
                terms.append(term)
                columns.append(values)
        traces = self.response.traces(np.column_stack(columns))
        return [_Trial(term, traces[:, i]) for i, term in enumerate(terms)]

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
        physics = self.samples.physics
        scaled = values / self.samples.std
        beyond = np.linalg.norm(scaled - physics @ (physics.T @ scaled))
        if np.isfinite(beyond) and beyond > SPANNED * np.linalg.norm(scaled):
            return values
        return None

    def left(self, chosen: _Selection, trace: np.ndarray) -> float:
        """Squares of the target that the chosen terms and one more leave."""
        traces = np.column_stack([chosen.traces, trace])
        explained = traces @ _least_squares(traces, self.target)
        return float(np.sum((self.target - explained) ** 2))

    def bic(self, chosen: _Selection, trial: _Trial) -> float:
        """The criterion of the chosen terms and one more."""
        n_parameters = chosen.n_parameters + _n_parameters(trial.term)
        return self.criterion.of(self.left(chosen, trial.trace), n_parameters)

    def with_term(self, chosen: _Selection, trial: _Trial) -> _Selection:
        """The chosen terms and one more."""
        return _Selection(
            (*chosen.terms, trial.term),
            np.column_stack([chosen.traces, trial.trace]),
            self.left(chosen, trial.trace),
            self.bic(chosen, trial),
        )

    def refined(self, chosen: _Selection, trial: _Trial) -> _Trial:
        """The term with the place and width, near those tried, that leave least."""
        free = [name for name, p in trial.term.inner.items() if not p.fixed]
        if not free:
            return trial
        start = np.array([trial.term.inner[name].start for name in free])
        scale = WIDTHS[0] * float(np.max(np.ptp(self.samples.v, axis=0)))
        best = trial
        least = self.left(chosen, trial.trace)

        def left(step: np.ndarray) -> float:
            nonlocal best, least
            values = dict(zip(free, (start + scale * step).tolist(), strict=True))
            moved = self._moved(trial.term, values)
            if moved is None:
                return float(self.target @ self.target)
            squares = self.left(chosen, moved.trace)
            if squares < least:
                best = moved
                least = squares
            return squares

        simplex = np.vstack([np.zeros(len(free)), np.eye(len(free))])
        options = {"maxfev": N_REFINING, "initial_simplex": simplex}
        minimize(left, simplex[0], method="Nelder-Mead", options=options)
        return best

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


def _n_parameters(term: Term) -> int:
    """The coefficient and the free inner parameters."""
    return 1 + sum(not parameter.fixed for parameter in term.inner.values())


def _least_squares(traces: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.lstsq(traces, target, rcond=RANK_TOLERANCE)[0])
