"""The evidence for a model, log Z: the force that it lacks is integrated out."""

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.model.catalogue import effect_named
from problems.examples.demo import model as spring
from problems.examples.friction_spring import table

DECISIVE = np.log(100)


def record(friction: float) -> ph.Measurements:
    return ph.Measurements.from_dataframe(
        table(3, friction),
        time="t_s",
        states={"q": "position_m", "p": None},
        trajectory="run",
        units={"q": "m", "p": "kg m/s", "t": "s"},
    )


@pytest.fixture(scope="module")
def rubbing() -> tuple[ph.Measurements, ph.Fit]:
    train, _ = record(2.0).split(0.6)
    return train, ph.identify(spring(), train)


def gain(data: ph.Measurements, fit: ph.Fit, name: str) -> float:
    """Logarithm of the Bayes factor of an effect over the model beside a force."""
    effect = effect_named(spring(), name, "p")
    larger = ph.identify(spring().add(effect), data, start=fit)
    return larger.log_evidence - fit.log_evidence


def test_the_true_effect_is_decisive_and_others_are_not(
    rubbing: tuple[ph.Measurements, ph.Fit],
) -> None:
    train, fit = rubbing
    assert fit.has_model_error or len(fit.model_error)
    assert gain(train, fit, "coulomb friction") > DECISIVE
    for other in (
        "quadratic drag",
        "constant force",
        "cubic stiffness",
    ):
        assert gain(train, fit, other) < 0.1


def test_where_nothing_is_missing_no_effect_gains() -> None:
    train, _ = record(0.0).split(0.6)
    fit = ph.identify(spring(), train)
    for effect in (
        "coulomb friction",
        "quadratic drag",
        "constant force",
    ):
        assert gain(train, fit, effect) < np.log(20)


def test_it_is_kept_with_the_fit_and_unknown_without_a_likelihood(
    rubbing: tuple[ph.Measurements, ph.Fit], tmp_path: object
) -> None:
    _, fit = rubbing
    path = f"{tmp_path}/fit.json"
    fit.save(path)
    assert ph.Fit.load(path).log_evidence == fit.log_evidence
    t = np.linspace(0, 5, 51)
    model = ph.FirstOrder(states=["x"], F={"x": ph.formula("-a*x", a=ph.Parameter(1))})
    data = ph.Measurements.from_arrays(t, np.exp(-0.5 * t)[:, None], states=["x"])
    assert np.isnan(ph.identify(model, data, ph.PHSILoss()).log_evidence)
