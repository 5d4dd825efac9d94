"""Second looks: Gauss-Newton steps along a larger model say what its re-fit will."""

from functools import cache

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.comparison.compare import Comparison
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.doubts import doubt, unconfirmed
from phsi_opt.diagnosis.refit import Refit, RefitRequest, refit
from phsi_opt.diagnosis.remainder import ForceLeft, Remainder
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.effect import Effect
from phsi_opt.screening.effect_size import size_of
from phsi_opt.screening.linearized_record import LinearizedRecord, likelihood_of
from phsi_opt.screening.prospects import Prospects
from phsi_opt.screening.score_test import ScoreTest
from phsi_opt.screening.second_look import second_look

T = np.linspace(0.0, 14.0, 211)
STARTS = ([1.0, 0.0], [-0.7, 0.6], [0.5, -1.0])
NOISE = 0.01


def spring(energy: str, loss: str, **parameters: ph.Parameter) -> ph.PseudoHamiltonian:
    """A unit mass with a potential energy and a loss."""
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula(f"{energy} + p**2/2", **parameters),
        R={"p": ph.formula(loss)},
    )


def base() -> ph.PseudoHamiltonian:
    """What is known: a linear spring and a damper, both free."""
    model = spring("k*q**2/2", "0", k=ph.Parameter(1.8, lower=0))
    return ph.PseudoHamiltonian(
        states=model.states, S=model.S, H=model.H, R=ph.damping("p")
    )


@cache
def diagnosed(energy: str, loss: str) -> DiagnosedModel:
    """The base beside a machine that has more: two runs to fit, one held out."""
    rng = np.random.default_rng(0)
    machine = spring(energy, loss)
    shown = []
    for start in STARTS:
        x = ph.simulate(machine, T, np.array(start))
        x[:, 0] += NOISE * rng.normal(size=len(T))
        x[:, 1] = np.nan
        shown.append(x)
    data = ph.Measurements.from_arrays([T] * 3, shown, states=["q", "p"])
    fit = ph.identify(base(), data[:2])
    trained = ph.compare(fit, data[:2])
    judged = ph.compare(fit, data[2:])
    return DiagnosedModel(trained, judged, ph.MaximumLikelihood(), lambda line: None)


CUBIC = ("2*q**2/2 + 0.8*q**4/4", "0.1")
DRY = ("2*q**2/2", "0.05 + 0.12*(dH_dp**4 + 1e-4)**(-0.25)")


def effect_of(name: str) -> Effect:
    """An effect of the catalogue on the momentum, or on the position's sensor."""
    return effect_named(base(), name, "q" if name.startswith("sensor") else "p")


def prospects_of(machine: tuple[str, str], *names: str) -> Prospects:
    """What is expected of effects on a machine."""
    work = diagnosed(*machine)
    test = ScoreTest(work.record, work.trained.simulated)
    effects = [effect_of(name) for name in names]
    return Prospects.of(test, effects, work.trained, work.judging_record)


def refitted(work: DiagnosedModel, name: str) -> Refit:
    """The base with one effect, re-fitted."""
    done = refit(work, RefitRequest([effect_of(name)], {}))
    assert done is not None
    return done


def misfit_of(done: Comparison, work: Comparison) -> float:
    """Squared residuals of a free run over the noise of another one."""
    residuals = np.concatenate(done.residuals) / work.sigma
    return float(np.nansum(residuals**2))


@pytest.mark.parametrize(
    "name", ["cubic stiffness", "quadratic drag", "constant force", "sensor offset"]
)
def test_a_look_leaves_what_the_re_fit_leaves_on_both_records(name: str) -> None:
    work = diagnosed(*CUBIC)
    found = prospects_of(CUBIC, name)
    (one,) = found.singles
    done = refitted(work, name)
    assert one.misfit == pytest.approx(misfit_of(done.trained, work.trained), rel=0.03)
    expected = misfit_of(done.judged, work.judged)
    if found.score(one) > 0:  # of others it is not asked
        assert one.held_out == pytest.approx(expected, rel=0.1)


def test_an_effect_with_a_memory_is_looked_at_too() -> None:
    work = diagnosed(*DRY)
    (one,) = prospects_of(DRY, "hysteresis").singles
    if one.look is not None:
        assert one.look.states.shape[1] == 3
        assert one.misfit < work.trained.misfit


def test_the_look_at_the_base_is_where_the_base_is_already() -> None:
    work = diagnosed(*CUBIC)
    look = second_look(work.record, (), {})
    assert look is not None
    assert look.misfit == pytest.approx(work.trained.misfit, rel=0.02)
    assert look.model.values["k"] == pytest.approx(work.fit.values["k"], rel=0.01)


def test_parameters_stay_within_their_bounds() -> None:
    work = diagnosed(*CUBIC)
    (one,) = prospects_of(CUBIC, "coulomb friction").singles
    assert one.look is not None
    for name, entry in one.look.model.entries.items():
        value = one.look.model.values[name]
        assert entry.parameter.lower <= value <= entry.parameter.upper
    assert one.misfit <= 1.001 * work.trained.misfit


