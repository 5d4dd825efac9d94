"""Models weighed beside a force that could have done the same."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.criteria import DECISIVE_EVIDENCE
from phsi_opt.diagnosis.candidate import Grade
from phsi_opt.estimation.record import Record
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model_error.joint_estimate import JointPoint
from phsi_opt.screening.linearized_record import LinearizedRecord
from phsi_opt.screening.score_test import ScoreTest, Screened
from phsi_opt.screening.weighing import EvidenceRecord, Weighed
from problems.judges.couplings import rooms
from tests.systems import Number, pair, positive

T = np.linspace(0.0, 8.0, 81)
STARTS = ([1.0, 0.0], [-0.6, 0.8], [0.8, -0.7])
NOISE = 0.01
LOSSES = {
    "coulomb friction": "0.1 + 0.15*(dH_dp**4 + 0.02**4)**(-0.25)",
    "quadratic drag": "0.1 + 0.25*abs(dH_dp)",
}


def spring(loss: str | None = None, k: Number = 2.3) -> ph.PseudoHamiltonian:
    """A unit mass with a spring and a damper, or with a loss of another law."""
    return pair("k*q**2/2 + p**2/2", loss or ph.damping("p"), k=k)


@cache
def measured(loss: str) -> ph.Measurements:
    """Positions of three runs, with white noise."""
    rng = np.random.default_rng(0)
    runs = []
    for start in STARTS:
        q = ph.simulate(spring(loss), T, start)[:, 0] + NOISE * rng.normal(size=len(T))
        runs.append(np.column_stack([q, np.full(len(T), np.nan)]))
    return ph.Measurements.from_arrays([T] * 3, runs, states=["q", "p"])


@cache
def record_of(
    loss: str, is_held_out: bool = False, is_alone: bool = False
) -> EvidenceRecord:
    """The model without the loss beside a force; perhaps the last run is held out."""
    data = measured(loss)
    train = data[:2] if is_held_out else data
    fit = ph.identify(spring(k=positive(2.0)), train)
    judged = ph.compare(fit, data[2:]).record if is_held_out and not is_alone else None
    return EvidenceRecord.of(ph.compare(fit, train).record, judged)


def screened(record: EvidenceRecord, name: str) -> Screened:
    """What is expected of an effect on the momentum."""
    test = ScoreTest(LinearizedRecord.beside_force(record))
    found = test.screened(effect_named(record.base.model, name, "p"))
    assert found is not None
    return found


def weighed(record: EvidenceRecord, name: str) -> Weighed:
    """The model with an effect on the momentum."""
    one = screened(record, name)
    return record.weighed(one.model, one.values)


# --- the base


def test_the_base_is_as_likely_as_the_best_point_that_a_larger_model_finds() -> None:
    record = record_of(LOSSES["quadratic drag"])
    base = record.base
    larger = weighed(record, "quadratic drag")
    assert record.better_from(larger) is None  # it is where it is most likely
    # A base whose weighing had missed its optimum.
    off = replace(base, log_evidence=base.log_evidence - 100.0)
    better = replace(record, base=off).better_from(larger)
    assert better is not None
    assert better.base.log_evidence == pytest.approx(base.log_evidence, abs=0.5)
    assert better.base.names == base.names


def pushed_at_random() -> ph.Measurements:
    """Positions of an oscillator under a strong random force."""
    rng = np.random.default_rng(1)
    dt = 0.1
    x = np.zeros((400, 2))
    step = ph.simulate(oscillator(1.0), [0.0, dt], [1.0, 0.0])[1]
    other = ph.simulate(oscillator(1.0), [0.0, dt], [0.0, 1.0])[1]
    transition = np.column_stack([step, other])
    for i in range(1, len(x)):
        push = np.array([dt / 2, 1.0]) * rng.normal(0.0, 1.0) * np.sqrt(dt)
        x[i] = transition @ x[i - 1] + push
    x[:, 0] += 0.02 * rng.normal(size=len(x))
    x[:, 1] = np.nan
    return ph.Measurements.from_arrays(dt * np.arange(len(x)), x, states=["x", "v"])


def test_the_base_begins_where_its_fit_began_too() -> None:
    """Without an exchange of heat a fit makes a room so large that nothing heats it."""
    case = rooms(np.random.default_rng(77_113))
    fit = ph.identify(case.model, case.data[:-1])
    assert fit.start == {"C1": 20.0, "g1": 0.4, "C2": 20.0, "g2": 0.4}
    assert fit.values["C2"] > 1e3
    record = EvidenceRecord.of(ph.compare(fit, case.data[:-1]).record, None)
    better = record.better_at(fit.start)
    assert better is not None
    assert better.base.log_evidence > record.base.log_evidence + 30
    assert 10 < better.base.model.values["C2"] < 40
    assert better.better_at(fit.start) is None


def test_what_a_model_leaves_is_noise_or_not() -> None:
    record = record_of(LOSSES["quadratic drag"])
    whole = weighed(record, "quadratic drag")
    assert abs(record.log_noise(whole) - whole.log_likelihood) < DECISIVE_EVIDENCE
    assert record.log_noise(record.base) > record.base.log_likelihood + 20


def test_parameters_are_where_the_evidence_is_largest_and_not_beside_it() -> None:
    # The most likely parameters together with forces let the forces do the most.
    data = pushed_at_random()
    fit = ph.identify(oscillator(1.0), data)
    record = EvidenceRecord.of(ph.compare(fit, data).record, None)
    base = record.base
    assert base.processes is not None
    problem = record.weighing.problem(base)
    problem = problem.tilted(problem.optimum(problem.values.point.scaled, 0))
    for place, spread in enumerate(np.sqrt(np.diag(base.covariance))):
        for sign in (-1.0, 1.0):
            z = problem.values.point.scaled.copy()
            z[place] += sign * spread / problem.values.scale[place]
            held = replace(problem, moving=problem.moving[:0])
            beside = JointPoint(z, np.concatenate(base.processes), np.zeros(0))
            there = held.optimum(z, beside=beside).likelihood
            likelihood = there.at(base.disturbances).log_likelihood
            assert likelihood < base.log_likelihood


# --- the evidence


def oscillator(unit: float) -> ph.FirstOrder:
    """Its velocity is told in a unit of its own."""
    k = ph.Parameter(2.0, lower=0)
    c = ph.Parameter(0.2, lower=0)
    rates = {
        "x": ph.formula(f"v/{unit}"),
        "v": ph.formula(f"-{unit}*k*x - c*v", k=k, c=c),
    }
    return ph.FirstOrder(["x", "v"], rates)


def evidence_of(unit_x: float = 1.0, unit_v: float = 1.0, begin: float = 0.0) -> float:
    """Of the same runs, in other units of the states, at other times."""
    runs = []
    for run in measured(LOSSES["quadratic drag"]).trajectories:
        runs.append(unit_x * run.x)
    data = ph.Measurements.from_arrays([T + begin] * len(runs), runs, states=["x", "v"])
    fit = ph.identify(oscillator(unit_v / unit_x), data)
    record = EvidenceRecord.of(ph.compare(fit, data).record, None)
    return record.base.log_evidence


def test_the_evidence_depends_on_no_unit_and_not_on_when_the_clock_began() -> None:
    expected = evidence_of()
    assert evidence_of(unit_v=1e3) == pytest.approx(expected, abs=0.1)
    assert evidence_of(begin=100.0) == pytest.approx(expected, abs=0.1)
    # A density of measured values is per unit of each.
    n = len(STARTS) * len(T)
    in_other_unit = evidence_of(unit_x=10.0) + n * np.log(10.0)
    assert in_other_unit == pytest.approx(expected, abs=0.1)


def test_what_is_not_there_costs_half_the_logarithm_of_the_number_of_values() -> None:
    record = record_of("0.1")
    price = np.log(len(STARTS) * len(T)) / 2
    for name in ("constant force", "cubic stiffness"):
        gain = weighed(record, name).log_evidence - record.base.log_evidence
        # What a parameter of no use explains is chi-square distributed: half of it is
        # above 3.3 once in a hundred.
        assert -price - 0.1 < gain < -price + 3.3


@pytest.mark.parametrize("name", LOSSES)
def test_what_is_hidden_is_decisive_and_takes_over_the_force(name: str) -> None:
    record = record_of(LOSSES[name])
    found = weighed(record, name)
    assert found.log_evidence - record.base.log_evidence > DECISIVE_EVIDENCE
    assert found.force_share(1) < 0.5 * record.base.force_share(1)


def test_the_evidence_is_that_of_the_training_and_what_the_data_held_out_add() -> None:
    record = record_of(LOSSES["quadratic drag"], is_held_out=True)
    found = weighed(record, "quadratic drag")
    both = found.log_training + found.log_held_out
    assert both == pytest.approx(found.log_evidence)
    assert record.n_fitted_nodes == 2 * len(T)
    alone = record_of(LOSSES["quadratic drag"])
    # Three runs are the same ones whether the last is held out or not.
    assert found.log_evidence == pytest.approx(
        weighed(alone, "quadratic drag").log_evidence, abs=0.2
    )
    assert alone.base.log_training == alone.base.log_evidence
    # What is said of the training data is what they say alone.
    two = record_of(LOSSES["quadratic drag"], is_held_out=True, is_alone=True)
    n_free = 2 * (len(T) - 2)  # of a likelihood without the factors 2 pi
    expected = two.base.log_evidence + n_free * np.log(2 * np.pi) / 2
    assert record.base.log_training == pytest.approx(expected, abs=1.0)


def test_no_force_is_needed_where_nothing_is_missing() -> None:
    data = measured("0.1")
    fit = ph.identify(spring(k=positive(2.0)), data)
    record = record_of("0.1")
    alone = record.fitted([ph.compare(fit, data)], has_force=False)
    assert alone.force_share(1) == 0
    gain = record.base.log_evidence - alone.log_evidence
    assert gain < DECISIVE_EVIDENCE
    lossy = measured(LOSSES["quadratic drag"])
    fit = ph.identify(spring(k=positive(2.0)), lossy)
    record = record_of(LOSSES["quadratic drag"])
    alone = record.fitted([ph.compare(fit, lossy)], has_force=False)
    assert record.base.log_evidence - alone.log_evidence > DECISIVE_EVIDENCE


# --- an effect with a memory


def pushed(shown: str = "u") -> ph.PseudoHamiltonian:
    """A driven spring of which the stiffness is to be found."""
    return pair("k*q**2/2 + p**2/2", "0.3", shown, k=positive(2.0))


def late_by(delay: float, n_samples: int) -> EvidenceRecord:
    """The spring beside a force, where its drive acts later than it was noted."""
    t = 0.1 * np.arange(n_samples)
    u = np.sin(0.9 * t) + 0.7 * np.sin(2.3 * t)
    acts = np.interp(t - delay, t, u)
    x = ph.simulate(pushed().with_values({"k": 2.3}), t, [0.5, 0.0], acts[:, None])
    x[:, 0] += NOISE * np.random.default_rng(1).normal(size=len(t))
    x[:, 1] = np.nan
    data = ph.Measurements.from_arrays(
        t, x, u[:, None], states=["q", "p"], inputs=["u"]
    )
    fit = ph.identify(pushed(), data)
    return EvidenceRecord.of(ph.compare(fit, data).record, None)


@pytest.mark.parametrize("name", ["input lag", "input delay"])
def test_what_is_late_is_weighed_and_a_memory_begins_near_rest(name: str) -> None:
    late, n_samples = 0.25, 121
    record = late_by(late, n_samples)
    found = weighed(record, name)
    assert found.log_evidence - record.base.log_evidence > DECISIVE_EVIDENCE
    n_states = 2 + (name == "input lag")
    assert found.states.shape == (n_samples, n_states)
    new = [n for n in found.names if n not in record.base.names]
    (place,) = [found.names.index(n) for n in new]
    assert found.theta[place] == pytest.approx(late, rel=0.15)


# --- screening


def test_screening_expects_the_coefficient_that_is_weighed() -> None:
    record = record_of(LOSSES["quadratic drag"])
    expected = screened(record, "quadratic drag")
    found = record.weighed(expected.model, expected.values)
    place = found.names.index("quadratic_drag_p")
    error = np.sqrt(found.covariance[place, place])
    assert abs(expected.coefficient - found.theta[place]) < 2 * error
    # It is expected beside the whole force, and found beside what is left of it.
    assert expected.std_error > error
    assert expected.gain > DECISIVE_EVIDENCE


# --- grades, and how far a study goes


def test_a_grade_is_that_of_all_data_and_of_what_was_weighed_alone() -> None:
    effect = effect_named(spring(), "constant force", "p")
    one = ph.Candidate(effect, 0.1, 0.01, log_bayes=3.5, was_weighed=True)
    assert one.grade == Grade.STRONG
    assert replace(one, log_predictive=2.0).grade == Grade.DECISIVE
    assert replace(one, log_predictive=-3.0).grade == Grade.WEAK
    assert replace(one, log_predictive=-4.0).grade == Grade.NONE
    assert replace(one, log_bayes=np.nan).grade == Grade.NONE
    assert replace(one, was_weighed=False).grade == Grade.NONE


# --- what screening expects


def test_screening_expects_no_gain_of_a_sensor_from_what_forces_can_do() -> None:
    """The volume of states and forces depends on it: without its slope it promises."""
    rng = np.random.default_rng(7)
    runs = []
    for start in STARTS:
        push = np.cumsum(0.2 * rng.normal(size=len(T)))
        push -= np.linspace(push[0], push[-1], len(T))

        def force(t: float, x: np.ndarray, push: np.ndarray = push) -> np.ndarray:
            return np.array([0.0, np.interp(t, T, push)])

        x = ph.simulate(spring(), T, start, force=force)
        x[:, 0] += NOISE * rng.normal(size=len(T))
        x[:, 1] = np.nan
        runs.append(x)
    data = ph.Measurements.from_arrays([T] * 3, runs, states=["q", "p"])
    fit = ph.identify(spring(k=positive(2.0)), data)
    record = EvidenceRecord.of(ph.compare(fit, data).record, None)
    gain = effect_named(record.base.model, "sensor gain", "q")
    linearized = LinearizedRecord.beside_force(record)
    found = ScoreTest(linearized).screened(gain)
    without = ScoreTest(replace(linearized, record=None)).screened(gain)
    assert found is not None and without is not None
    assert found.gain < 0 and without.gain > 10
    evidence = record.weighed(found.model, found.values).log_evidence
    assert evidence < record.base.log_evidence


def test_a_force_of_a_model_without_the_memory_serves_the_list_without_force() -> None:
    rng = np.random.default_rng(66007)
    t = np.linspace(0.0, 10.0, 101)
    q = np.cos(2 * t) * np.exp(-0.1 * t) + 0.01 * rng.standard_normal(101)
    states = np.column_stack([q, np.full(101, np.nan)])
    data = ph.Measurements.from_arrays([t], [states], states=["q", "p"])
    model = pair("k*q**2/2 + p**2/2", "c")
    base = ph.identify(model, data)
    larger = ph.identify(base.model.add("hysteresis"), data, start=base)
    record = Record.of(base, data).refitted(larger)
    assert record.estimate.x.shape[1] == 2
    linearized = LinearizedRecord.without_force(record)
    assert linearized.states.shape == (101, 3)
