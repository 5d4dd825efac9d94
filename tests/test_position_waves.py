"""Forces that repeat along a position: a motor whose torque cogs six times a turn."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import phsi_opt as ph
from phsi_opt.force_analysis.analysis import (
    ForceAnalysis,
    step_without_name,
)
from phsi_opt.screening.linearized_record import LinearizedRecord
from phsi_opt.screening.score_test import ScoreTest
from phsi_opt.screening.weighing import EvidenceRecord

INERTIA = 0.02  # kg m^2
DAMPING = 0.3  # N m s/rad
TURN = {"rad": 2 * np.pi, "deg": 360.0, "": 2 * np.pi}


def cogging(q: float) -> float:
    return -0.15 * np.sin(6 * q)


def stop(q: float) -> float:
    """A soft stop on either side: a law of the position that does not repeat."""
    return -2.0 * float(np.sign(q) * max(abs(q) - 1.0, 0.0))


@cache
def turned(torque: Callable[[float], float], unit: str) -> ph.Measurements:
    """Angles of two runs under a measured torque, in ``unit``, with noise."""
    rng = np.random.default_rng(3)
    t = np.arange(0, 8, 0.02)
    scale = TURN[unit] / TURN["rad"]
    angles = []
    drives = []
    for _ in range(2):
        phases = rng.uniform(0, 2 * np.pi, size=(4, 1))
        hertz = np.array([[0.15], [0.3], [0.5], [0.8]])
        drive = 0.6 * np.sum(np.sin(2 * np.pi * hertz * t + phases), axis=0)

        def rates(s: float, x: np.ndarray, u: np.ndarray = drive) -> list[float]:
            loss = DAMPING * x[1]
            return [x[1], (np.interp(s, t, u) + torque(x[0]) - loss) / INERTIA]

        x = solve_ivp(rates, (t[0], t[-1]), [0, 0], t_eval=t, rtol=1e-8, max_step=0.02)
        noisy = x.y[0] + 0.002 * rng.normal(size=len(t))
        angles.append(np.column_stack([scale * noisy, np.full(len(t), np.nan)]))
        drives.append(scale * drive[:, None])
    return ph.Measurements.from_arrays(
        [t] * 2,
        angles,
        drives,
        states=["q", "p"],
        inputs=["u"],
        units={"q": unit, "t": "s"},
    )


def motor() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("p**2/(2*J)", J=ph.Parameter(0.03, lower=1e-3)),
        R=ph.damping("p"),
        F={"p": ph.formula("u")},
    )


@cache
def compared(torque: Callable[[float], float], unit: str = "rad") -> ph.Comparison:
    data = turned(torque, unit)
    return ph.compare(ph.identify(motor(), data), data)


@cache
def analysed(torque: Callable[[float], float], unit: str = "rad") -> ForceAnalysis:
    return ForceAnalysis.of(compared(torque, unit).record)


def test_cogging_follows_the_angle_and_repeats_six_times_a_turn() -> None:
    analysis = analysed(cogging)
    wave = analysis.force_in("p").wave
    assert wave is not None
    assert wave.position == "q"
    assert wave.period == pytest.approx(2 * np.pi / 6, rel=0.02)
    first = analysis.follows.iloc[0]
    assert first["variable"] == "q"
    assert first["share"] > 0.75
    (sentence,) = analysis.sentences
    assert "it follows the position q and repeats every 1.0" in sentence
    assert " times a turn)" in sentence


def test_it_is_told_what_to_write_and_that_finds_the_cogging() -> None:
    analysis = analysed(cogging)
    answer = step_without_name(analysis, {"q": "rad", "t": "s"})
    assert answer.lead == "Write a term of your own in dp/dt that repeats along q."
    said = 'study.add(ph.Effect("ripple", "F", "p", ph.trigonometric("q")))'
    assert said in answer.detail
    data = turned(cogging, "rad")
    study = ph.Study(motor(), data)
    study.add(ph.Effect("ripple", "F", "p", ph.trigonometric("q")))
    (omega,) = [name for name in study.fit.values if name.endswith("omega_q")]
    assert study.fit.values[omega] == pytest.approx(6.0, rel=2e-3)
    last = study.history.iloc[-1]
    assert last["train_rmse"] < 1.1 * last["noise_floor"]


def test_turns_are_told_in_the_unit_of_the_angle() -> None:
    (sentence,) = analysed(cogging, "deg").sentences
    found = sentence.split("repeats every ")[1]
    degrees, times = found.split(" deg, ")
    assert float(degrees) == pytest.approx(60, rel=0.02)
    assert float(times.split()[0]) == pytest.approx(6, rel=0.02)
    (sentence,) = analysed(cogging, "").sentences
    assert "a turn" not in sentence


def test_a_law_of_the_position_that_does_not_repeat_is_no_wave() -> None:
    analysis = analysed(stop)
    assert analysis.force_in("p").wave is None
    assert analysis.follows.iloc[0]["variable"] == "q"


def test_it_is_seen_in_a_model_without_an_energy_too() -> None:
    data = turned(cogging, "deg")
    g = ph.Parameter(40.0, lower=0)
    c = ph.Parameter(10.0, lower=0)
    drive = ph.FirstOrder(
        ["q", "p"],
        {"q": ph.formula("p"), "p": ph.formula("g*u - c*p", g=g, c=c)},
        inputs=["u"],
    )
    fit = ph.identify(drive, data)
    analysis = ForceAnalysis.of(ph.compare(fit, data).record)
    wave = analysis.force_in("p").wave
    assert wave is not None
    assert wave.period == pytest.approx(60, rel=0.02)
    told = step_without_name(analysis, data.units)
    assert told.lead == "Write a term of your own in dp/dt that repeats along q."
    # The waves that are tried are those along the angle, in rad per degree.
    study = ph.Study(drive, data)
    study.add(ph.Effect("ripple", "F", "p", ph.trigonometric("q")))
    assert study.fit.values["F_p.omega_q"] == pytest.approx(np.pi / 30, rel=2e-3)
    last = study.history.iloc[-1]
    assert last["train_rmse"] < 1.1 * last["noise_floor"]


def screening(trained: ph.Comparison) -> ScoreTest:
    record = EvidenceRecord.of(trained.record, None)
    return ScoreTest(LinearizedRecord.beside_force(record))


def test_along_what_stands_still_no_wave_is_expected() -> None:
    data = turned(cogging, "rad")
    still = [np.ones_like(run.u) for run in data.trajectories]
    pushed = ph.Measurements.from_arrays(
        [run.t for run in data.trajectories],
        [run.x for run in data.trajectories],
        still,
        states=["q", "p"],
        inputs=["u"],
    )
    comparison = ph.compare(ph.identify(motor(), pushed), pushed)
    test = screening(comparison)
    assert test.screened(ph.Effect("ripple", "F", "p", ph.trigonometric("u"))) is None
