"""Windows of a grid: where it is cut, and where not; what is said of them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import SolveError
from phsi_opt.estimation import maximum_likelihood
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_solve import LikelihoodSolver
from phsi_opt.estimation.multiple_shooting import SHORTEST_WINDOW, cut_into_windows
from phsi_opt.transcription.grid import Grid, grid_of, steps_per_gap

N_SAMPLES = 101


@pytest.fixture
def grid() -> Grid:
    t = np.linspace(0.0, 5.0, N_SAMPLES)
    x = np.column_stack([np.cos(t), np.sin(t)])
    return grid_of(Measurements.from_arrays(t, x, states=["q", "p"]), 2)


def test_windows_cut_a_grid_at_samples_and_leave_no_short_piece(grid: Grid) -> None:
    pieces = cut_into_windows(grid, 1.0)
    gone = np.setdiff1d(grid.begin, pieces.begin)
    assert grid.sample[gone].all()
    # Windows of 1.0 in a record of 5.0; the sample at 5.0 alone is no window.
    np.testing.assert_allclose(grid.t[gone], [0.95, 1.95, 2.95, 3.95])
    assert [int(n.max()) for n in steps_per_gap(grid)] == [2]


def test_short_windows_have_the_least_number_of_samples(grid: Grid) -> None:
    pieces = cut_into_windows(grid, 0.1)
    n_cuts = grid.n_intervals - pieces.n_intervals
    assert 0 < n_cuts < N_SAMPLES // SHORTEST_WINDOW


def test_a_window_longer_than_the_record_cuts_nothing(grid: Grid) -> None:
    assert cut_into_windows(grid, 6.0).n_intervals == grid.n_intervals


def unsolved(estimate: LikelihoodEstimate) -> LikelihoodEstimate:
    outcome = replace(estimate.solution.outcome, success=False)
    return replace(estimate, solution=replace(estimate.solution, outcome=outcome))


@pytest.mark.parametrize("are_windows_solved", [True, False])
def test_a_record_that_only_its_pieces_can_be_solved_of_is_told(
    monkeypatch: pytest.MonkeyPatch, are_windows_solved: bool
) -> None:
    solve = LikelihoodSolver.solve

    def of_pieces(
        self: LikelihoodSolver, start: Any, *, window: float | None = None, **how: Any
    ) -> LikelihoodEstimate:
        estimate = solve(self, start, window=window, **how)
        is_solved = are_windows_solved and window is not None
        return estimate if is_solved else unsolved(estimate)

    monkeypatch.setattr(LikelihoodSolver, "solve", of_pieces)
    monkeypatch.setattr(maximum_likelihood, "simple_start", lambda _: None)
    t = np.linspace(0.0, 16.0, 161)
    x = np.column_stack([np.cos(t), -np.sin(t)])
    y = x + 0.01 * np.random.default_rng(0).normal(size=x.shape)
    data = ph.Measurements.from_arrays(t, y, states=["q", "p"], units={"t": "s"})
    model = ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=ph.formula("k*q**2/2 + p**2/2", k=2.0)
    )
    with pytest.raises(SolveError) as failure:
        ph.identify(model, data)
    assert ("Pieces of 8 s could be solved" in str(failure.value)) is are_windows_solved
