"""Derivatives of the defects as constraints of a program, in CasADi's symbols.

Jacobian and curvature are put together from small blocks per interval, which costs a
small part of an automatic differentiation of the whole. Where the blocks stand is known
from the likelihood in numbers.
"""

from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import csc_matrix

from phsi_opt.transcription.defect_derivatives import defect_curvature
from phsi_opt.transcription.interval_map import interval_arguments, map_intervals
from phsi_opt.transcription.likelihood_values import LikelihoodValues


def constraint_jacobian(values: LikelihoodValues, x: ca.MX, theta: Any) -> ca.MX:
    """Sparse Jacobian of the scaled defects in the scaled parameters and states.

    Args:
        values: of the likelihood.
        x: (n_states, n_nodes) states.
        theta: (n_free,) parameters, or (n_free, n_trajectories).
    """
    grid = values.grid
    function = values.linear_defect.function
    of_intervals = map_intervals(function, grid, interval_arguments(grid, x), theta)[1]
    entries = ca.vec(of_intervals[values.order.tolist(), :])
    pattern = values.jacobian
    order = np.lexsort((pattern.rows, pattern.columns))  # as CasADi stores them
    factor = ca.DM(values.factor.ravel()[order])
    places = (pattern.rows[order].tolist(), pattern.columns[order].tolist())
    sparsity = ca.Sparsity.triplet(*pattern.shape, *places)
    return ca.MX(sparsity, entries[order.tolist()] * factor)


def constraint_curvature(
    values: LikelihoodValues, x: ca.MX, theta: Any, multipliers: ca.MX
) -> ca.MX:
    """What the scaled defects add to the Hessian of the Lagrangian, upper triangle.

    Second derivatives per interval, summed where intervals share an unknown. The
    multipliers of the defects are the first ones; else as `constraint_jacobian`.
    """
    grid = values.grid
    n_states = values.n_states
    shape = (n_states, grid.n_intervals)
    of_defects = multipliers[: n_states * grid.n_intervals]
    weighted = ca.reshape(of_defects, *shape) * ca.DM(values.per_size.T)
    one = defect_curvature(values.model, values.scheme)
    columns = [*interval_arguments(grid, x), weighted]
    entries = map_intervals(one.function, grid, columns, theta)
    row, column = values.curvature.rows, values.curvature.columns
    # Each entry of the Hessian once, in CasADi's order, and the entries per interval
    # that it sums up.
    n_z = len(values.scale)
    entry, where = np.unique(column * n_z + row, return_inverse=True)
    factor = values.scale[row] * values.scale[column]
    summed = (len(entry), len(row))
    gather = csc_matrix((factor, (where, np.arange(len(row)))), shape=summed)
    column, row = np.divmod(entry, n_z)
    sparsity = ca.Sparsity.triplet(n_z, n_z, row.tolist(), column.tolist())
    return ca.MX(sparsity, ca.mtimes(ca.DM(gather), ca.vec(entries)))
