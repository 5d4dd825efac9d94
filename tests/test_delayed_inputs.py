"""Delays of inputs: the known past of an input is shifted, exactly."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.comparison.compare import deviance
from phsi_opt.data.trajectory import InputCurve
from phsi_opt.diagnosis.candidate import Verdict
from phsi_opt.simulation.simulate import free_run

STEP, N, NOISE, GAIN, TIME = 0.5, 500, 0.02, 2.0, 6.0
FINE = 20  # parts of a sample in which the input is taken for constant
DEAD_TIMES = (0.4, 1.0, 3.0, 12.0, 30.0)  # in samples


def samples_of(hold: str, rng: np.random.Generator) -> np.ndarray:
    if hold == "zero":
        return np.repeat(rng.normal(size=N // 10), 10)
    waves = np.multiply.outer(STEP * np.arange(N), [0.3, 0.11, 0.05])
    return np.asarray(np.sin(waves + rng.uniform(0, 6, 3)).sum(axis=1))


@cache
def late_record(late: float, hold: str) -> ph.Measurements:
    """Two runs of T dx/dt = K u(t - late) - x, in steps that hit every arrival."""
    decay = np.exp(-STEP / FINE / TIME)
    times = STEP * np.arange(N)
    shown, driven = [], []
    for seed in (9, 10):
        rng = np.random.default_rng(seed)
        u = samples_of(hold, rng)
        middles = np.maximum((np.arange(N * FINE) + 0.5) / FINE - late, 0.0)
        at = np.interp(middles, np.arange(N), u)
        at = u[middles.astype(int)] if hold == "zero" else at
        x = np.zeros(N * FINE + 1)
        for k, value in enumerate(at):
            x[k + 1] = decay * x[k] + (1 - decay) * GAIN * value
        shown.append((x[:-1:FINE] + NOISE * rng.standard_normal(N))[:, None])
        driven.append(u[:, None])
    return ph.Measurements.from_arrays(
        [times] * 2, shown, driven, states=["x"], inputs=["u"], hold=hold
    )


def first_order(formula: str = "delayed(u, L)", **known: float) -> ph.FirstOrder:
    numbers = {"K": ph.Parameter(1.0, lower=0), "T": ph.Parameter(3.0, lower=0.1)}
    if "L" in formula:
        numbers["L"] = ph.Parameter(known.get("L"), lower=0, fixed="L" in known)
    rate = ph.formula(f"(K*{formula} - x)/T", **numbers)
    return ph.FirstOrder(["x"], {"x": rate}, inputs=["u"])


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("late", DEAD_TIMES)
def test_a_dead_time_is_found_from_no_value(late: float, hold: str) -> None:
    data = late_record(late, hold)
    fit = ph.identify(first_order(), data)
    error = abs(fit.values["L"] - STEP * late)
    assert error < 2 * fit.std_errors["L"]
    assert error < 0.1 * STEP
    assert fit.std_errors["L"] < 0.01 * STEP
    # No whole sample is better, by a fit to inputs that are shifted by hand.
    nearest = round(late)
    for shift in range(max(nearest - 1, 0), nearest + 2):
        runs = []
        for run in data.trajectories:
            past = np.repeat(run.u[:1], shift, axis=0)
            runs.append(np.vstack([past, run.u[: N - shift]]))
        shifted = ph.Measurements.from_arrays(
            [run.t for run in data],
            [run.x for run in data],
            runs,
            states=["x"],
            inputs=["u"],
            hold=hold,
        )
        assert deviance(fit) < deviance(ph.identify(first_order("u"), shifted)) + 0.1


def test_an_input_acts_after_several_delays() -> None:
    """One in each equation, beside runs with a delay each."""
    t = 0.2 * np.arange(300)
    rng = np.random.default_rng(2)
    numbers = {"L": ph.Parameter(lower=0), "M": ph.Parameter(0.3, lower=0)}
    numbers["M"] = replace(numbers["M"], per_trajectory=True)
    rates = {"x": "delayed(u, L) - x", "y": "x + delayed(u, M) - 2*y"}
    known = {"x": {"L": 1.1}, "y": {"M": 0.5}}
    runs, driven = [], []
    for late in (0.5, 0.9):
        known["y"]["M"] = late
        exact = {k: ph.formula(rates[k], **known[k]) for k in rates}
        u = np.repeat(rng.normal(size=30), 10)[:, None]
        model = ph.FirstOrder(["x", "y"], exact, inputs=["u"])
        x = ph.simulate(model, t, [0.0, 0.0], u, hold="zero")
        runs.append(x + 0.005 * rng.standard_normal(x.shape))
        driven.append(u)
    data = ph.Measurements.from_arrays(
        [t, t], runs, driven, states=["x", "y"], inputs=["u"], hold="zero"
    )
    own = {"x": {"L": numbers["L"]}, "y": {"M": numbers["M"]}}
    sought = {k: ph.formula(rates[k], **own[k]) for k in rates}
    fit = ph.identify(ph.FirstOrder(["x", "y"], sought, inputs=["u"]), data)
    truth = {"L": 1.1, "M[run 1]": 0.5, "M[run 2]": 0.9}
    for name, value in truth.items():
        assert abs(fit.estimates[name] - value) < 3 * fit.std_errors[name] < 0.02


def test_all_losses_and_solvers_find_it() -> None:
    data = late_record(12.0, "zero")
    found = ph.identify(first_order(), data).values["L"]
    ipopt = ph.SolverSettings(solver="ipopt")
    again = ph.identify(first_order(), data, settings=ipopt).values["L"]
    assert again == pytest.approx(found, rel=1e-4)
    for loss in (ph.PHSILoss(), ph.MaximumLikelihood(huber=1.5)):
        value = ph.identify(first_order(), data, loss=loss).values["L"]
        assert value == pytest.approx(12 * STEP, abs=0.05 * STEP)


def test_a_study_adds_and_names_it(tmp_path: Path) -> None:
    data = late_record(12.0, "zero")
    study = ph.Study(first_order("u"), data[:1], held_out=data[1:])
    diagnosis = study.diagnose()
    assert diagnosis.verdict is Verdict.NAMED
    (finding,) = diagnosis.findings
    assert str(finding.effects[0]) == "input delay on x"
    fit = study.add("input delay", "x")
    assert fit.values["delay_u_x"] == pytest.approx(12 * STEP, abs=0.05 * STEP)
    assert study.compare().rmse < 1.1 * NOISE
    fit.save(tmp_path / "late.json")
    kept = ph.Fit.load(tmp_path / "late.json")
    assert kept.model == fit.model
    assert "u(t - delay_u_x)" in kept.equations()[0].replace(
        "-delay_u_x + t", "t - delay_u_x"
    )


@pytest.mark.parametrize("hold", ["zero", "linear", "cubic"])
def test_runs_follow_the_shifted_input(hold: str) -> None:
    t = np.cumsum(np.r_[0.0, np.tile([0.4, 0.7], 40)])
    u = np.random.default_rng(0).normal(size=len(t))
    late = first_order(L=0.9).with_values({"K": 1.0, "T": 2.0})
    curve = InputCurve(t, u, hold)
    plain = first_order("u").with_values({"K": 1.0, "T": 2.0})
    fine = np.unique(np.round(np.r_[t, np.arange(0.0, t[-1], 0.01)], 9))
    middles = (fine[1:] + fine[:-1]) / 2 - 0.9
    held = np.append(curve.after(middles), 0.0)[:, None]
    exact = ph.simulate(plain, fine, [0.3], held, hold="zero")
    exact = exact[np.searchsorted(fine, t - 1e-6)]
    for run in (ph.simulate, free_run):
        x = run(late, t, [0.3], u[:, None], hold=hold)
        np.testing.assert_allclose(x, exact, atol=2e-3)
    function = ph.simulate(late, t, [0.3], lambda at: curve.after(np.array([at])))
    np.testing.assert_allclose(function, exact, atol=2e-3)


@pytest.mark.parametrize("hold", ["zero", "linear", "cubic"])
def test_a_part_of_a_run_knows_the_inputs_before_it(hold: str) -> None:
    t = 0.5 * np.arange(120)
    u = np.repeat(np.random.default_rng(1).normal(size=20), 6)
    late = first_order(L=4.2).with_values({"K": 1.0, "T": 2.0})
    x = ph.simulate(late, t, [0.3], u[:, None], hold=hold)
    data = ph.Measurements.from_arrays(
        t, x, u[:, None], states=["x"], inputs=["u"], hold=hold,
        units={"t": "min", "x": "m", "u": "mm"},
    )  # fmt: skip
    for parts in (
        data.split(0.5),
        (data.between(None, 29.6), data.between(29.6, None)),
    ):
        later = parts[1]
        fit = ph.identify(late, later)
        assert np.abs(ph.compare(fit, later).residuals[0]).max() < 1e-3
        past = later.in_si().trajectories[0].past
        assert past[-1] == pytest.approx([60 * 29.5, u[59] / 1000])
    assert not len(parts[0].trajectories[0].past)


@pytest.mark.parametrize(
    ("rate", "said"),
    [
        ("delayed(x, L)", "only an input"),
        ("delayed(u, 2*L)", "by a parameter"),
        ("delayed(u)", "takes 2 argument"),
    ],
)
def test_what_cannot_be_delayed_is_refused(rate: str, said: str) -> None:
    with pytest.raises(ph.ModelError, match=said):
        ph.FirstOrder(["x"], {"x": rate}, inputs=["u"])
