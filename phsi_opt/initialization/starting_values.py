"""Starting values of the parameters, by convex programs and scans of frequencies.

The loss with the midpoint rule is convex in the coefficients that enter linearly while
R is fixed, so its global optimum is found: by least squares within the bounds, or by
CVXPY where there is an L1 penalty. A frequency is a needle that no local solver finds,
so it is scanned: once it is fixed, the sine and cosine of its wave enter the defects
linearly, and the frequencies at which the defects fall most are starting values. The
states must be known; what to do where they are not is the business of `identify`.
"""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product

import casadi as ca
import numpy as np

from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.initialization.relative_guesses import open_delays, shifts, values_at
from phsi_opt.model.expressions import names_of
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Scan
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.optimization.bounded_step import bounded_least_squares
from phsi_opt.statistics import local_maxima
from phsi_opt.transcription.defects import parameter_slopes
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import STARTING_SCHEME
from phsi_opt.transcription.losses import complete_intervals, mean_square_rate
from phsi_opt.transcription.parameter_vector import Theta

N_STARTS = 3  # frequencies of the scan that are tried
RANK = 1e-8  # share of the largest singular value below which a direction counts not


def starting_values(
    model: Model, grid: Grid, l1: Mapping[str, float]
) -> list[np.ndarray]:
    """Up to `N_STARTS` starting points of theta (n_free,), the best first.

    The states at the nodes of the grid are all known; L1 has a weight by slot.
    """
    grid = complete_intervals(model, grid)
    groups = _linear_groups(model)

    def improved(theta: np.ndarray, rounds: int) -> np.ndarray:
        """Theta with every group at its optimum, found so many times in turn."""
        for group in groups * rounds:
            theta = _with_optimum(model, grid, l1, theta, group)
        return theta

    def squared_defects(theta: np.ndarray) -> float:
        """Sum of the squared finite defects."""
        d = parameter_slopes(model, grid, STARTING_SCHEME, theta, only=[]).d
        return float(np.nansum(np.square(d)))

    starts = [improved(model.theta, rounds=1)]
    for name in open_delays(model):
        place = model.free.index(name)
        scanned = []
        for theta, tau in product(starts, shifts(grid)):
            scanned.append(improved(_with_entry(theta, place, tau), rounds=1))
        starts = sorted(scanned, key=squared_defects)[:N_STARTS]
    linear = list(chain.from_iterable(groups))
    for scan in frequency_scans(model):
        scanned = []
        for theta in starts:
            for omega in _candidate_frequencies(model, grid, theta, linear, scan):
                moved = _with_entry(theta, model.free.index(scan.name), omega)
                # The start carries what the polynomials explained before the wave was
                # there; begin again with it.
                scanned.append(improved(moved, rounds=2))
        starts = sorted(scanned, key=squared_defects)[:N_STARTS]
    return starts


# ---- convex programs -----------------------------------------------------------------


def _linear_groups(model: Model) -> list[list[int]]:
    """Groups of parameters in which the right-hand side is linear, others fixed."""
    # Those of H and F, then those of R; a parameter with a value of its own keeps it.
    rhs = model.rhs()
    arguments = argument_symbols(rhs)
    rates = rhs(*arguments)
    theta = arguments[-1]
    entries = [model.entries[name] for name in model.free]
    groups = []
    for slots in (("H", "F"), ("R",)):
        places = [k for k, entry in enumerate(entries) if entry.slot in slots]
        # Coefficients first: a frequency among them would make its amplitudes look
        # curved.
        coefficients = [k for k in places if entries[k].prunable]
        linear = _with_linear(rates, theta, [], coefficients)
        others = [k for k in places if not entries[k].prunable]
        late = open_delays(model)  # which are linear beside one value alone
        unknown = [k for k in others if entries[k].parameter.value is None]
        unknown = [k for k in unknown if model.free[k] not in late]
        linear = _with_linear(rates, theta, linear, unknown)
        if linear:
            groups.append(sorted(linear))
    return groups


