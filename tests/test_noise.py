"""The noise: its first estimate, that of the residuals, and that of quantised sensors."""

from collections.abc import Callable

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.data.channel_noise import lattice_step, resolution
from phsi_opt.data.noise import difference_noise, initial_noise, scatter_by_run
from phsi_opt.diagnosis.candidate import Grade
from phsi_opt.estimation.noise_estimation import NoiseIteration, NoiseLevels
from phsi_opt.transcription.grid import grid_of
from tests.systems import STARTS, damped_spring, positive, spring


def one_channel(t: np.ndarray, y: np.ndarray) -> ph.Measurements:
    return ph.Measurements.from_arrays(t, y, states=["q"])


def noisy_sine(n_samples: int = 2000, noise: float = 0.05) -> ph.Measurements:
    """A sine with noise, and a state which nobody measured."""
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 5.0, n_samples)
    q = np.sin(t) + noise * rng.normal(size=n_samples)
    x = np.column_stack([q, np.full(n_samples, np.nan)])
    return ph.Measurements.from_arrays(t, x, states=["q", "p"])


def test_the_difference_noise_of_a_smooth_curve_is_that_which_was_added() -> None:
    noise = difference_noise(noisy_sine())
    # The median of 2000 correlated values is good to about 3 %; three of those.
    assert noise[0] == pytest.approx(0.05, rel=0.09)
    assert np.isnan(noise[1])


def test_a_cubic_has_no_noise_however_it_is_sampled() -> None:
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.01, 0.2, size=50))
    (noise,) = difference_noise(one_channel(t, 1 - t + 2 * t**2 - t**3))
    # rounding: values up to about 100, weights up to a few hundred where two
    # neighbours nearly meet
    assert noise < 1e-11


def test_a_jump_is_no_noise() -> None:
    data = noisy_sine()
    (run,) = data.trajectories
    jumping = run.x[:, 0] + 3.0 * (run.t > 2.5)
    (noise,) = difference_noise(one_channel(run.t, jumping))
    # four of 2000 residuals see the jump: the median moves by a share of that order
    assert noise == pytest.approx(difference_noise(data)[0], rel=0.01)


def test_noise_that_is_given_is_kept_and_what_is_unknown_is_guessed() -> None:
    data = noisy_sine()
    np.testing.assert_array_equal(initial_noise(data), [difference_noise(data)[0], 1.0])
    given = np.array([0.3, np.nan])
    np.testing.assert_array_equal(initial_noise(data, given), [0.3, 1.0])
    few = one_channel(np.arange(3.0), np.array([0.0, 1.0, 2.0]))
    # a tenth of the spread where differences tell nothing, or are not asked for
    assert initial_noise(few)[0] == pytest.approx(0.1 * np.std([0, 1, 2]))
    spread = np.std(data.stacked("x")[:, 0])
    unknown = np.full(2, np.nan)
    np.testing.assert_allclose(initial_noise(data, unknown), [0.1 * spread, 1.0])


def test_measurements_in_which_nothing_moves_are_refused() -> None:
    still = one_channel(np.arange(6.0), np.full(6, 2.5))
    with pytest.raises(ph.DataError, match=r"q is always 2\.5"):
        initial_noise(still)


def test_runs_whose_scatter_differs_have_noises_of_their_own() -> None:
    rng = np.random.default_rng(4)
    t = np.linspace(0.0, 10.0, 200)
    for sizes in ((0.1, 0.1, 0.1), (0.1, 0.3, 0.02)):
        runs = [np.sin(t) + size * rng.normal(size=200) for size in sizes]
        data = ph.Measurements.from_arrays([t] * 3, runs, states=["q"])
        own = [difference_noise(data[k])[0] for k in range(3)]
        expected = own if len(set(sizes)) > 1 else [difference_noise(data)[0]] * 3
        np.testing.assert_allclose(scatter_by_run(data)[:, 0], expected, rtol=1e-14)


