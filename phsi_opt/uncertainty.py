"""Standard errors: what the data say about each parameter, and which directions they say nothing about."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import bmat, csc_matrix, diags
from scipy.sparse.linalg import splu

from phsi_opt.grid import Grid, defect_jacobian, defect_slopes, defects
from phsi_opt.model import Model
from phsi_opt.nlp import Program
from phsi_opt.solver import Solution

RIDGE = 1e-10  # information, per scaled parameter, that makes the matrix regular where the data say nothing


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of theta (NaN where it is not known) and sentences about what cannot be identified."""

    covariance: np.ndarray
    warnings: tuple[str, ...] = ()

    @property
    def std_errors(self) -> np.ndarray:
        """Standard errors in the order of theta."""
        return np.sqrt(np.diag(self.covariance))


def unknown(n: int, why: str) -> Uncertainty:
    """No standard error is given, and why."""
    return Uncertainty(np.full((n, n), np.nan), (why,))


def of_likelihood(model: Model, program: Program, solution: Solution, n_residuals: int) -> Uncertainty:
    """Inverse of the information that is left for theta when the states follow it: the reduced Hessian's inverse."""
    block = program.variables["theta"]
    used = _without_slacks(program)
    hessian = solution.kkt.hessian[used][:, used] * (n_residuals / 2)  # the objective is 2/N times the likelihood's
    jacobian = solution.kkt.jacobian[program.constraints["defect"].slice][:, used]
    held = [i for i in range(block.stop - block.start) if block.label(i) in solution.outcome.at_bounds]
    ridge = np.zeros(len(used))
    ridge[block.slice] = RIDGE
    ridge[np.array(held, dtype=int) + block.start] = 1e12  # a parameter at its bound does not move
    matrix = bmat([[hessian + diags(ridge), jacobian.T], [jacobian, None]], format="csc")
    unit = np.zeros((matrix.shape[0], block.stop - block.start))
    unit[np.arange(block.start, block.stop), np.arange(block.stop - block.start)] = 1.0
    scaled = splu(csc_matrix(matrix)).solve(unit)[block.slice]
    return _finished(model, (scaled + scaled.T) / 2, program.scale[block.slice], held)


def _without_slacks(program: Program) -> np.ndarray:
    kept = [np.arange(b.start, b.stop) for name, b in program.variables.items() if not name.startswith("slack_")]
    return np.concatenate(kept)


def of_defects(
    model: Model, grid: Grid, scheme: str, theta: np.ndarray, scale: np.ndarray, at_bounds: tuple[str, ...]
) -> Uncertainty:
    """Sandwich covariance of the PHSI loss: neighbouring defects share a noisy sample, so they are not independent.

    To first order in the noise e of the samples the gradient of the loss is sum_n G_n e_n, where G_n gathers what the
    two defects at the sample n make of its noise; so its covariance is sum_n G_n Sigma G_n'. Sigma, a variance per
    state, comes from the sizes of the defects. The bias that noisy states cause is not in it.
    """
    n, y = model.n_states, np.nan_to_num(grid.y)
    jacobian = (np.array(defect_jacobian(model, grid, scheme)(y.T, theta)) * scale).reshape(grid.n_intervals, n, -1)
    d = np.array(defects(model, grid, scheme, y.T, theta)).T
    held = [i for i, name in enumerate(model.free) if name in at_bounds]
    ends = defect_slopes(model, grid, scheme, y, theta)
    gathered = np.zeros((grid.n_nodes, n, len(theta)))
    for node, slope in zip((grid.begin, grid.begin + 1), ends, strict=True):
        np.add.at(gathered, node, np.einsum("ikj,ikp->ijp", slope, jacobian))
    variance = nnls(sum(np.mean(slope**2, axis=0) for slope in ends), np.mean(d**2, axis=0))[0]
    weighted = (gathered * np.sqrt(variance)[None, :, None]).reshape(-1, len(theta))
    flat = jacobian.reshape(-1, len(theta))
    information = flat.T @ flat
    size = np.trace(information) / max(len(theta), 1)
    bread = np.linalg.inv(information + RIDGE * size * np.eye(len(theta)))
    weak, silent = _weak_directions(model, bread * size, held)
    return Uncertainty(_known(bread @ (weighted.T @ weighted) @ bread * np.outer(scale, scale), held + silent), weak)


def _finished(model: Model, scaled: np.ndarray, scale: np.ndarray, held: list[int]) -> Uncertainty:
    weak, silent = _weak_directions(model, scaled, held)
    return Uncertainty(_known(scaled * np.outer(scale, scale), held + silent), weak)


def _known(covariance: np.ndarray, not_known: list[int]) -> np.ndarray:
    """No number is given for a parameter at its bound, or one that the data do not pin down."""
    covariance[not_known, :] = covariance[:, not_known] = np.nan
    return covariance


def _weak_directions(model: Model, scaled: np.ndarray, held: list[int]) -> tuple[tuple[str, ...], list[int]]:
    """A sentence per direction of theta on which the data are silent (only the ridge holds it), and its members."""
    moving = [i for i in range(len(scaled)) if i not in held]
    if not moving:
        return (), []
    values, vectors = np.linalg.eigh(scaled[np.ix_(moving, moving)])
    sentences, silent = [], []
    for value, vector in zip(values, vectors.T, strict=True):
        if value > 0.01 / RIDGE:
            parts = [i for i in np.argsort(-np.abs(vector)) if abs(vector[i]) > 0.1 * np.max(np.abs(vector))]
            silent += [moving[i] for i in parts]
            names = ", ".join(model.free[moving[i]] for i in parts)
            sentences.append(
                f"the data cannot tell {names} apart: fix one of them to a known value"
                if len(parts) > 1
                else f"the data say nothing about {names}: fix it to a known value or remove it"
            )
    return tuple(sentences), sorted(set(silent))
