"""Starting values: states by smoothing, linear coefficients by a convex program,
frequencies by a scan.

The loss with the midpoint rule is convex in the coefficients that enter linearly while
R is fixed, so CVXPY solves it to its global optimum. A frequency is a needle that no
local solver finds: it is scanned, with the amplitudes (linear once the frequency is
fixed) solved at every step of the scan.
"""

import warnings

import casadi as ca
import cvxpy as cp
import numpy as np

from phsi_opt.initialization.frequency_scan import (
    N_STARTS,
    candidate_frequencies,
    frequency_scans,
    squared_defects,
    with_entry,
)
from phsi_opt.model.model import Model
from phsi_opt.transcription.defects import defect_jacobian, defects
from phsi_opt.transcription.grid import Grid
from phsi_opt.transcription.integrators import STARTING_SCHEME
from phsi_opt.transcription.losses import complete_intervals, mean_square_rate


def starting_values(model: Model, grid: Grid, l1: dict[str, float]) -> list[np.ndarray]:
    """Starting points of theta (best first) for data whose states are all known
    (``grid.y``).
    """
    grid = complete_intervals(model, grid)
    theta = model.theta
    groups = _linear_groups(model, grid)
    waves = frequency_scans(model)
    theta = _convex_rounds(model, grid, theta, groups, l1, rounds=1)
    starts = [theta]
    for name, amplitudes, variable in waves:
        scanned = []
        for start in starts:
            for omega in candidate_frequencies(
                model, grid, start, groups, name, amplitudes, variable
            ):
                moved = with_entry(start, model.free.index(name), omega)
                # The start carries what the polynomials explained before the wave was
                # there; begin again beside it.
                scanned.append(_convex_rounds(model, grid, moved, groups, l1, rounds=2))
        starts = sorted(scanned, key=lambda s: squared_defects(model, grid, s))[
            :N_STARTS
        ]
    return starts


def _linear_groups(model: Model, grid: Grid) -> list[list[int]]:
    """Groups of parameters that enter the right-hand side linearly while the others are
    fixed: H and F, then R.
    """
    rhs = model.rhs()
    arguments = [ca.SX.sym(rhs.name_in(i), rhs.size1_in(i)) for i in range(rhs.n_in())]
    theta, dx = arguments[-1], rhs(*arguments)
    entries = [model.entries[name] for name in model.free]
    has_start = [e.parameter.value is not None and not e.prunable for e in entries]
    groups = []
    for slots in (("H", "F"), ("R",)):
        members: list[int] = []
        inside = [
            i for i, e in enumerate(entries) if e.slot in slots and not has_start[i]
        ]
        # Coefficients first: a frequency beside them would make its amplitudes look
        # curved.
        for tried in (
            [i for i in inside if entries[i].prunable],
            [i for i in inside if not entries[i].prunable],
        ):
            both = members + tried
            curved = _curved(dx, theta, both)
            members = [
                i
                for i, bent in zip(both, curved, strict=True)
                if not bent or i in members
            ]
        groups.append(sorted(members))
    return [group for group in groups if group]


def _curved(dx: ca.SX, theta: ca.SX, members: list[int]) -> list[bool]:
    if not members:
        return []
    chosen = theta[members]
    slopes = ca.jacobian(dx, chosen)
    return [ca.depends_on(slopes[:, i], chosen) for i in range(len(members))]


def _convex_rounds(
    model: Model,
    grid: Grid,
    theta: np.ndarray,
    groups: list[list[int]],
    l1: dict[str, float],
    rounds: int,
) -> np.ndarray:
    for _ in range(rounds):
        for group in groups:
            theta = convex_coefficients(model, grid, theta, group, l1)
    return theta


def convex_coefficients(
    model: Model,
    grid: Grid,
    theta: np.ndarray,
    group: list[int],
    l1: dict[str, float],
    scheme: str = STARTING_SCHEME,
) -> np.ndarray:
    """The PHSI loss over the coefficients ``group``, others fixed, as a convex program;
    exact where it is convex.
    """
    jacobian = np.array(defect_jacobian(model, grid, scheme)(grid.y.T, theta))[:, group]
    d = np.array(defects(model, grid, scheme, ca.DM(grid.y.T), theta)).T.ravel()
    usable = np.isfinite(jacobian).all(axis=1) & np.isfinite(d)
    weight = np.sqrt(1 / (mean_square_rate(grid) * grid.n_intervals))
    entries = [model.entries[model.free[i]] for i in group]
    scale = 1 / np.maximum(np.linalg.norm(weight * jacobian[usable], axis=0), 1e-12)
    A, b = (
        weight * jacobian[usable] * scale,
        weight * (jacobian[usable] @ theta[group] - d[usable]),
    )
    q, r = np.linalg.qr(A)
    z = cp.Variable(len(group))
    lam = np.array(
        [l1.get(e.slot, 0.0) if e.prunable else 0.0 for e in entries]
    ) / mean_square_rate(grid)
    objective = cp.sum_squares(r @ z - q.T @ b) + cp.sum(
        cp.multiply(lam * scale, cp.abs(z))
    )
    limits = [
        (z[i] >= e.parameter.lower / scale[i])
        for i, e in enumerate(entries)
        if np.isfinite(e.parameter.lower)
    ]
    limits += [
        (z[i] <= e.parameter.upper / scale[i])
        for i, e in enumerate(entries)
        if np.isfinite(e.parameter.upper)
    ]
    with warnings.catch_warnings():  # a start need not be accurate to the last digit
        warnings.simplefilter("ignore", UserWarning)
        cp.Problem(cp.Minimize(objective), limits).solve(
            solver=cp.CLARABEL, tol_gap_abs=1e-14, tol_gap_rel=1e-12, tol_feas=1e-12
        )
    result = theta.copy()
    if z.value is not None and np.all(np.isfinite(z.value)):
        bounds = np.array([(e.parameter.lower, e.parameter.upper) for e in entries])
        result[group] = np.clip(z.value * scale, bounds[:, 0], bounds[:, 1])
    return result
