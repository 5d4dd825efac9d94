"""Standard errors: what the data say about each parameter, and which directions they
say nothing about.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from phsi_opt.model.model import Model
from phsi_opt.optimization.ipopt import Solution
from phsi_opt.optimization.program import Program
from phsi_opt.transcription.defect_derivatives import defect_slopes
from phsi_opt.transcription.defects import defect_jacobian, defects
from phsi_opt.transcription.elimination import RIDGE, ReducedSystem, regularized_inverse
from phsi_opt.transcription.grid import Grid

ROUNDED = (
    1e-11  # share of the largest information below which it is made of rounding errors
)
SAME_FACTOR = (
    0.005  # share by which relative changes may differ and still be one factor
)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of theta (NaN where it is not known) and sentences about what cannot
    be identified.
    """

    covariance: np.ndarray
    warnings: tuple[str, ...] = ()

    @property
    def std_errors(self) -> np.ndarray:
        """Standard errors in the order of theta."""
        return np.sqrt(np.diag(self.covariance))

    def widened(self, factor: float) -> "Uncertainty":
        """The covariance times a factor."""
        return Uncertainty(self.covariance * factor, self.warnings)


def unknown(n: int, why: str) -> Uncertainty:
    """No standard error is given, and why."""
    return Uncertainty(np.full((n, n), np.nan), (why,))


def reduced(
    program: Program, solution: Solution, grid: Grid, n_residuals: int
) -> ReducedSystem:
    """The likelihood at the solution in scaled variables, with the states eliminated."""
    theta, x = program.variables["theta"], program.variables["x"]
    hessian = solution.kkt.hessian * (
        n_residuals / 2
    )  # the objective is 2/N times the likelihood's
    jacobian = solution.kkt.jacobian[program.constraints["defect"].slice]
    return ReducedSystem(
        grid,
        (x.stop - x.start) // grid.n_nodes,
        hessian,
        jacobian,
        theta.slice,
        x.slice,
    )


def of_likelihood(
    names: Sequence[str],
    theta: np.ndarray,
    program: Program,
    solution: Solution,
    likelihood: ReducedSystem,
) -> Uncertainty:
    """Inverse of the information that is left for theta when the states follow it: the
    reduced Hessian's inverse.
    """
    block, held = program.variables["theta"], _held(names, solution)
    return _finished(
        names,
        theta,
        regularized_inverse(likelihood.information, held),
        program.scale[block.slice],
        held,
    )


def _held(names: Sequence[str], solution: Solution) -> list[int]:
    return [i for i, name in enumerate(names) if name in solution.outcome.at_bounds]


def of_defects(
    model: Model,
    grid: Grid,
    scheme: str,
    theta: np.ndarray,
    scale: np.ndarray,
    at_bounds: tuple[str, ...],
) -> Uncertainty:
    """Sandwich covariance of the PHSI loss: neighbouring defects share a noisy sample,
    so they are not independent.

    To first order in the noise e of the samples the gradient of the loss is sum_n G_n
    e_n, where G_n gathers what the two defects at the sample n make of its noise; so
    its covariance is sum_n G_n Sigma G_n'. Sigma, a variance per state, comes from the
    sizes of the defects. The bias that noisy states cause is not in it.
    """
    n, y = model.n_states, np.nan_to_num(grid.y)
    jacobian = (
        np.array(defect_jacobian(model, grid, scheme)(y.T, theta)) * scale
    ).reshape(grid.n_intervals, n, -1)
    d = np.array(defects(model, grid, scheme, y.T, theta)).T
    held = [i for i, name in enumerate(model.free) if name in at_bounds]
    slopes = defect_slopes(model, grid, scheme, y, theta)
    ends = (slopes.at_begin, slopes.at_end)
    gathered = np.zeros((grid.n_nodes, n, len(theta)))
    for node, slope in zip((grid.begin, grid.begin + 1), ends, strict=True):
        np.add.at(gathered, node, np.einsum("ikj,ikp->ijp", slope, jacobian))
    variance = nnls(
        sum(np.mean(slope**2, axis=0) for slope in ends), np.mean(d**2, axis=0)
    )[0]
    weighted = (gathered * np.sqrt(variance)[None, :, None]).reshape(-1, len(theta))
    flat = jacobian.reshape(-1, len(theta))
    information = flat.T @ flat
    size = np.trace(information) / max(len(theta), 1)
    bread = np.linalg.inv(information + RIDGE * size * np.eye(len(theta)))
    weak, silent = weak_directions(model.free, theta / scale, bread * size, held)
    return Uncertainty(
        _known(
            bread @ (weighted.T @ weighted) @ bread * np.outer(scale, scale),
            held + silent,
        ),
        weak,
    )


