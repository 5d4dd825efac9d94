"""A learned force as a stop-gap, and the terms it is written as."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.estimation.record import Record
from phsi_opt.learning.distillation import short_form
from phsi_opt.learning.learned_force import LearnedForce, distil, learned_force
from phsi_opt.learning.orthogonal_network import ForceSamples, Response

TIMES = np.arange(0.0, 12.01, 0.08)


def spring(hidden: str = "", known: bool = True) -> ph.PseudoHamiltonian:
    """q' = p, p' = -k q - c p + hidden, with k and c free unless ``known``."""
    k = 2.0 if known else ph.Parameter(1.0, lower=0.0)
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        R={"p": ph.formula("0.2") if known else ph.damping("p")["p"]},
        H=ph.formula("k*q**2/2 + p**2/2", k=k),
        F={"p": ph.formula(hidden)} if hidden else {},
    )


def measured(
    hidden: str, starts: Sequence[tuple[float, float]], seed: int
) -> ph.Measurements:
    """The position alone, with noise of 1 % of its spread."""
    rng, runs = np.random.default_rng(seed), []
    for start in starts:
        x = ph.simulate(spring(hidden), TIMES, start)
        x[:, 0] += 0.01 * x[:, 0].std() * rng.normal(size=len(x))
        x[:, 1] = np.nan
        runs.append(x)
    return ph.Measurements.from_arrays([TIMES] * len(runs), runs, states=["q", "p"])


class Case:
    """A spring with a hidden force: base fit, both records, and the learned force."""

    def __init__(self, hidden: str, on: Sequence[str]) -> None:
        self.train = measured(hidden, [(1.5, 0.0), (-1.0, 1.0)], seed=0)
        self.held_out = measured(hidden, [(1.2, -0.5)], seed=9)
        self.fit = ph.identify(spring(known=False), self.train)
        record = Record.of(self.fit, self.train)
        self.samples = ForceSamples.of(record, "p", on)
        self.learned = learned_force(record, equation="p", on=on, epochs=40)
        self.before = ph.compare(self.fit, self.held_out)

    def rmse(self, learned: LearnedForce) -> float:
        return ph.compare(learned.fit, self.held_out).rmse


@pytest.fixture(scope="module")
def pulse() -> Case:
    return Case("-1.5*exp(-((q - 0.6)/0.2)**2)", ["q"])


@pytest.fixture(scope="module")
def nothing() -> Case:
    return Case("", ["q"])


@pytest.fixture(scope="module")
def coupled() -> Case:
    return Case("-0.3*q**2*p", ["q", "dH_dp"])


def test_a_pulse_outside_the_catalogue_is_learned_and_the_held_out_error_falls(
    pulse: Case,
) -> None:
    assert pulse.before.rmse > 10 * pulse.before.noise_floor
    assert pulse.learned.explains > 0.9
    assert pulse.rmse(pulse.learned) < 0.2 * pulse.before.rmse
    beside = Record.of(pulse.learned.fit, pulse.train).estimate.w
    before = pulse.samples.w
    assert np.sqrt(np.mean(beside**2)) < 0.5 * np.sqrt(np.mean(before**2))
    # The free run needs both: with the parameters of the first fit, which had stood in
    # for the force, it is worse.
    without = replace(pulse.learned, physics=pulse.fit)
    assert pulse.rmse(pulse.learned) < 0.6 * pulse.rmse(without)


def test_the_learned_force_is_orthogonal_to_what_the_free_parameters_can_produce(
    coupled: Case,
) -> None:
    samples = coupled.samples
    assert samples.physics.shape[1] == 2  # stiffness and damping
    force = coupled.learned.at(samples.v) / samples.std
    assert np.linalg.norm(samples.physics.T @ force) < 1e-9 * np.linalg.norm(force)
    # The missing force itself is not: that share of it went to the parameters.
    missing = samples.w / samples.std
    assert np.linalg.norm(samples.physics.T @ missing) > 0.05 * np.linalg.norm(missing)


def test_with_nothing_hidden_it_explains_nothing_and_says_so(nothing: Case) -> None:
    assert nothing.learned.explains < 0.05
    # noise of 151 samples moves it by 5 %
    assert nothing.rmse(nothing.learned) == pytest.approx(nothing.before.rmse, rel=0.01)


def test_a_pulse_becomes_one_term_with_its_place_and_width(pulse: Case) -> None:
    (effect,) = distil(pulse.learned, pulse.train)
    assert (effect.slot, effect.equation) == ("F", "p")
    fit = ph.identify(pulse.fit.model.add(effect), pulse.train)
    after = ph.compare(fit, pulse.held_out)
    # 15 %: the noise of 151 samples is known to 5 %
    assert after.rmse < 1.15 * after.noise_floor
    for name, true in (("", -1.5), (".centre", 0.6), (".width", 0.2)):
        found = fit.values[f"learned_p_1{name}"]
        error = fit.std_errors[f"learned_p_1{name}"]
        assert abs(found - true) < 4 * error < 0.2 * abs(true)
    # A second one takes a name that is free in the model.
    again = fit.model.add(distil(pulse.learned, pulse.train, fit.model)[0])
    assert {"learned_p_1", "learned_p_2"} < set(again.free)


def test_a_product_of_two_variables_is_distilled_and_the_diagnosis_confirms_it(
    coupled: Case,
) -> None:
    effects = distil(coupled.learned, coupled.train)
    assert [str(effect) for effect in effects] == ["learned q**2*dH_dp on p"]
    found = ph.diagnose(coupled.fit, coupled.train, coupled.held_out, effects=effects)
    assert found.verdict == "missing: named"
    row = found.candidates.iloc[0]
    assert abs(row["coefficient"] + 0.3) < 4 * row["std_error"]
    assert row["held_out_rmse"] < 1.15 * coupled.before.noise_floor


def test_a_force_without_a_short_formula_is_not_distilled(pulse, nothing) -> None:
    assert distil(pulse.learned, pulse.train, most=1, share=0.999999999) == []
    network = nothing.learned.network
    hidden, (weights, bias) = network.layers
    silent = replace(network, layers=(hidden, (0 * weights, 0 * bias)))
    assert distil(replace(nothing.learned, network=silent), nothing.train) == []


@pytest.mark.parametrize(("changed", "message"), [
    ({"on": "q"}, "list of different variables"),
    ({"on": ["dH_dq", "z"]}, "'z' of a learned force is unknown"),
    ({"equation": "q"}, "dq/dt is a kinematic equation"),
    ({"equation": "x"}, "'x' is not a state"),
    ({"epochs": 0}, "at least 1"),
    ({"data": slice(30)}, "29 intervals are too few"),
])  # fmt: skip
def test_bad_settings_and_short_records_are_refused(pulse, changed, message) -> None:
    settings = {"equation": "p", "on": ["q"], **changed}
    data = pulse.train
    if kept := settings.pop("data", None):
        run = data.trajectories[0]
        few = replace(run, t=run.t[kept], x=run.x[kept], u=run.u[kept])
        data = replace(data, trajectories=(few,))
    with pytest.raises((ph.ModelError, ph.DataError), match=message):
        learned_force(Record.of(pulse.fit, data), **settings)


def test_terms_that_the_physics_has_are_never_distilled(pulse: Case) -> None:
    samples = pulse.samples
    v = samples.v[:, 0]
    response = Response.of(Record.of(pulse.fit, pulse.train), row=1)
    of_cubic_spring = response.traces(-(v**3)[:, None])[:, 0]
    beside = replace(response, residual=of_cubic_spring)
    (cubic,) = short_form(["q"], samples, beside, -2.0 * v - v**3, most=3, share=0.9)
    assert cubic.body == "q**3" and cubic.coefficient is not None
    # 1 %: the curve is taken in the middle of the intervals, the physics at the stages
    # of SRK4
    assert cubic.coefficient.value == pytest.approx(-1.0, rel=0.01)


def test_the_formula_in_the_model_is_the_network_and_is_held_at_the_edge_of_the_data(
    coupled: Case,
) -> None:
    learned = coupled.learned
    x = np.array([[0.3, -0.7], [9.0, 9.0], [-1.0, 1.0]])
    with_force, without = learned.fit.casadi(), learned.physics.casadi()
    added = [float(with_force(row, [], 0.0)[1] - without(row, [], 0.0)[1]) for row in x]
    assert np.allclose(added, learned.at(x), atol=1e-12)  # of mass 1, so dH/dp is p
    at_edge = learned.at(learned.network.seen[1:])
    assert learned.at([[9.0, 9.0]]) == pytest.approx(at_edge)
