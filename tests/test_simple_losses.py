"""The losses of one number, each begun at the force of another."""

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.simple_losses import is_simple_loss, matched

LEAK = 0.4


@pytest.fixture(scope="module")
def emptying() -> tuple[DiagnosedModel, ph.Fit, dict[str, ph.Effect]]:
    """A tank that leaks, a model without the leak, its fit with a linear one."""
    t = np.arange(0, 10, 0.1)
    level = 2 * np.exp(-LEAK * t)
    noise = 0.002 * np.random.default_rng(1).normal(size=level.shape)
    data = ph.Measurements.from_arrays([t], [(level + noise)[:, None]], states=["h"])
    inflow = ph.formula("c", c=ph.Parameter(0.0, lower=0))
    tank = ph.PseudoHamiltonian(
        states=["h"],
        S=np.zeros((1, 1)),
        H=ph.formula("h**2/2"),
        F={"h": inflow},
        kind="hydraulic",
    )
    fit = ph.identify(tank, data)
    trained = ph.compare(fit, data)
    base = DiagnosedModel(trained, trained, ph.MaximumLikelihood(), say=print)
    listed = {effect.name: effect for effect in ph.catalogue(fit.model)}
    larger = ph.identify(fit.model.add(listed["linear leak"]), data)
    return base, larger, listed


def test_another_loss_begins_where_its_force_is_nearest(
    emptying: tuple[DiagnosedModel, ph.Fit, dict[str, ph.Effect]],
) -> None:
    base, larger, listed = emptying
    linear = listed["linear leak"]
    quadratic = matched(base, larger, linear, listed["quadratic leak"])
    x = np.concatenate(list(larger.states))[:, 0]
    expected = LEAK * np.sum(x * x * np.abs(x)) / np.sum(x**4)
    assert list(quadratic.values()) == pytest.approx([expected], rel=0.02)


def test_a_loss_whose_corner_is_known_has_one_number_to_begin_with(
    emptying: tuple[DiagnosedModel, ph.Fit, dict[str, ph.Effect]],
) -> None:
    base, larger, listed = emptying
    for effect in listed.values():
        if is_simple_loss(effect) and effect.name != "linear leak":
            begun = matched(base, larger, listed["linear leak"], effect)
            (value,) = begun.values()
            assert value > 0