def _finished(
    names: Sequence[str],
    theta: np.ndarray,
    scaled: np.ndarray,
    scale: np.ndarray,
    held: list[int],
) -> Uncertainty:
    weak, silent = weak_directions(names, theta / scale, scaled, held)
    return Uncertainty(_known(scaled * np.outer(scale, scale), held + silent), weak)


def _known(covariance: np.ndarray, not_known: list[int]) -> np.ndarray:
    """No number is given for a parameter at its bound, or one that the data do not pin
    down.
    """
    covariance[not_known, :] = covariance[:, not_known] = np.nan
    return covariance


def weak_directions(
    names: Sequence[str], theta: np.ndarray, scaled: np.ndarray, held: list[int]
) -> tuple[tuple[str, ...], list[int]]:
    """A sentence per direction of the scaled theta on which the data are silent (only
    the ridge holds it).
    """
    moving = [i for i in range(len(scaled)) if i not in held]
    if not moving:
        return (), []
    values, vectors = np.linalg.eigh(scaled[np.ix_(moving, moving)])
    sentences, silent = [], []
    best = float(np.min(values, where=values > 0, initial=np.inf))
    for value, vector in zip(values, vectors.T, strict=True):
        value = (
            value if value > 0 else 1 / RIDGE
        )  # rounded below zero: nothing but the ridge
        spread, own = np.sqrt(value) * np.abs(vector), np.abs(theta[moving])
        # Beyond the ridge, or so far below the best known direction that only rounding
        # errors tell it.
        if (
            value > 0.01 / RIDGE
            or value > max(100.0, best / ROUNDED)
            or _is_scaling(spread, own)
        ):
            # Its largest members, and those that it moves by more than their own value.
            large = np.abs(vector) > 0.1 * np.max(np.abs(vector))
            large |= (spread > own) & (own > 0)
            parts = np.flatnonzero(large)
            members = [moving[i] for i in parts]
            silent += members
            sentences.append(
                _sentence([names[i] for i in members], vector[parts], theta[members])
            )
    return tuple(sentences), sorted(set(silent))


def _is_scaling(spread: np.ndarray, own: np.ndarray) -> bool:
    """Whether a direction multiplies several parameters, and no others, by one factor
    that the data leave open.
    """
    members = spread > 0.1 * np.max(spread)
    members |= spread > 2 * own
    relative = spread[members] / np.where(own[members] > 0, own[members], np.nan)
    return bool(
        members.sum() > 1
        and np.min(relative) > 2
        and np.ptp(relative) < SAME_FACTOR * np.max(relative)
    )


def _sentence(names: list[str], change: np.ndarray, theta: np.ndarray) -> str:
    """What the data cannot tell: the parameters may change together in this direction
    without a trace.
    """
    if len(names) == 1:
        return f"the data say nothing about {names[0]}: fix it to a known value or remove it"
    text = f"the data cannot tell {', '.join(names)} apart: "
    if np.all(theta != 0):
        relative = change / theta
        if np.ptp(np.abs(relative)) < 0.02 * np.max(np.abs(relative)):
            if len(names) > 2 and np.all(relative * relative[0] > 0):
                return (
                    text
                    + "a common factor of all leaves no trace; fix one of them to a known value"
                )
            up = [
                n for n, r in zip(names, relative, strict=True) if r * relative[0] > 0
            ]
            down = [n for n in names if n not in up]
            if len(names) == 2:
                known = f"{names[0]}*{names[1]}" if down else f"{names[0]}/{names[1]}"
                return (
                    text
                    + f"only {known} is identifiable; fix one of them to a known value"
                )
            both = f", and {', '.join(down)} divided by it," if down else ""
            return (
                text
                + f"{', '.join(up)} may be multiplied by a common factor{both} without a trace; fix one of them"
            )
    return text + "fix one of them to a known value"
