"""Re-fits: beside a memory, and what is not tried: sharp corners without hope."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.comparison.compare import compare_record, deviance
from phsi_opt.diagnosis import refit as refits
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.refit import DiagnosedModel, refit
from phsi_opt.estimation import missing_force
from phsi_opt.model.catalogue import effect_named
from phsi_opt.transcription.grid import grid_of

T = np.linspace(0.0, 12.0, 161)
STARTS = ([1.0, 0.0], [-0.7, 0.9])


def spring(damping: ph.Parameter | float) -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("1.7*q**2/2 + p**2/2"),
        R={"p": ph.formula("c", c=damping)},
    )


@pytest.fixture(scope="module")
def complete() -> DiagnosedModel:
    """A damped spring of which nothing is missing."""
    rng = np.random.default_rng(0)
    runs = [ph.simulate(spring(0.1), T, x0) for x0 in STARTS]
    runs = [x + 0.01 * rng.normal(size=x.shape) for x in runs]
    for x in runs:
        x[:, 1] = np.nan
    data = ph.Measurements.from_arrays([T] * 2, runs, states=["q", "p"])
    fit = ph.identify(spring(ph.Parameter(0.2, lower=0.0)), data)
    trained = ph.compare(fit, data)
    return DiagnosedModel(trained, trained, ph.MaximumLikelihood(), say=print)


def test_corners_beside_a_memory_stay_as_they_are_where_the_states_are_many(
    complete: DiagnosedModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    delay = effect_named(complete.fit.model, "sensor delay", "q")
    fit = replace(complete.fit, model=complete.fit.model.add(delay))
    monkeypatch.setattr(refits, "MOST_SHARP_STATES", 100)
    late = refits.Refitting(complete, Candidate(delay, 0.0, np.nan))
    assert fit.model.memory and late.at_widths(fit, {}, 8) is None


def test_a_second_effect_is_refitted_beside_the_memory_of_the_first(
    complete: DiagnosedModel,
) -> None:
    record = complete.record
    delay = effect_named(complete.fit.model, "sensor delay", "q")
    late = ph.identify(complete.fit.model.add(delay), record.data, start=complete.fit)
    # The missing force beside it is that of the model without a memory.
    trained = compare_record(record.refitted(late))
    base = replace(complete, trained=trained, judged=trained)
    drag = effect_named(late.model, "quadratic drag", "p")
    done = refit(base, Candidate(drag, 0.0, np.nan, values={}, log_bayes=0.0))
    assert done is not None
    assert done.fit.model.memory == late.model.memory
    assert done.fit.states[0].shape == (len(T), late.model.n_states)
    assert deviance(done.fit) <= deviance(late) + 0.1  # a brief solve


@dataclass(frozen=True)
class Searched:
    """What a search for the missing force would give."""

    has_converged: bool
    rounded: dict[str, float] = field(default_factory=dict)


def searches(
    monkeypatch: pytest.MonkeyPatch, converges_at: tuple[float, bool]
) -> list[tuple[float, bool]]:
    """Corner widths and patience of all searches, until one of them converges."""
    tried: list[tuple[float, bool]] = []

    def estimate_force(
        model: ph.PseudoHamiltonian, *_: object, is_patient: bool, **__: object
    ) -> Searched:
        tried.append((model.values["v0"], is_patient))
        return Searched(tried[-1] == converges_at)

    monkeypatch.setattr(missing_force, "estimate_force", estimate_force)
    monkeypatch.setattr(missing_force, "corner_widths", lambda model: {"v0": None})
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("q**2/2 + p**2/2"),
        R={"p": ph.formula("(dH_dp**4 + v0**4)**(-1/4)", v0=1.0)},
    )
    runs = [ph.simulate(model, T, [1.0, 0.0])]
    data = ph.Measurements.from_arrays([T], runs, states=["q", "p"])
    grid = grid_of(data)
    missing_force.smoothed(model, grid, np.ones(2), known_noise=True)
    return tried


def test_a_corner_is_rounded_before_a_search_takes_many_iterations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried = searches(monkeypatch, converges_at=(4.0, False))
    assert tried == [(1.0, False), (4.0, False)]


def test_patience_takes_up_the_first_search_where_no_rounded_corner_helps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried = searches(monkeypatch, converges_at=(1.0, True))
    widths = [1.0, 4.0, 16.0, 64.0, 1.0]
    assert tried == [*((width, False) for width in widths), (1.0, True)]
