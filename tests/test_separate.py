"""Two effects that a record cannot tell apart: the experiment that would, or that none
does.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import phsi_opt as ph
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.experiments import (
    Experiment,
    Separation,
    SimulatedRecord,
    experiments,
    separating,
)
from phsi_opt.errors import DataError
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Dictionary, Term, formula
from phsi_opt.simulation.simulate import free_run

NOISE = 0.02


def spring(
    k: Parameter | float = 40.0, m: Parameter | float = 2.5, driven: bool = False
) -> PseudoHamiltonian:
    model = PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"] if driven else [],
        S=ph.canonical(1),
        H=formula("k*q**2/2 + p**2/(2*m)", k=k, m=m),
        R=ph.damping("p"),
        F={"p": formula("u")} if driven else {},
    )
    return model.with_values({"R_p": 0.5})


def positions(
    model: Model,
    t: np.ndarray,
    x0: list[float],
    u: np.ndarray | None = None,
    keep: int = 0,
    offset: float = 0.0,
) -> Measurements:
    """Noisy positions along a simulation, of which the last ``keep`` samples are kept
    (0: all).
    """
    x = free_run(model, t, x0, u)[-keep:] + np.array([offset, np.nan])
    x = x + NOISE * np.random.default_rng(0).normal(size=x.shape)
    inputs, kept = (None, None) if u is None else (["u"], [u[-keep:]])
    return Measurements.from_arrays(
        [t[-keep:] - t[-keep]],
        [x],
        kept,
        states=["q", "p"],
        inputs=inputs,
        units={"t": "s", "q": "m"},
    )


def fitted(model: Model, data: Measurements) -> Fit:
    return ph.identify(model, data, loss=ph.MaximumLikelihood())


def sigma() -> np.ndarray:
    return np.array([NOISE, np.nan])


@pytest.fixture(scope="module")
def shifted() -> tuple[Fit, Fit, Measurements]:
    """Positions with an offset, by a sensor's and by a constant force."""
    data = positions(spring(), np.linspace(0.0, 4.0, 101), [1.0, 0.0], offset=0.1)
    sensor = replace(spring(), sensor={"q": formula("b", b=Parameter(0.0))})
    force = Effect(
        "constant force", "F", "p", Dictionary((Term("1", Parameter(), {}, "push"),))
    )
    return fitted(sensor, data), fitted(spring().add(force), data), data


@pytest.fixture(scope="module")
def resonant() -> tuple[Fit, Fit, Measurements, Separation]:
    """A steady vibration at one frequency: it tells k - m omega^2, not k or m."""
    t = np.linspace(0.0, 60.0, 1501)
    u = 60.0 * np.cos(3.0 * t)[:, None]
    data = positions(spring(46.0, driven=True), t, [0.0, 0.0], u, keep=201)
    stiff = fitted(spring(k=Parameter(44.0, lower=1.0), driven=True), data)
    heavy = fitted(spring(m=Parameter(2.0, lower=0.1), driven=True), data)
    return stiff, heavy, data, separating(stiff, heavy, data, sigma())


def test_a_sensor_offset_and_a_constant_force_are_the_same_on_a_linear_spring(
    shifted: tuple[Fit, Fit, Measurements],
) -> None:
    found = separating(*shifted, sigma())
    assert found.sentence.endswith("the same model in other words")
    assert (
        len(found.table) >= 7
    )  # starts, a shifted start, a longer record, the momentum
    assert not found.table["separates"].any()


def test_on_a_hardening_spring_a_longer_record_tells_an_offset_from_a_force() -> None:
    H, S = formula("20*q**2 + 300*q**4/4 + p**2/5"), ph.canonical(1)
    R, p = {"p": formula("0.5")}, formula("f", f=Parameter(0.0))
    sensor = PseudoHamiltonian(
        states=["q", "p"], S=S, H=H, R=R, sensor={"q": formula("b", b=Parameter(0.0))}
    )
    force = PseudoHamiltonian(states=["q", "p"], S=S, H=H, R=R, F={"p": p})
    data = positions(sensor, np.linspace(0.0, 3.0, 151), [0.1, 0.0], offset=0.1)
    fits = fitted(sensor, data), fitted(force, data)
    found = separating(*fits, data, sigma())
    longer = found.table.set_index("experiment").loc["a record 3 times as long"]
    assert longer["separates"] and longer["separation"] > 2 * found.in_record
    # A start further out is imitated by another force: each by nearly as much as here.
    further = found.table.set_index("experiment").loc["start 3 times as far out"]
    assert further["separation"] == pytest.approx(found.in_record, rel=0.1)
    assert "noise standard deviations; in this record by" in found.sentence


def test_another_amplitude_tells_dry_friction_from_drag_whichever_comes_first() -> None:
    dry = spring().add(effect_named(spring(), "coulomb friction", "p"))
    dry = dry.with_values(
        {"coulomb_friction_p": 1.0, "coulomb_friction_p.v0": 0.05, "R_p": 0.3}
    )
    data = positions(dry, np.linspace(0.0, 3.0, 201), [1.0, 0.0])
    base = fitted(spring(), data)
    drag = (
        spring()
        .add(effect_named(spring(), "quadratic drag", "p"))
        .with_values({"quadratic_drag_p": 0.1})
    )
    fits = [
        ph.identify(model, data, loss=ph.MaximumLikelihood(), start=base)
        for model in (dry, drag)
    ]
    for first, second in (fits, fits[::-1]):
        found = separating(first, second, data, sigma())
        assert "times as far out: the two predictions then differ by" in found.sentence
        assert found.table["separation"].iloc[0] > 10 * found.in_record