def _with_linear(
    rates: ca.SX, theta: ca.SX, linear: list[int], tried: list[int]
) -> list[int]:
    """The parameters ``linear`` with those tried in which the rates stay linear."""
    if not linear + tried:
        return []
    chosen = theta[linear + tried]
    slopes = ca.jacobian(rates, chosen)
    result = list(linear)
    for column, place in enumerate(tried, len(linear)):
        if not ca.depends_on(slopes[:, column], chosen):
            result.append(place)
    return result


def _with_optimum(
    model: Model,
    grid: Grid,
    l1: Mapping[str, float],
    theta: np.ndarray,
    group: list[int],
) -> np.ndarray:
    """Theta with the coefficients ``group`` at their optimum, others fixed."""
    # The squared defects are linearised, which is exact where they are linear in the
    # group.
    unknown = Theta.of(model, ("",))
    known = parameter_slopes(model, grid, STARTING_SCHEME, theta)
    jacobian = known.slopes[:, group]
    d = known.d.ravel()
    is_usable = np.isfinite(jacobian).all(axis=1) & np.isfinite(d)
    weight = np.sqrt(1 / (mean_square_rate(grid) * grid.n_intervals))
    A = weight * jacobian[is_usable]
    b = A @ theta[group] - weight * d[is_usable]
    scale = 1 / np.maximum(np.linalg.norm(A, axis=0), LEAST_SIZE)
    lower = unknown.lower[group]
    upper = unknown.upper[group]
    weights = unknown.weights(l1)[group] / mean_square_rate(grid)
    z = _optimum(A * scale, b, (lower / scale, upper / scale), weights * scale)
    result = theta.copy()
    if np.all(np.isfinite(z)):
        result[group] = np.clip(z * scale, lower, upper)
    return result


def _optimum(
    A: np.ndarray, b: np.ndarray, bounds: tuple[np.ndarray, np.ndarray], l1: np.ndarray
) -> np.ndarray:
    """Coefficients z of least |A z - b|^2 + l1 |z| within bounds."""
    # Where the loss does not change along a direction (Casimirs of S), rounding errors
    # would set them; the smallest ones are taken there.
    n = A.shape[1]
    lower, upper = bounds
    q, r = np.linalg.qr(np.vstack([A, RANK * np.eye(n)]))
    right = q.T @ np.append(b, np.zeros(n))
    if not np.any(l1):
        return bounded_least_squares(r, right, lower, upper)
    import cvxpy as cp  # takes longer to load than most fits to solve

    z = cp.Variable(n)
    misfit = cp.sum_squares(r @ z - right)
    penalty = cp.sum(cp.multiply(l1, cp.abs(z)))
    below = np.isfinite(lower)
    above = np.isfinite(upper)
    constraints = [z[below] >= lower[below], z[above] <= upper[above]]
    program = cp.Problem(cp.Minimize(misfit + penalty), constraints)
    with warnings.catch_warnings():  # a start need not be accurate to the last digit
        warnings.simplefilter("ignore", UserWarning)
        with suppress(cp.SolverError):
            program.solve(
                solver=cp.CLARABEL, tol_gap_abs=1e-14, tol_gap_rel=1e-12, tol_feas=1e-12
            )
    if z.value is None:  # the program has the penalty, its start can do without
        return bounded_least_squares(r, right, lower, upper)
    return z.value


# ---- scans of frequencies ------------------------------------------------------------


@dataclass(frozen=True)
class FrequencyScan:
    """A frequency to scan."""

    name: str  # of the frequency in the model
    variable: str  # what the wave runs along, such as the time t
    # Names of the coefficients of the terms that share the frequency.
    amplitudes: tuple[str, ...]


def frequency_scans(model: Model) -> list[FrequencyScan]:
    """The frequencies of a model that are to be scanned, without a value yet."""
    found: dict[str, FrequencyScan] = {}
    for placed in model.placed():
        for inner, parameter in placed.term.inner.items():
            guess = parameter.guess
            is_open = parameter.value is None and not placed.term.is_formula
            if isinstance(guess, Scan) and is_open:
                name = placed.parameter_name(inner)
                scan = found.get(name, FrequencyScan(name, guess.variable, ()))
                amplitudes = (*scan.amplitudes, placed.parameter_name())
                found[name] = replace(scan, amplitudes=amplitudes)
    return list(found.values())


