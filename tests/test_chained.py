"""Cholesky factors along the time, against those of the band."""

import numpy as np
import pytest

from phsi_opt.optimization.banded import (
    FEWEST_STATES,
    Banded,
    BandLayout,
    Chain,
    Chained,
    ChainLayout,
    TimeLayout,
)

N = FEWEST_STATES


class System:
    """States of some runs, measured at every so manieth node, and their dynamics."""

    def __init__(self, n: int, n_samples: list[int], steps: int) -> None:
        rng = np.random.default_rng(0)
        lengths = [(length - 1) * steps + 1 for length in n_samples]
        run = np.repeat(np.arange(len(lengths)), lengths)
        place = np.concatenate([np.arange(length) for length in lengths])
        self.begin = np.flatnonzero(np.diff(run) == 0)
        self.n_nodes = len(run)
        self.n_x = self.n_nodes * n
        is_sample = (place % steps == 0)[:, None]
        of_samples = rng.uniform(0.5, 2.0, (self.n_nodes, n))
        curvature = np.where(is_sample, of_samples, 1e-13).ravel()
        rows = [np.arange(self.n_x)]
        columns = [np.arange(self.n_x)]
        entries = [curvature]
        row, column = np.indices((n, n)).reshape(2, -1)
        for interval, begin in enumerate(self.begin):
            for node, sign in ((begin, -1.0), (begin + 1, 1.0)):
                slopes = sign * np.eye(n) + rng.normal(size=(n, n)) / (5 * n)
                defect = self.n_x + interval * n + row
                state = node * n + column
                rows += [defect, state]
                columns += [state, defect]
                entries += [slopes.ravel(), slopes.ravel()]
        self.rows = np.concatenate(rows)
        self.columns = np.concatenate(columns)
        self.entries = np.concatenate(entries)
        nodes = np.repeat(np.arange(self.n_nodes), n)
        times = np.concatenate([nodes, np.repeat(self.begin + 0.5, n)])
        self.order = np.argsort(times, kind="stable")
        self.chain = Chain(self.begin, self.n_nodes, n)

    def chained(self) -> Chained | None:
        layout = ChainLayout.of(self.rows, self.columns, self.chain)
        return None if layout is None else Chained.of(layout, self.entries)

    def banded(self) -> Banded:
        layout = BandLayout(self.rows, self.columns, self.order)
        return Banded(layout, self.entries)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_cholesky_factors_solve_what_those_of_the_band_solve(steps: int) -> None:
    system = System(N, [4, 2, 3], steps)
    chained = system.chained()
    assert chained is not None
    banded = system.banded()
    right = np.random.default_rng(1).normal(size=(chained.n, 3))
    np.testing.assert_allclose(
        chained.solve(right), banded.solve(right), rtol=1e-8, atol=1e-9
    )
    np.testing.assert_allclose(
        chained.solve(right[:, 0]), banded.solve(right[:, 0]), rtol=1e-8, atol=1e-9
    )
    assert chained.log_abs_det == pytest.approx(banded.log_abs_det, abs=1e-8)


def test_few_states_have_the_factors_of_the_band() -> None:
    assert System(N - 1, [4], 1).chained() is None


def test_a_state_that_a_sample_lacks_takes_the_band() -> None:
    system = System(N, [4], 1)
    system.entries[N + 1] = 0.0
    assert system.chained() is None
    layout = TimeLayout(system.rows, system.columns, system.order, system.chain)
    assert isinstance(layout.factors(system.entries), Banded)


def test_a_run_that_ends_between_samples_takes_the_band() -> None:
    system = System(N, [4], 1)
    system.entries[system.n_x - N : system.n_x] = 0.0
    assert system.chained() is None


def test_states_that_share_a_curvature_take_the_band() -> None:
    system = System(N, [3], 1)
    system.rows = np.append(system.rows, 0)
    system.columns = np.append(system.columns, 1)
    system.entries = np.append(system.entries, 0.1)
    assert system.chained() is None