def test_a_steady_vibration_hides_what_other_frequencies_show(
    resonant: tuple[Fit, Fit, Measurements, Separation],
) -> None:
    stiff, heavy, _, found = resonant
    # The two models respond alike at the frequency of the record.
    assert stiff.values["k"] - 2.5 * 9.0 == pytest.approx(
        (40.0 - heavy.values["m"] * 9.0), rel=0.02
    )
    table = found.table.set_index("experiment")
    assert found.in_record < 0.2
    sines = [name for name in table.index if "a sine of period" in name]
    assert len(sines) == 3
    assert table.loc[sines, "separation"].max() > 5.0
    assert any("sweep of periods" in name for name in table.index)


def test_the_separation_is_what_a_search_over_the_parameters_leaves(
    resonant: tuple[Fit, Fit, Measurements, Separation],
) -> None:
    """Reference: SciPy's least squares on simulations, for the same record with the
    momentum measured too.
    """
    stiff, heavy, data, found = resonant
    run, n_q = data.trajectories[0], 1

    def simulated(fit: Fit, values: np.ndarray, x0: np.ndarray) -> np.ndarray:
        model = fit.model.with_values(
            dict(zip(fit.model.free, values.tolist(), strict=True))
        )
        return free_run(model, run.t, x0, run.u)

    truth = simulated(
        stiff, np.array([stiff.values[n] for n in stiff.model.free]), stiff.states[0][0]
    )
    spread = np.std(truth, axis=0)
    weight = 1 / (NOISE / spread[0] * spread)

    def misfit(z: np.ndarray) -> np.ndarray:
        start_here, start_there = z[2:4], z[4:6]
        here = (simulated(heavy, z[:2], start_here) - truth) * weight
        there = (simulated(heavy, z[:2], start_there) - truth)[:, :n_q] * weight[0]
        return np.r_[here.ravel(), there.ravel()]

    x0 = heavy.states[0][0]
    best = least_squares(
        misfit,
        np.r_[[heavy.values[n] for n in heavy.model.free], x0, x0],
        x_scale="jac",
    )
    added = 2 * best.cost - found.in_record**2 * len(run.t)
    expected = np.sqrt(added / truth.size)
    row = found.table.set_index("experiment").loc["measuring p too"]
    # 5 %: the record's part is taken as linear in the parameters.
    assert row["separation"] == pytest.approx(expected, rel=0.05)


def test_the_table_is_sorted_and_the_same_at_every_call(
    resonant: tuple[Fit, Fit, Measurements, Separation],
) -> None:
    stiff, heavy, data, found = resonant
    assert found.table["separation"].is_monotonic_decreasing
    again = separating(stiff, heavy, data, sigma())
    assert again.table.equals(found.table)


def test_memory_that_the_measurements_do_not_hold_is_imitated_too() -> None:
    t = np.linspace(0.0, 8.0, 201)
    u = np.sign(np.sin(2.0 * t))[:, None]
    plain = FirstOrder(
        states=["x"], inputs=["u"], F={"x": formula("a*(u - x)", a=Parameter(2.0))}
    )
    lagged = FirstOrder(
        states=["x", "z"],
        inputs=["u"],
        F={"x": formula("2*(z - x)"), "z": formula("b*(u - z)", b=Parameter(9.0))},
    )
    x = free_run(lagged, t, [0.0, 0.0], u)[:, :1]
    data = Measurements.from_arrays(
        [t],
        [x + NOISE * np.random.default_rng(0).normal(size=x.shape)],
        [u],
        states=["x"],
        inputs=["u"],
    )
    both = Measurements.from_arrays(
        [t],
        [np.column_stack([data.trajectories[0].x, np.full(201, np.nan)])],
        [u],
        states=["x", "z"],
        inputs=["u"],
    )
    found = separating(
        fitted(lagged, both), fitted(plain, data), data, np.array([NOISE, np.nan])
    )
    assert found.table["separates"].any()
    assert not any(
        "z" in name.split() for name in found.table["experiment"]
    )  # nobody can measure or move it


def test_a_noise_that_is_not_positive_is_refused(
    shifted: tuple[Fit, Fit, Measurements],
) -> None:
    with pytest.raises(
        DataError, match=r"noise of 'q' is 0\.0; expected a positive standard deviation"
    ):
        separating(*shifted, np.array([0.0, 1.0]))


def test_experiments_have_names_of_their_own_and_leave_the_record_as_it_is() -> None:
    t = np.linspace(0.0, 4.0, 101)
    u = np.cos(9.0 * t)[:, None]
    model = spring(driven=True)
    data = positions(model, t, [1.0, 0.0], u)
    x0 = np.array([1.0, 0.0])
    itself = Experiment("the record", t, u, data.measured, x0)
    shown = free_run(model, t, [1.0, 0.0], u)
    record = SimulatedRecord(itself, data, model, shown)
    before = u.copy()
    found = list(experiments(record))
    assert len({experiment.name for experiment in found}) == len(found)
    assert np.array_equal(u, before)
    # As many values as there are samples and sensors, and the same start for all that
    # change no start.
    for experiment in found:
        assert experiment.u.shape == (len(experiment.t), 1)
        moves_start = experiment.name.startswith("start")
        assert moves_start != np.array_equal(experiment.x0, x0)
    assert {experiment.measured for experiment in found} == {("q",), ("q", "p")}