def test_a_parameter_that_ends_at_a_bound_is_exactly_there() -> None:
    record = diagnosed(*CUBIC).record
    starts = [(lower, 40.1) for lower in np.linspace(3e-3, 3.1, 20)]
    starts += [(0.0, value) for value in np.linspace(0.7, 40.1, 20)]
    for lower, value in starts:  # rounding reaches some by chance
        stiffness = ph.Parameter(value, lower=float(lower))
        model = spring("(k + 3)*q**2/2", "0.1", k=stiffness)
        start = np.array([[value, value]])
        likelihood = likelihood_of(record, model, record.estimate.grid)
        at = LinearizedRecord.at(record, likelihood, record.estimate.x, start)
        assert np.all(at.parameters_within_bounds == lower)


def test_parameters_that_are_held_do_not_move() -> None:
    work = diagnosed(*CUBIC)
    values = {"k": 2.5, "R_p": 0.2}
    look = second_look(work.judged.record, (), values, is_held=True)
    assert look is not None
    assert look.model.values["k"] == pytest.approx(2.5, rel=1e-6)


def test_the_size_and_its_error_are_those_of_the_fit() -> None:
    work = diagnosed(*CUBIC)
    (one,) = prospects_of(CUBIC, "cubic stiffness").singles
    fit = refitted(work, "cubic stiffness").fit
    name = "cubic_stiffness_q"
    assert one.coefficient == pytest.approx(fit.estimates[name], rel=0.02)
    assert one.std_error == pytest.approx(fit.std_errors[name], rel=0.5)


def test_pairs_are_looked_at_with_the_best_effect_and_each_other_one() -> None:
    found = prospects_of(CUBIC, "cubic stiffness", "quadratic drag", "constant force")
    pairs = found.pairs(found.singles)
    assert all(len(pair.effects) == 2 for pair in pairs)
    best = found.singles[0]
    assert best.effect.name == "cubic stiffness"
    assert any(best.effect in pair.effects for pair in pairs)
    for pair in pairs:
        if pair.look is not None and best.effect in pair.effects:
            assert pair.misfit <= 1.01 * best.misfit


def test_the_remainder_tells_a_right_law_from_one_that_only_moves_alike() -> None:
    work = diagnosed(*DRY)
    right = Remainder.of(work, refitted(work, "coulomb friction").fit)
    wrong = Remainder.of(work, refitted(work, "constant force").fit)
    assert right.gone > 0.5 > wrong.gone
    assert "% is gone" in right.words()
    assert "nothing is gone" in wrong.words()


def test_the_force_that_is_gone_is_told_of_the_equation_that_an_effect_acts_in() -> (
    None
):
    forces = (ForceLeft("p1", 148.0, 0.6, "N"), ForceLeft("p2", 731.0, 146.0, "N"))
    remainder = Remainder(forces, 0.1)
    assert remainder.gone == forces[0].gone > 0.99
    term = ph.formula("c", c=ph.Parameter())
    effect = ph.Effect("coupling stiffness", "F", "p2", term)
    said = "in dp2/dt 96 % is gone (rms 731 before, 146 N after)"
    assert remainder.words([effect]) == said
    # Of a sensor there is no force: that of the strongest equation is told.
    sensor = ph.Effect("sensor delay", "sensor", "p2", term)
    assert remainder.words([sensor]).startswith("in dp1/dt 100 % is gone")
    assert Remainder(forces[:1], 0.1).words([effect]) == str(forces[0])


def test_what_is_right_is_not_doubted() -> None:
    work = diagnosed(*CUBIC)
    done = refitted(work, "cubic stiffness")
    effects = [effect_of("cubic stiffness")]
    assert doubt(work, done.fit, effects) == ""
    assert unconfirmed(work, done.fit, done.judged, effects) == ""


def test_a_size_that_may_as_well_be_zero_is_doubted() -> None:
    work = diagnosed(*CUBIC)
    fit = refitted(work, "constant force").fit
    assert "may as well be zero" in doubt(work, fit, [effect_of("constant force")])


def test_a_model_fitted_elsewhere_is_fitted_again_before_anything_is_missing() -> None:
    data = diagnosed("2*q**2/2", "0.1").record.data
    elsewhere = diagnosed("3*q**2/2", "0.15").fit
    found = ph.diagnose(elsewhere, data)
    assert found.verdict == ph.Verdict.NOTHING_MISSING
    assert found.fit.values["k"] == pytest.approx(2.0, rel=0.02)


def test_a_variance_that_rounding_made_negative_leaves_the_error_unknown() -> None:
    model = base()
    drag = effect_of("quadratic drag")
    larger = model.add(drag)
    (name,) = [one for one in larger.free if one not in model.entries]
    size = size_of(drag, larger, [name], {name: 0.3}, np.array([[-1e-20]]))
    assert size.value == 0.3 and np.isnan(size.std_error)