def test_the_noise_is_the_rms_residual_over_the_degrees_of_freedom() -> None:
    n_theta, sigma = 3, np.array([0.1, 2.0])
    x = np.random.default_rng(0).normal(size=(20_000, 2))
    x[::4, 1] = np.nan
    t = np.arange(20_000.0)
    grid = grid_of(ph.Measurements.from_arrays(t, x, states=["q", "p"]))
    n_values = grid.measured.sum()
    residual = np.random.default_rng(1).normal(size=len(grid.channel))
    levels = NoiseLevels(np.ones(2), np.zeros(2, dtype=bool), np.zeros(2))
    iteration = NoiseIteration(grid, levels, n_theta, None, False)
    found = iteration.updated(sigma, residual * np.sqrt(2 / n_values))
    freedom = n_values - n_theta - 2  # two starting states of one trajectory
    squares = [np.mean(residual[grid.channel == k] ** 2) for k in range(2)]
    expected = sigma * np.sqrt(np.array(squares) * n_values / freedom)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


# ---- quantised sensors: the step from the values alone, and the noise that it makes

T = np.linspace(0.0, 14.0, 281)
PER_STEP = 1 / np.sqrt(12)


def rounded_to(step: float, values: np.ndarray) -> np.ndarray:
    return step * np.round(values / step)


def decaying(n: int = 500) -> np.ndarray:
    t = np.linspace(0.0, 20.0, n)
    return np.exp(-0.05 * t) * np.cos(1.5 * t)


# ---- the step of a quantised sensor

TENTHS = rounded_to(0.1, decaying())
OFFSETS = [TENTHS, TENTHS + np.pi, TENTHS - 0.123]  # of the trajectories
INCH = 0.0254
QUANTISED: list[tuple[list[np.ndarray], float]] = [
    (OFFSETS, 0.1),
    ([*OFFSETS, decaying()], 0.0),
    ([TENTHS / INCH], 0.1 / INCH),
    ([TENTHS[250:], np.r_[np.nan, TENTHS[:250]]], 0.1),  # in another order
    ([np.round(decaying(), 2)], 0.01),
]
for step in 2.0 / np.array([2, 8, 30, 300, 3000]):
    for offset in (0.0, 273.15, -1.7):
        QUANTISED.append(([offset + rounded_to(step, decaying())], step))


@pytest.mark.parametrize(("runs", "step"), QUANTISED)
def test_the_step_is_found_whatever_offset_unit_and_order(runs, step) -> None:
    assert resolution(runs) == pytest.approx(step, rel=1e-6)


def test_printed_digits_do_not_hide_the_step_of_the_converter() -> None:
    values = np.round(rounded_to(0.0322265625, 30 * decaying(2000)), 2)
    # A thousand steps, each printed to a sixth of a step at most.
    assert resolution([values]) == pytest.approx(0.0322265625, rel=1e-3)


CONTINUOUS: dict[str, Callable[[], np.ndarray]] = {
    "smooth": decaying,
    "single precision": lambda: decaying().astype(np.float32).astype(float),
    "noisy": lambda: decaying() + np.random.default_rng(0).normal(size=500),
    "six digits": lambda: np.array([float(f"{v:.6g}") for v in decaying()]),
    "evenly rising": lambda: np.linspace(0.0, 20.0, 500),
    "whole squares": lambda: np.arange(500.0) ** 2,
    "periodic": lambda: np.cos(2 * np.pi * np.arange(500) / 20),
    "held": lambda: np.repeat(np.random.default_rng(0).normal(size=100), 5),
    "clipped": lambda: np.clip(decaying(), -0.3, 0.3),
    "constant": lambda: np.full(500, 21.5),
    "exactly periodic": lambda: np.tile(decaying(25), 20),
    "few": lambda: np.array([0.0, 1.0, 2.0, 1.0, 0.0]),
    "nothing": lambda: np.full(500, np.nan),
}


