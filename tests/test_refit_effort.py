"""Work that a diagnosis does not do: re-fits, sharp corners and searches without hope."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.diagnosis import friction_sharpening
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.ranking import _worth_refitting
from phsi_opt.diagnosis.refit import RefitRequest, refit
from phsi_opt.diagnosis.refit_effort import BESIDE_SHARP
from phsi_opt.errors import SolveError
from phsi_opt.estimation import missing_force
from phsi_opt.model.catalogue import effect_named
from phsi_opt.optimization.settings import EXACT, FEASIBLE_PATH
from phsi_opt.screening.prospects import Prospects
from phsi_opt.screening.score_test import ScoreTest
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


def along_solutions(base: DiagnosedModel) -> DiagnosedModel:
    """The same as if its fit had been found beside a sharp corner."""
    outcome = replace(base.fit.outcome, status=FEASIBLE_PATH)
    fit = replace(base.fit, outcome=outcome)
    record = replace(base.record, fit=fit)
    trained = replace(base.trained, record=record)
    return replace(base, trained=trained, judged=trained)


def at_rest(base: DiagnosedModel) -> DiagnosedModel:
    """The same with a free run that does not move."""
    still = tuple(np.zeros_like(x) for x in base.trained.shown)
    runs = zip(base.record.data.trajectories, still, strict=True)
    residuals = tuple(run.x - x for run, x in runs)
    trained = replace(base.trained, shown=still, residuals=residuals)
    return replace(base, trained=trained, judged=trained)


def test_friction_that_may_as_well_be_zero_keeps_its_rounded_corner(
    complete: DiagnosedModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    friction = effect_named(complete.fit.model, "coulomb friction", "p")
    sharper = []
    monkeypatch.setattr(
        friction_sharpening.CornerSharpening,
        "at_widths",
        lambda *arguments: sharper.append(arguments),
    )
    done = refit(complete, RefitRequest([friction], {"coulomb_friction_p": 0.01}))
    assert done is not None and done.before_sharpening is not None
    assert not sharper


def test_only_a_fit_with_a_corner_is_extended_along_solutions(
    complete: DiagnosedModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What else was found along solutions says nothing about a corner."""
    tried = []

    def identified(model: ph.Model, *_: object, **__: object) -> ph.Fit:
        tried.append(model)
        raise SolveError("not here")

    monkeypatch.setattr(friction_sharpening, "identify_aligned", identified)
    fit = along_solutions(complete).fit
    drag, dry = (
        effect_named(fit.model, name, "p")
        for name in ("cubic drag", "coulomb friction")
    )
    force = effect_named(fit.model, "constant force", "p")
    for effect, n_tried in ((drag, 0), (dry, 1)):
        model = fit.model.add(effect)
        model = model.with_values(dict.fromkeys(model.entries, 0.1))
        corners = friction_sharpening.CornerSharpening(
            complete, complete.record.aligned, [effect, force]
        )
        known = [replace(fit, model=model)]
        assert corners.extended(model.add(force), 1, known) is None
        assert len(tried) == n_tried


def test_corners_beside_a_memory_stay_as_they_are_where_the_states_are_many(
    complete: DiagnosedModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    aligned = complete.record.aligned
    delay = effect_named(complete.fit.model, "sensor delay", "q")
    fit = replace(complete.fit, model=complete.fit.model.add(delay))
    monkeypatch.setattr(friction_sharpening, "MOST_SHARP_STATES", 100)
    corners = friction_sharpening.CornerSharpening(complete, aligned, [delay])
    assert fit.model.memory and corners.at_widths(fit, {}, 8) is None


def test_what_no_look_settles_on_is_not_re_fitted_where_noise_is_all_that_is_left(
    complete: DiagnosedModel,
) -> None:
    listed = [effect_named(complete.fit.model, "cubic drag", "p")]
    test = ScoreTest(complete.record, complete.trained.simulated)
    prospects = Prospects.of(test, listed, complete.trained)
    unsettled = [replace(one, look=None) for one in prospects.singles]
    assert not _worth_refitting(complete, replace(prospects, singles=tuple(unsettled)))
    assert _worth_refitting(complete, prospects)
    without_motion = at_rest(complete)
    failed = replace(prospects, singles=tuple(unsettled))
    assert _worth_refitting(without_motion, failed)
    assert not _worth_refitting(along_solutions(without_motion), failed)


def test_a_run_that_follows_the_record_has_not_lost_its_way(
    complete: DiagnosedModel,
) -> None:
    assert not complete.is_far_off
    assert at_rest(complete).is_far_off


def test_beside_a_sharp_corner_the_exact_hessian_has_few_iterations(
    complete: DiagnosedModel,
) -> None:
    settings = replace(BESIDE_SHARP, ways=(EXACT,), max_iterations=2)
    far = spring(ph.Parameter(3.0, lower=0.0))
    data = complete.record.data
    start = replace(complete.fit, model=far)
    stopped = ph.identify(
        far, data, start=start, settings=settings, raise_on_failure=False
    )
    assert stopped.outcome.iterations <= 2


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
    missing_force.smoothed(model, grid, np.ones(2), "srk4", known_noise=True)
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
