"""TODO."""

import casadi as ca
import numpy as np

from phsi_opt.model.expressions import names_of
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Scan
from phsi_opt.model.slots import place_of
from phsi_opt.transcription.defects import defect_jacobian, defects
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import STARTING_SCHEME

N_STARTS = 3  # frequencies of the scan that are tried


def frequency_scans(model: Model) -> list[tuple[str, list[str], str]]:
    """Frequencies to scan: name, names of the amplitudes that share it, variable."""
    found: dict[str, tuple[str, list[str], str]] = {}
    for slot, equation, term in model.placed():
        for inner, parameter in term.inner.items():
            if (
                isinstance(parameter.guess, Scan)
                and parameter.value is None
                and term.coefficient is not None
            ):
                place = place_of(slot, equation)
                name = term.inner_name(inner, place)
                found.setdefault(name, (name, [], parameter.guess.variable))[1].append(
                    term.coefficient_name(place)
                )
    return list(found.values())


def frequency_grid(grid: Grid, variable: np.ndarray) -> np.ndarray:
    """Frequencies worth trying: half a period over the record up to the Nyquist
    frequency, half a resolution apart.
    """
    span = float(np.ptp(variable))
    steps = np.abs(np.diff(variable)[np.diff(grid.trajectory) == 0])
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else span
    lowest = np.pi / span
    return np.arange(lowest, max(0.9 * np.pi / step, 2 * lowest), lowest / 2)[:4000]


def candidate_frequencies(
    model: Model,
    grid: Grid,
    theta: np.ndarray,
    groups: list[list[int]],
    name: str,
    amplitudes: list[str],
    variable: str,
) -> list[float]:
    """Peaks of two scans: beside all other terms, and beside those alone that do not
    contain the variable.

    Over a short record a polynomial in the time imitates a slow wave, so beside it only
    fast waves stand out.
    """
    beside_all = [i for group in groups for i in group]
    along = {
        term.coefficient_name(place_of(slot, equation))
        for slot, equation, term in model.placed()
        if slot == "F" and variable in names_of(term.body)
    }
    inner = [i for i in beside_all if model.free[i] not in along]
    found = []
    for others in [beside_all] if inner == beside_all else [inner, beside_all]:
        found += _best_frequencies(
            model, grid, theta, others, name, amplitudes, variable
        )[: N_STARTS - 1]
    return list(dict.fromkeys(found))


def squared_defects(model: Model, grid: Grid, theta: np.ndarray) -> float:
    return float(
        np.nansum(
            np.square(
                np.array(defects(model, grid, STARTING_SCHEME, ca.DM(grid.y.T), theta))
            )
        )
    )


def _best_frequencies(
    model: Model,
    grid: Grid,
    theta: np.ndarray,
    beside: list[int],
    name: str,
    amplitudes: list[str],
    variable: str,
) -> list[float]:
    """The frequencies with the deepest local minima of the squared defects, amplitudes
    and all linear terms free.
    """
    order = list(model.free)
    own = [order.index(a) for a in amplitudes]
    others = [i for i in beside if i not in own]
    start = theta.copy()
    start[
        [
            i
            for i, n in enumerate(order)
            if model.entries[n].prunable and i not in others
        ]
    ] = 0.0
    d = np.array(
        defects(model, grid, STARTING_SCHEME, ca.DM(grid.y.T), start)
    ).T.ravel()
    base = np.array(defect_jacobian(model, grid, STARTING_SCHEME)(grid.y.T, start))[
        :, others
    ]
    keep, _ = np.linalg.qr(base) if others else (np.zeros((len(d), 0)), None)
    d = d - keep @ (keep.T @ d)
    along = np.array(
        model.function(variable).map(grid.n_nodes)(
            grid.y.T, grid.u.T, grid.t[None, :], ca.repmat(start, 1, grid.n_nodes)
        )
    ).ravel()
    grid_omega = frequency_grid(grid, along)
    columns = defect_jacobian(model, grid, STARTING_SCHEME, own)
    drop = np.array(
        [
            _explained(
                d,
                keep,
                np.array(columns(grid.y.T, with_entry(start, order.index(name), w))),
            )
            for w in grid_omega
        ]
    )
    padded = np.r_[-np.inf, drop, -np.inf]
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    return [float(grid_omega[i]) for i in peaks[np.argsort(-drop[peaks])][:N_STARTS]]


def with_entry(theta: np.ndarray, index: int, value: float) -> np.ndarray:
    result = theta.copy()
    result[index] = value
    return result


def _explained(d: np.ndarray, keep: np.ndarray, columns: np.ndarray) -> float:
    """How much of |d|^2 the columns explain beyond the space ``keep``."""
    columns = columns - keep @ (keep.T @ columns)
    solution = np.linalg.lstsq(columns, d, rcond=1e-8)[0]
    return float(np.sum((columns @ solution) ** 2))
