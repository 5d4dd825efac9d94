"""Functions that may explain a missing force, and the stretches that judge them."""

import numpy as np
import pytest

from phsi_opt.force_analysis.cross_validation import (
    N_FOLDS,
    explained_share,
    fold_numbers,
    left_out_error,
    odd_basis,
    piecewise_linear_basis,
    product_basis,
)
from phsi_opt.force_analysis.waves import spectrum


def test_piecewise_linear_functions_sum_to_one_and_hold_straight_lines() -> None:
    z = np.random.default_rng(0).normal(size=500)
    columns = piecewise_linear_basis(z, 9)
    np.testing.assert_allclose(columns.sum(axis=1), 1.0, atol=1e-14)  # rounding
    inside = np.abs(z) < 1.0  # between the outer knots, which stand near +-2.3
    fit = np.linalg.lstsq(columns[inside], z[inside], rcond=None)[0]
    np.testing.assert_allclose(columns[inside] @ fit, z[inside], atol=1e-10)


def test_a_variable_that_stands_still_has_the_constant_alone() -> None:
    still = np.full(20, 3.0)
    np.testing.assert_array_equal(piecewise_linear_basis(still), np.ones((20, 1)))


def test_products_of_two_variables_sum_to_one() -> None:
    rng = np.random.default_rng(1)
    columns = product_basis(rng.normal(size=300), rng.uniform(size=300))
    np.testing.assert_allclose(columns.sum(axis=1), 1.0, atol=1e-14)  # rounding


def test_odd_functions_change_their_sign_with_the_variable() -> None:
    z = np.random.default_rng(2).normal(size=200)
    np.testing.assert_array_equal(odd_basis(-z), -odd_basis(z))


def test_every_fold_leaves_out_a_similar_part_in_contiguous_stretches() -> None:
    run = np.repeat([0, 1, 2], [400, 300, 100])
    fold = fold_numbers(run)
    share = np.bincount(fold) / len(run)
    # Forty stretches of about twenty intervals, eight to a fold.
    np.testing.assert_allclose(share, 1 / N_FOLDS, atol=0.05)
    n_stretches = 1 + np.count_nonzero(np.diff(fold))
    assert n_stretches <= 40


def test_a_true_function_predicts_what_was_left_out_and_a_wrong_one_does_not() -> None:
    rng = np.random.default_rng(3)
    true, wrong = rng.normal(size=(2, 600))
    w = true**2 - 1
    fold = fold_numbers(np.zeros(600, dtype=int))
    shares = []
    for z in (true, wrong):
        error = left_out_error(w, fold, [piecewise_linear_basis(z)])
        shares.append(explained_share(error, w @ w))
    assert shares[0] > 0.9  # twelve straight pieces follow a parabola that far
    assert shares[1] < 0.05


def test_a_held_and_a_slow_input_together_do_not_tell_the_time() -> None:
    n, n_values = 720, 24
    t = np.linspace(0, 2, n, endpoint=False)
    run = t.astype(int)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        held = np.repeat(rng.uniform(0, 900, n_values), n // n_values)
        slow = np.sin(2 * np.pi * 1.4 * t + run)
        # What neither has to do with: a slow sum of sines.
        phases = (
            2 * np.pi * (np.outer(t, rng.uniform(0.5, 1.5, 6)) + rng.uniform(size=6))
        )
        w = np.sin(phases).sum(axis=1)
        inputs = np.column_stack([held, slow])
        fold = fold_numbers(run, inputs)
        bases = [piecewise_linear_basis(u) for u in inputs.T]
        bases.append(product_basis(held, slow))
        share = explained_share(left_out_error(w, fold, bases), w @ w)
        assert share < 0.2


def test_a_true_function_of_a_held_input_is_found() -> None:
    held = np.repeat(np.random.default_rng(5).uniform(0, 900, 24), 30)
    run = np.zeros(720, dtype=int)
    w = (held / 900) ** 2 - 0.3
    fold = fold_numbers(run, held[:, None])
    error = left_out_error(w, fold, [piecewise_linear_basis(held)])
    assert explained_share(error, float(w @ w)) > 0.9


def test_inputs_that_move_or_are_switched_once_leave_the_stretches_as_they_are() -> (
    None
):
    run = np.repeat([0, 1], 200)
    t = np.arange(400) / 200
    alone = fold_numbers(run)
    for u in (np.sin(7 * t), np.where(t < 0.1, 0.0, 1.0), np.ones(400)):
        np.testing.assert_array_equal(fold_numbers(run, u[:, None]), alone)


def test_bases_given_apart_are_fitted_together() -> None:
    a, b = np.random.default_rng(4).normal(size=(2, 300, 1))
    w = (a + 2 * b).ravel()
    fold = fold_numbers(np.zeros(300, dtype=int))
    apart = left_out_error(w, fold, [a, b])
    assert apart == left_out_error(w, fold, [np.hstack([a, b])])
    assert explained_share(apart, w @ w) == pytest.approx(1.0, abs=1e-5)


def test_a_record_too_short_for_a_spectrum_has_no_peak() -> None:
    found = spectrum(np.array([0.0, 1.0]), np.zeros(2, dtype=int), np.ones(2))
    assert found.peak == 0.0
    assert not found.amplitudes.any()