@pytest.mark.parametrize("kind", CONTINUOUS)
def test_what_is_not_quantised_has_no_step(kind: str) -> None:
    values = CONTINUOUS[kind]()
    assert resolution([values]) == 0.0
    assert resolution([values, values]) == 0.0


def test_few_values_that_lie_evenly_by_chance_have_no_step() -> None:
    values = np.array([0.0, 1.0, 2.05])
    assert lattice_step(values, 0.05) == 0.0
    assert lattice_step(values[:2], 0.05) == 1.0
    assert lattice_step(np.arange(9.0), 0.05) == pytest.approx(1.0)


# ---- the noise that it makes ---------------------------------------------------------


def truth(friction: float = 0.0) -> ph.PseudoHamiltonian:
    return damped_spring(loss=f"0.1 + {friction}*(p**4 + 0.03**4)**(-0.25)")


def base() -> ph.PseudoHamiltonian:
    return spring(positive(2.0))


def quantised(
    model: ph.PseudoHamiltonian,
    step: float,
    *,
    noise: float = 0.0,
    hidden: bool = True,
    declared: dict[str, float] | None = None,
    seed: int = 0,
) -> ph.Measurements:
    """Oscillations of which q was quantised; p is not, or was never measured."""
    rng = np.random.default_rng(seed)
    runs = []
    for x0 in STARTS:
        x = ph.simulate(model, T, x0)
        x = x + noise * rng.normal(size=x.shape)
        x[:, 0] = rounded_to(step, x[:, 0])
        if hidden:
            x[:, 1] = np.nan
        runs.append(x)
    return ph.Measurements.from_arrays(
        [T] * 3, runs, states=["q", "p"], units={"q": "mm"}, noise=declared
    )


@pytest.mark.parametrize("n_levels", [2, 30])
def test_no_noise_below_the_steps_is_found(n_levels: int) -> None:
    step = 2.0 / n_levels
    train, test = quantised(truth(), step).split(0.6)
    fit = ph.identify(base(), train)
    assert fit.noise["q"] >= step * PER_STEP * (1 - 1e-6)
    # A step of half the motion is a coarse look at it; uniform errors are then a guess.
    assert fit.noise["q"] < 1.3 * step * PER_STEP
    compared = ph.compare(fit, test)
    assert compared.noise_floor == pytest.approx(step * PER_STEP, rel=0.05)
    assert np.isfinite(compared.table["chi2_dof"]).all()


def test_a_fit_names_the_channel_whose_steps_set_its_noise() -> None:
    # The residuals of this record are a little smaller than uniform errors.
    fit = ph.identify(base(), quantised(truth(), 2 / 30).split(0.6)[0])
    assert fit.noise["q"] == pytest.approx(2 / 30 * PER_STEP, rel=1e-6)
    assert (
        "the values of q are quantised in steps of 0.0667 mm: the noise is taken as at "
        "least 0.019 mm" in fit.warnings
    )
    noisy = ph.identify(base(), quantised(truth(), 2 / 30, noise=0.05))
    assert noisy.noise["q"] > 0.05
    assert not any("quantised" in warning for warning in noisy.warnings)


def test_steps_coarser_than_the_motion_are_not_taken_for_an_effect() -> None:
    train, test = quantised(truth(), 1.0).split(0.6)
    effects = ["coulomb friction", "quadratic drag", "cubic stiffness"]
    fit = ph.identify(base(), train)
    assert any(
        "the standard deviation of q is less than its quantisation step" in w
        for w in fit.warnings
    )
    found = ph.diagnose(fit, train, test, effects=effects)
    # The best candidate, dry friction, explains what three values leave.
    assert found.ranking[0].grade == Grade.DECISIVE
    assert found.verdict is ph.Verdict.UNEXPLAINED
    assert (
        "the quantisation of q, whose standard deviation is less than one step"
        in found.reason
    )
    assert found.proposed == ()
