"""Frequencies by a scan: a needle that no local solver finds.

Once its frequency is fixed, the sine and cosine of a wave enter the defects linearly.
So the scan solves a linear least-squares problem at every frequency of a grid, and the
frequencies at which the defects fall most are starting values.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from phsi_opt.initialization.relative_guesses import values_at
from phsi_opt.model.expressions import names_of
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Scan
from phsi_opt.model.slots import place_of
from phsi_opt.statistics import local_maxima
from phsi_opt.transcription.defects import KnownDefects, defects
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import STARTING_SCHEME

N_STARTS = 3  # frequencies of the scan that are tried
RANK = (
    1e-8  # share of the largest singular value below which a direction counts as none
)


@dataclass(frozen=True)
class FrequencyScan:
    """A frequency to scan.

    Attributes:
        name: of the frequency in the model.
        variable: what the wave runs along, such as the time t.
        amplitudes: names of the coefficients of the terms that share the frequency.
    """

    name: str
    variable: str
    amplitudes: tuple[str, ...]


def frequency_scans(model: Model) -> list[FrequencyScan]:
    """The frequencies of a model that are to be scanned, without a value yet."""
    found: dict[str, FrequencyScan] = {}
    for slot, equation, term in model.placed():
        place = place_of(slot, equation)
        for inner, parameter in term.inner.items():
            guess = parameter.guess
            is_open = parameter.value is None and not term.is_formula
            if isinstance(guess, Scan) and is_open:
                name = term.inner_name(inner, place)
                scan = found.get(name, FrequencyScan(name, guess.variable, ()))
                amplitudes = (*scan.amplitudes, term.coefficient_name(place))
                found[name] = replace(scan, amplitudes=amplitudes)
    return list(found.values())


def frequency_grid(grid: Grid, variable: np.ndarray) -> np.ndarray:
    """Frequencies worth trying, in rad per unit of the variable.

    From half a period over the record up to nine tenths of the Nyquist frequency, half
    a resolution apart; at most 4000, as each costs a least-squares problem.

    Args:
        grid: which node belongs to which trajectory.
        variable: (n_nodes,) what the wave runs along.
    """
    span = float(np.ptp(variable))
    is_inside = np.diff(grid.trajectory) == 0
    steps = np.abs(np.diff(variable)[is_inside])
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) else span
    lowest = np.pi / span
    highest = max(0.9 * np.pi / step, 2 * lowest)
    return np.arange(lowest, highest, lowest / 2)[:4000]


def candidate_frequencies(
    model: Model,
    grid: Grid,
    theta: np.ndarray,
    linear: Sequence[int],
    scan: FrequencyScan,
) -> list[float]:
    """Peaks of two scans, those of the first one first.

    The first is beside the terms that do not contain the variable, the second beside
    all other terms. Over a short record a polynomial in the time imitates a slow wave,
    so beside it only fast waves stand out.

    Args:
        model: the model with the waves.
        grid: nodes whose states are all known (``grid.y``).
        theta: (n_free,) values of the other parameters.
        linear: places in theta of the coefficients that are free beside the wave.
        scan: the frequency.
    """
    of_variable = _terms_of(scan.variable, model)
    beside_others = [i for i in linear if model.free[i] not in of_variable]
    found: list[float] = []
    for best in _best_frequencies(model, grid, theta, (beside_others, linear), scan):
        found += best[: N_STARTS - 1]
    return list(dict.fromkeys(found))


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
    for slot, equation, term in model.placed():
        if slot == "F" and variable in names_of(term.body):
            found.add(term.coefficient_name(place_of(slot, equation)))
    return found


def squared_defects(model: Model, grid: Grid, theta: np.ndarray) -> float:
    """Sum of the squared finite defects of the known states at theta (n_theta,)."""
    d = defects(model, grid, STARTING_SCHEME, ca.DM(grid.y.T), theta)
    return float(np.nansum(np.square(np.array(d))))


def with_entry(theta: np.ndarray, index: int, value: float) -> np.ndarray:
    """A copy of theta (n_theta,) with another value at one place."""
    result = theta.copy()
    result[index] = value
    return result


def _best_frequencies(
    model: Model,
    grid: Grid,
    theta: np.ndarray,
    besides: Sequence[Sequence[int]],
    scan: FrequencyScan,
) -> list[list[float]]:
    """The frequencies with the deepest minima of the squared defects, the best first.

    For each of several sets of linear terms that are free beside the amplitudes. These
    enter linearly, so that their columns are the same beside all of them.
    """
    frequency = model.free.index(scan.name)
    amplitudes = list(map(model.free.index, scan.amplitudes))
    remainders = []
    for beside in besides:
        others = [i for i in beside if i not in amplitudes]
        start = _without_others(model, theta, others)
        known = KnownDefects(model, grid, STARTING_SCHEME, only=others).at(start)
        basis = np.linalg.qr(known.slopes)[0]
        d = known.d.ravel()
        remainders.append((d - basis @ (basis.T @ d), basis))
    waves = KnownDefects(model, grid, STARTING_SCHEME, only=amplitudes)
    start = _without_others(model, theta, [])
    tried = frequency_grid(grid, values_at(model, grid, grid.y, scan.variable, start))
    explained = np.zeros((len(besides), len(tried)))
    for k, omega in enumerate(tried):
        columns = waves.at(with_entry(start, frequency, omega)).slopes
        for place, (left, basis) in enumerate(remainders):
            beyond = columns - basis @ (basis.T @ columns)
            solution = np.linalg.lstsq(beyond, left, rcond=RANK)[0]
            explained[place, k] = np.sum((beyond @ solution) ** 2)
    found = []
    for of_one in explained:
        peaks = np.flatnonzero(local_maxima(of_one))
        best_first = peaks[np.argsort(-of_one[peaks])]
        found.append(tried[best_first[:N_STARTS]].tolist())
    return found


def _without_others(
    model: Model, theta: np.ndarray, others: Sequence[int]
) -> np.ndarray:
    """Theta (n_free,) with the coefficients of terms at zero but for ``others``."""
    start = theta.copy()
    for i, name in enumerate(model.free):
        if model.entries[name].prunable and i not in others:
            start[i] = 0.0
    return start