def imitators(model: Model) -> set[str]:
    """Coefficients in F that can stand in for a scanned wave over a short record.

    They are those of what the wave runs along, such as polynomials in the time.
    """
    found: set[str] = set()
    waves: set[str] = set()
    for scan in frequency_scans(model):
        found |= _terms_of(scan.variable, model)
        waves |= set(scan.amplitudes)
    return found - waves


def _terms_of(variable: str, model: Model) -> set[str]:
    """Coefficients of the terms in F that contain the variable."""
    found = set()
    for placed in model.placed():
        if placed.slot == "F" and variable in names_of(placed.term.body):
            found.add(placed.parameter_name())
    return found


def frequency_grid(grid: Grid, variable: np.ndarray) -> np.ndarray:
    """Frequencies worth trying, in rad per unit of the variable (n_nodes,).

    From half a period over the record up to nine tenths of the Nyquist frequency, half
    a resolution apart; at most 4000, as each costs a least-squares problem.
    """
    span = float(np.ptp(variable))
    is_inside = np.diff(grid.trajectory) == 0
    steps = np.abs(np.diff(variable)[is_inside])
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) else span
    lowest = np.pi / span
    highest = max(0.9 * np.pi / step, 2 * lowest)
    return np.arange(lowest, highest, lowest / 2)[:4000]


def _candidate_frequencies(
    model: Model,
    grid: Grid,
    theta: np.ndarray,
    linear: Sequence[int],
    scan: FrequencyScan,
) -> list[float]:
    """Peaks of two scans, those of the first one first."""
    # In the first the terms are free that do not contain the variable, in the second
    # all others: over a short record a polynomial in the time imitates a slow wave, so
    # there only fast waves stand out. The amplitudes enter linearly, so that their
    # columns are the same in both. The places ``linear`` in theta are free besides the
    # wave.
    of_variable = _terms_of(scan.variable, model)
    amplitudes = list(map(model.free.index, scan.amplitudes))
    slopes_at = partial(parameter_slopes, model, grid, STARTING_SCHEME)
    remainders = []
    for free in ([i for i in linear if model.free[i] not in of_variable], linear):
        others = [i for i in free if i not in amplitudes]
        start = _without_others(model, theta, others)
        known = slopes_at(start, only=others)
        basis = np.linalg.qr(known.slopes)[0]
        d = known.d.ravel()
        remainders.append((d - basis @ (basis.T @ d), basis))
    start = _without_others(model, theta, [])
    tried = frequency_grid(grid, values_at(model, grid, grid.y, scan.variable, start))
    explained = np.zeros((len(remainders), len(tried)))
    frequency = model.free.index(scan.name)
    for k, omega in enumerate(tried):
        moved = _with_entry(start, frequency, omega)
        columns = slopes_at(moved, only=amplitudes).slopes
        for place, (remainder, basis) in enumerate(remainders):
            beyond = columns - basis @ (basis.T @ columns)
            solution = np.linalg.lstsq(beyond, remainder, rcond=RANK)[0]
            explained[place, k] = np.sum((beyond @ solution) ** 2)
    found: list[float] = []
    for one in explained:
        peaks = np.flatnonzero(local_maxima(one))
        best_first = peaks[np.argsort(-one[peaks])]
        found += tried[best_first[: N_STARTS - 1]].tolist()
    return list(dict.fromkeys(found))


def _with_entry(theta: np.ndarray, index: int, value: float) -> np.ndarray:
    """A copy of theta (n_free,) with another value at one place."""
    result = theta.copy()
    result[index] = value
    return result


def _without_others(
    model: Model, theta: np.ndarray, others: Sequence[int]
) -> np.ndarray:
    """Theta (n_free,) with the coefficients of terms at zero but for ``others``."""
    start = theta.copy()
    for i, name in enumerate(model.free):
        if model.entries[name].prunable and i not in others:
            start[i] = 0.0
    return start
