"""Starts along the missing force, for a model whose fit has lost its way."""

from dataclasses import replace

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.regressed_start import regressed
from problems.field_machines.cases import draw
from problems.field_machines.kinds import KINDS


@pytest.fixture(scope="module")
def lost() -> DiagnosedModel:
    """A pendulum over the top, its friction missing, at a fit without gravity.

    Which optimum a fit loses its way to depends on rounding, so it is made here.
    """
    case = draw(KINDS["starts_off"], 300)
    energy = "p**2/(2*0.8651155811320423) - G*cos(q)"

    def model(G: ph.Parameter | float) -> ph.Model:
        return replace(case.model, H=ph.formula(energy, G=G))

    fit = ph.identify(model(0.0), case.train)
    fit = replace(fit, model=model(ph.Parameter(0.0, lower=0.0)))
    trained = ph.compare(fit, case.train)
    return DiagnosedModel(trained, trained, ph.MaximumLikelihood(), say=print)


def test_gravity_and_friction_are_found_along_the_force(lost: DiagnosedModel) -> None:
    listed = {str(effect): effect for effect in ph.catalogue(lost.fit.model)}
    begun = regressed(lost, listed["coulomb friction on p"])
    assert begun["G"] == pytest.approx(4.2, rel=0.1)
    assert begun["coulomb_friction_p"] > 0


def test_bounds_hold_for_a_loss_that_would_give_energy(lost: DiagnosedModel) -> None:
    for effect in ph.catalogue(lost.fit.model):
        if effect.slot == "R":
            begun = regressed(lost, effect)
            assert np.all(np.isfinite(list(begun.values())))
            assert min(begun.values()) >= 0
