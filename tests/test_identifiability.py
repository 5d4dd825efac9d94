"""Directions that the data leave open, and the profile likelihood of a parameter."""

import numpy as np
import pytest

import phsi_opt as ph
from tests.systems import pair


@pytest.mark.parametrize("loss", [ph.PHSILoss(), ph.MaximumLikelihood()])
def test_a_stiffness_beside_a_linear_force_is_told_as_no_product(loss) -> None:
    """The sum of both is what the data tell, at whatever sizes a fit ends."""
    t = np.arange(0.0, 8.0, 0.05)
    x = np.c_[np.cos(2 * t), -2 * np.sin(2 * t)]
    x += 0.01 * np.random.default_rng(3).standard_normal(x.shape)
    data = ph.Measurements.from_arrays(t, x, states=["q", "p"])
    free = {"k": ph.Parameter(2.0), "c": ph.Parameter(2.0)}
    model = pair("k*q**2/2 + p**2/2", F="-c*q", **free)
    (note,) = [one for one in ph.identify(model, data, loss).warnings if "k, c" in one]
    assert note == "the data cannot distinguish k, c: fix one of them to a known value"
    fit = ph.identify(model, data, loss, l1=1e-3)  # has no standard errors, but ends
    assert fit.outcome.success


def test_intervals_by_steps_on_clean_data_hold_what_the_steps_miss() -> None:
    t = np.arange(0.0, 20.0, 0.4)
    x = np.c_[np.cos(2 * t), -2 * np.sin(2 * t)]
    data = ph.Measurements.from_arrays(t, x, states=["q", "p"])
    model = pair("k*q**2/2 + p**2/2", k=ph.Parameter(3.0))
    fit = ph.identify(model, data, ph.PHSILoss())
    missed = abs(fit.values["k"] - 4.0)
    assert missed > 1e-3
    assert missed == pytest.approx(fit.std_errors["k"], rel=0.3)


# ---- the profile likelihood


def decay(noise: float, rate: ph.Parameter) -> tuple[ph.FirstOrder, ph.Measurements]:
    """x' = -r x from 1, few and noisy samples: the rate is known badly to the fast
    side.
    """
    t = np.linspace(0.0, 4.0, 12)
    y = np.exp(-0.8 * t) + noise * np.random.default_rng(2).normal(size=len(t))
    return ph.FirstOrder(
        states=("x",), F={"x": ph.formula("-r*x", r=rate)}
    ), ph.Measurements.from_arrays(t, y, states=["x"])


@pytest.fixture(scope="module")
def loose() -> tuple[ph.Fit, ph.Measurements]:
    model, data = decay(0.15, ph.Parameter(1.0, lower=0.0))
    return ph.identify(model, data), data


def test_little_noise_gives_the_interval_of_the_curvature() -> None:
    model, data = decay(0.002, ph.Parameter(1.0))
    fit = ph.identify(model, data)
    found = ph.profile(fit, data, "r")
    assert not found.is_curved
    intervals = fit.intervals()
    lower = intervals["ci_lower"]["r"]
    upper = intervals["ci_upper"]["r"]
    # Ends are found to 2 % of the half width.
    assert found.ci_lower == pytest.approx(lower, abs=0.02 * (upper - lower))
    assert found.ci_upper == pytest.approx(upper, abs=0.02 * (upper - lower))


def test_much_noise_gives_a_longer_arm_to_the_fast_side(loose) -> None:
    fit, data = loose
    found = ph.profile(fit, data, "r")
    assert found.is_curved
    assert found.ci_upper - found.value > 1.1 * (found.value - found.ci_lower)
    assert "from the standard error: " in str(found)


def test_the_ends_have_the_rise_of_the_threshold_by_an_independent_fit(loose) -> None:
    fit, data = loose
    found = ph.profile(fit, data, "r")
    run = data.trajectories[0]

    def misfit(rate: float) -> float:
        shape = np.exp(-rate * run.t)
        x0 = (shape @ run.x[:, 0]) / (shape @ shape)
        return float(np.sum((run.x[:, 0] - x0 * shape) ** 2)) / fit.noise["x"] ** 2

    for end in (found.ci_lower, found.ci_upper):
        # 2 % of the half width is 4 % of the rise.
        assert misfit(end) - misfit(found.value) == pytest.approx(
            found.threshold, rel=0.06
        )


def test_an_end_is_the_bound_where_the_profile_meets_it_first() -> None:
    model, data = decay(0.15, ph.Parameter(0.75, lower=0.7))
    fit = ph.identify(model, data)
    assert ph.profile(fit, data, "r").ci_lower == 0.7


def test_a_parameter_without_a_profile_is_refused(loose) -> None:
    fit, data = loose
    with pytest.raises(
        ph.ModelError, match="parameter 's' is not a free parameter that all"
    ):
        ph.profile(fit, data, "s")
    with pytest.raises(ph.ModelError, match="level=2"):
        ph.profile(fit, data, "r", level=2)
    one_step = ph.identify(fit.model, data, ph.PHSILoss())
    with pytest.raises(ph.ModelError, match="fit was made with PHSILoss"):
        ph.profile(one_step, data, "r")
