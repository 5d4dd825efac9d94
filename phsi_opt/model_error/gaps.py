"""A linearised record with one interval between samples, however many steps it had.

Steps between samples keep the integration accurate; what acts beside the model is not
resolved by them. The linear dynamics of the steps in a gap follow one after the other
and make one step over the gap, in which a force is held.
"""

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix

from phsi_opt.model_error.linearization import ForceEffects, Linearization
from phsi_opt.optimization.passage import Passage, neighbours_first


def between_samples(problem: Linearization) -> Linearization:
    """The record with its samples alone as nodes."""
    grid = problem.grid
    if grid.sample.all():
        return problem
    samples = np.flatnonzero(grid.sample)
    number = np.cumsum(grid.sample) - 1  # of the last sample, for every node
    is_first = grid.sample[grid.begin]
    begin = number[grid.begin[is_first]]
    coarse = grid.at_nodes(
        samples,
        begin=begin,
        h=grid.t[samples][begin + 1] - grid.t[samples][begin],
        u0=grid.u0[is_first],
        u1=grid.u1[grid.sample[grid.begin + 1]],
    )
    passage = _passage(problem)
    offset = passage.over(problem.offset[:, None])
    effects = csc_matrix(passage.over_blocks(_held(problem)))
    return replace(
        problem,
        grid=coarse,
        nodes=problem.nodes[samples],
        dynamics_in_states=csc_matrix(passage.slopes()),
        dynamics_in_theta=passage.over(problem.dynamics_in_theta),
        force_effects=ForceEffects(effects, problem.n_states),
        offset=offset.ravel(),
        shown_in_states=csr_matrix(problem.shown_in_states)[:, passage.samples],
        node=number[problem.node],
    )


def _passage(problem: Linearization) -> Passage:
    slopes = csr_matrix(problem.dynamics_in_states)
    touching = slopes.tocoo()
    n = problem.n_states
    order = neighbours_first(touching.row % n, touching.col % n, n)
    grid = problem.grid
    return Passage(slopes, grid.begin, grid.sample, np.argsort(order))


def _held(problem: Linearization) -> csr_matrix:
    """What forces do that are held over each gap, (n_intervals * n_states, ...)."""
    grid = problem.grid
    n = problem.n_states
    gap = np.cumsum(grid.sample[grid.begin]) - 1
    effects = coo_matrix(problem.force_effects.matrix)
    interval, equation = np.divmod(effects.col, n)
    places = (effects.row, gap[interval] * n + equation)
    shape = (effects.shape[0], (gap[-1] + 1) * n)
    return csr_matrix((effects.data, places), shape=shape)
