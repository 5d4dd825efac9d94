"""Verdicts from given evidence, errors and forces: nothing is fitted here."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
from phsi_opt.comparison import compare
from phsi_opt.criteria import THOROUGH_ITERATIONS
from phsi_opt.diagnosis import conclusion, refit
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.data_causes import DataCause
from phsi_opt.diagnosis.refit import DiagnosedModel
from phsi_opt.errors import SolveError
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.functions import function_named
from phsi_opt.model.laws import effect_words
from phsi_opt.screening.effect_size import Size
from tests.systems import damped_spring

MODEL = damped_spring()
DAMPER = effect_named(MODEL, "viscous damping", "p")
FRICTION = effect_named(MODEL, "coulomb friction", "p")
PUSH = effect_named(MODEL, "constant force", "p")
SPRING = effect_named(MODEL, "cubic stiffness", "p")
WAVE = effect_named(MODEL, "harmonic force", "p")
OFFSET = effect_named(MODEL, "sensor offset", "q")
NAMED, PARTLY_NAMED = ph.Verdict.NAMED, ph.Verdict.PARTLY_NAMED
UNEXPLAINED, NOTHING = ph.Verdict.UNEXPLAINED, ph.Verdict.NOTHING_MISSING


def told(effect: ph.Effect) -> str:
    return effect_words(effect, {})


def positions(q: np.ndarray) -> ph.Measurements:
    x = np.column_stack([q, np.full(len(q), np.nan)])
    return ph.Measurements.from_arrays(np.arange(len(q)), x, states=["q", "p"])


def run(rmse: float, p: float = 0.0, *others: float, lasts: bool = False) -> Any:
    """A free run beside a noise floor of 1 m; ``p`` of the whiteness of each channel.

    ``lasts``: whether the noise was seen to last from sample to sample.
    """
    return SimpleNamespace(
        rmse=rmse,
        noise_floor=1.0,
        error_unit="m",
        bands=None,
        floor_words=lambda: "1 m",
        table=pd.DataFrame({"whiteness": [p, *others]}),
        record=SimpleNamespace(
            is_of_training=True,
            shows_correlated_noise=lasts,
            has_correlated_noise=lasts,
            data=positions(np.sin(np.arange(40.0))),
        ),
        fit=SimpleNamespace(
            model=MODEL, names=(), outcome=SimpleNamespace(at_bounds=())
        ),
    )


def fitted(trained: Any, judged: Any = None) -> DiagnosedModel:
    return DiagnosedModel(trained, judged or trained, ph.MaximumLikelihood())


def candidate(effect: ph.Effect, evidence: float, **known: Any) -> Candidate:
    """A weighed effect of a size of 2 +- 0.1, which takes over the whole force."""
    known = {"force_left": 0.0, "was_weighed": True} | known
    return Candidate(effect, 2.0, 0.1, log_bayes=evidence, **known)


@dataclass
class Case:
    """What is known before the verdict."""

    candidates: list[Candidate]
    base: DiagnosedModel = field(default_factory=lambda: fitted(run(10.0)))
    # The re-fit with each effect, by name; None where it fails.
    larger: Mapping[str, DiagnosedModel | None] = field(default_factory=dict)
    std_errors: Mapping[str, float] = field(default_factory=dict)  # of re-fits
    # A re-fit made thorough, where it is another.
    thorough: DiagnosedModel | None = None
    # What is decisive only from a second place.
    again: list[Candidate] = field(default_factory=list)
    # What a search finds besides: effects, their log evidence, and what each is worth.
    several: list[tuple[tuple[ph.Effect, ...], float, tuple[float, ...]]] = field(
        default_factory=list
    )
    alike: dict[str, list[ph.Effect]] = field(default_factory=dict)
    force_left: float = 0.0  # beside several
    alone: float | None = -100.0  # log evidence without a force; None: not found
    functions: list[Candidate] = field(default_factory=list)  # unknown ones
    are_candidates: bool = True

    def concluded(self) -> ph.Diagnosis:
        base = SimpleNamespace(
            log_evidence=0.0,
            disturbances=SimpleNamespace(forces=[SimpleNamespace(place=1)]),
        )
        record: Any = SimpleNamespace(base=base, fitted=self.fitted)
        ranking = SimpleNamespace(
            record=record,
            candidates=list(self.candidates),
            screened=dict.fromkeys(one.name for one in self.functions),
        )
        ranking.join = lambda further: ranking.candidates.extend(further.candidates)
        further = SimpleNamespace(candidates=self.functions)
        replaced: dict[str, Any] = {
            "ranked": lambda *_: ranking,
            "rank_again": lambda *_: ranking.candidates.extend(self.again),
            "ranked_functions": lambda *_: further,
            "Search": lambda *_: self.search(),
            "refit": self.refit,
            "thorough_refit": lambda larger: self.thorough or larger,
            "fitted_size": self.size,
        }
        effects = [DAMPER, FRICTION, PUSH, SPRING, WAVE, OFFSET]
        with pytest.MonkeyPatch.context() as patched:
            for name, instead in replaced.items():
                patched.setattr(conclusion, name, instead)
            return conclusion.concluded(
                self.base, record, effects, functions=self.are_candidates
            )

    def refit(self, base: DiagnosedModel, one: Candidate) -> DiagnosedModel | None:
        return self.larger.get(one.name, fitted(run(1.05, p=0.5)))

    def size(self, model: ph.Model, fit: ph.Fit, effect: ph.Effect) -> Size:
        return Size(2.1, self.std_errors.get(str(effect), 0.2), "N")

    def search(self) -> Any:
        found = []
        for effects, evidence, worth in self.several:
            known = {"effects": effects, "log_evidence": evidence, "worth": worth}
            known["name"] = " and ".join(map(str, effects))
            found.append(SimpleNamespace(force_left=self.force_left, **known))
        ran: list[bool] = []
        return SimpleNamespace(
            run=lambda: ran.append(True),
            # Several leave noise alone, and one does where no others are known.
            is_complete=lambda: bool(ran) or not self.several,
            in_order=lambda: found,
            worth=lambda one: dict(zip(map(str, one.effects), one.worth, strict=True)),
            path=lambda one: one.effects[::-1],
            alike=lambda one, name: self.alike.get(name, []),
        )

    def fitted(self, comparisons: Sequence[Any], has_force: bool) -> Any:
        assert not has_force
        if self.alone is None:
            raise SolveError("no such states")
        return SimpleNamespace(log_evidence=self.alone)


def lost(found: ph.Diagnosis) -> dict[str, str]:
    return {one.name: one.lost for one in found.ranking}


# ---- when a model fails, and when a larger one explains it


@pytest.mark.parametrize(("found", "is_white", "is_like"), [
    (run(1.24, 0.5), True, True),
    (run(1.26, 0.5), False, False),
    (run(1.24, 0.0009), False, False),
    (run(1.24, 0.0006, np.nan), True, True),  # of two channels, one with few values
    (run(1.24, 0.0004, 0.9), False, False),
    (run(1.24, 0.0, lasts=True), False, True),
    (run(1.26, 0.5, lasts=True), False, False),
])  # fmt: skip
def test_noise_is_small_and_white_unless_it_lasts(found, is_white, is_like) -> None:
    assert compare.is_white_noise(found) is is_white
    assert compare.is_like_noise(found) is is_like


def test_a_run_fails_that_is_a_tenth_beyond_the_noise() -> None:
    assert [compare.is_failing(run(rmse)) for rmse in (1.09, 1.11)] == [False, True]


def test_the_share_explained_is_of_the_square_above_the_floor() -> None:
    assert compare.explained_share(run(5), run(4)) == pytest.approx(9 / 24)
    assert compare.explained_share(run(5), run(1)) == pytest.approx(1.0)
    assert compare.explained_share(run(1), run(2)) < -1e6


def test_what_was_missing_is_explained_where_noise_or_next_to_nothing_is_left() -> None:
    def explains(trained: Any, judged: Any, base: Any) -> bool:
        return compare.is_explained(base, trained, judged)

    base = run(10.0)
    assert explains(run(1.24, 0.5), run(1.4), base)
    # Data held out that are surely not explained have the last word.
    assert not explains(run(1.24, 0.5), run(9.0), base)
    assert explains(run(1.09), run(1.09), base)
    assert not explains(run(1.11), run(1.09), base)
    assert not explains(run(1.09), run(1.11), base)
    # 97 % of the error above the noise floor are removed, or a little less.
    assert explains(run(1.09), run(1.09), run(2.8))
    assert not explains(run(1.09), run(1.09), run(2.6))
    # Noise that lasts must have been seen before the larger model was fitted.
    lasting = run(1.24, 0.0, lasts=True)
    assert explains(lasting, run(1.4), run(10.0, lasts=True))
    assert not explains(lasting, run(1.4), base)


# ---- named


def test_a_decisive_effect_that_leaves_noise_is_named() -> None:
    others = [candidate(PUSH, 5.0), candidate(SPRING, 3.5), candidate(OFFSET, -1.0)]
    found = Case([candidate(DAMPER, 20.0), *others]).concluded()
    assert (found.verdict, found.proposed) == (NAMED, (DAMPER,))
    assert found.reason == (
        "viscous damping in the equation of p (2.10 +- 0.20 N); the training error falls from 10.0 to "
        "1.05 m, noise floor 1 m; decisive evidence (log evidence 20.0)"
    )
    (finding,) = found.findings
    assert finding.share == pytest.approx((100 - 1.05**2) / 99)
    first = found.ranking[0]
    assert (first.coefficient, first.std_error, first.lost) == (2.1, 0.2, "")
    assert (first.train_rmse, first.share) == (1.05, finding.share)
    assert np.isnan(first.held_out_rmse)
    assert first.fit is found.proposed_fit is first.trained.fit  # type: ignore[union-attr]
    likelier = "viscous damping in the equation of p is more likely"
    assert list(lost(found).values()) == ["", likelier, likelier, likelier]


def test_the_errors_on_the_data_held_out_judge() -> None:
    base = fitted(run(10.0), run(20.0))
    larger = {str(DAMPER): fitted(run(1.0, p=0.5), run(2.0))}
    case = Case([candidate(DAMPER, 20.0)], base, larger)
    found = case.concluded()
    assert "the held-out error falls from 20.0 to 2.00 m" in found.reason
    first = found.ranking[0]
    assert (first.train_rmse, first.held_out_rmse) == (1.0, 2.0)
    assert first.comparison is larger[str(DAMPER)].judged
    assert first.share == found.findings[0].share == pytest.approx(396 / 399)


def test_of_those_that_evidence_does_not_tell_apart_the_simplest_is_first() -> None:
    # Each is strong, both together are decisive. Friction has a speed besides.
    tied = [candidate(FRICTION, 4.4), candidate(DAMPER, 3.2), candidate(SPRING, 1.3)]
    found = Case(tied).concluded()
    assert found.proposed == (DAMPER,)
    assert [one.effects for one in found.findings] == [(DAMPER, FRICTION)]
    assert lost(found) == {
        str(DAMPER): "",
        str(FRICTION): "the data cannot distinguish it from the named effect",
        str(SPRING): "viscous damping in the equation of p is more likely",
    }
    # Of equal ones it is the one that the catalogue has first.
    alike = [candidate(PUSH, 9.0), candidate(DAMPER, 9.0)]
    assert Case(alike).concluded().proposed == (DAMPER,)
    # Alone it is not decisive.
    assert not Case(tied[:1]).concluded().findings


def test_an_effect_whose_re_fit_fails_gives_way_to_the_next() -> None:
    at_bound = run(1.05, p=0.5)
    at_bound.fit.names = ("viscous_damping_p",)
    at_bound.fit.model = MODEL.add(DAMPER)
    at_bound.fit.outcome.at_bounds = ("viscous_damping_p",)
    tied = [
        candidate(PUSH, 20.0),
        candidate(DAMPER, 19.5),
        candidate(SPRING, 19.2),
        candidate(OFFSET, 19),
    ]
    small = {str(PUSH): 1.1}  # whatever its size was beside a force
    larger = {str(DAMPER): fitted(at_bound), str(SPRING): None}
    found = Case(tied, larger=larger, std_errors=small).concluded()
    assert [one.effects for one in found.findings] == [(OFFSET,)]
    assert lost(found) == {
        "sensor offset on q": "",
        "constant force on p": "its size, 2.1 +- 1.1 N, does not differ significantly from zero",
        "viscous damping on p": (
            "the data do not determine it: viscous damping in the equation of p ends at a limit of its range"
        ),
        "cubic stiffness on p": "the fit failed",
    }
    kept = Case(tied[:1], std_errors={str(PUSH): 1.05}).concluded()
    assert kept.verdict == NAMED
    open_ = Case(tied[:1], std_errors={str(PUSH): np.nan}).concluded()
    assert lost(open_) == {
        "constant force on p": "the data do not determine its size",
    }


# ---- named, but not alone


def test_an_effect_beside_which_a_force_is_evident_is_partly_named() -> None:
    larger = {str(DAMPER): fitted(run(6.0))}
    for force_left, is_enough in ((0.7, True), (0.72, False)):
        one = candidate(DAMPER, 20.0, force_left=force_left)
        for alone, is_evident in ((20.0 - 4.7, True), (20.0 - 4.5, False)):
            case = Case([one], larger=larger, alone=alone)
            found = case.concluded()
            assert (found.verdict == NAMED) == (not is_evident)
            assert bool(found.findings)  # it explains 65 % of the error
        case = replace(case, larger={str(DAMPER): fitted(run(9.0))}, alone=None)
        found = case.concluded()
        assert bool(found.findings) == is_enough
    assert found.verdict == UNEXPLAINED and found.proposed == ()
    assert found.reason == (
        "the nearest is viscous damping in the equation of p (2.10 +- 0.20 N; log evidence 20.0): the "
        "training error falls from 10.0 to 9.00 m, noise floor 1 m. It is not named: "
        "it explains only 48 % of what is missing (mean square) and 19 % of the error"
    )
    partly = Case([replace(one, force_left=0.6)], larger=larger, alone=None)
    found = partly.concluded()
    assert found.verdict == PARTLY_NAMED
    assert found.reason.endswith(
        "decisive evidence (log evidence 20.0). It accounts for 64 % of what is missing "
        "(mean square) and 65 % of the squared error above the noise floor; more is "
        "missing"
    )


def test_effects_are_named_that_explain_enough_together_alone() -> None:
    larger = {
        str(DAMPER): fitted(run(9.5)),
        both_name(): fitted(run(1.05, p=0.5)),
    }
    first = candidate(DAMPER, 20.0, force_left=0.9)
    ranking = [first, candidate(SPRING, 6.0), candidate(PUSH, 1.0)]
    both = ((DAMPER, SPRING), 29.0, (23.0, 25.0))
    case = Case(ranking, larger=larger, several=[both], alone=None)
    case = replace(case, alike={str(DAMPER): [FRICTION]})
    found = case.concluded()
    # In the order of the search's path, with what the data do not tell from each.
    assert (found.verdict, found.proposed) == (NAMED, (SPRING, DAMPER))
    assert [one.effects for one in found.findings] == [(SPRING,), (DAMPER, FRICTION)]
    assert [str(effect) for effect in found.effects] == list(
        map(str, (SPRING, DAMPER, PUSH))
    )
    assert [one.log_evidence for one in found.ranking[:2]] == [25.0, 23.0]
    assert found.ranking[0].fit is found.ranking[1].fit is found.proposed_fit
    assert found.reason.startswith(
        "cubic stiffness in the equation of p (2.10 +- 0.20 N) and a loss"
    )
    assert found.reason.endswith("decisive evidence (log evidence 29.0)")
    # Each must be decisive beside the other, and both decisively likelier than one.
    for evidence, worth in ((29.0, (23.0, 4.5)), (24.5, (23.0, 25.0))):
        case = replace(case, several=[((DAMPER, SPRING), evidence, worth)])
        assert case.concluded().findings == ()
    said: list[str] = []
    base = replace(case.base, say=said.append)
    case = replace(
        case, several=[both], base=base, larger={**larger, both_name(): None}
    )
    assert case.concluded().findings == ()
    assert said == [
        f"{told(DAMPER)} and {told(SPRING)} together were skipped: the fit failed"
    ]


def test_a_complete_effect_gives_way_to_several_that_leave_noise() -> None:
    """A hysteresis of any shape explains three laws as far as free runs tell."""
    ranking = [candidate(DAMPER, 20.0), candidate(SPRING, 6.0)]
    both = ((DAMPER, SPRING), 29.0, (23.0, 25.0))
    found = Case(ranking, several=[both]).concluded()
    assert (found.verdict, found.proposed) == (NAMED, (SPRING, DAMPER))
    larger = {both_name(): fitted(run(9.0))}  # these do not explain it
    found = Case(ranking, several=[both], larger=larger).concluded()
    assert (found.verdict, found.proposed) == (NAMED, (DAMPER,))


def both_name() -> str:
    return f"{DAMPER} and {SPRING}"


def test_what_effects_take_over_of_a_force() -> None:
    larger = {str(DAMPER): fitted(run(9.5)), both_name(): fitted(run(7.0))}
    ranking = [candidate(DAMPER, 20.0, force_left=0.8), candidate(SPRING, 1.0)]
    both = ((DAMPER, SPRING), 29.0, (23.0, 25.0))
    case = Case(ranking, larger=larger, several=[both], force_left=0.6, alone=None)
    found = case.concluded()
    assert found.verdict == PARTLY_NAMED
    assert "It accounts for 64 % of what is missing" in found.reason


def test_an_effect_that_is_decisive_from_its_own_fit_alone_is_found() -> None:
    case = Case([candidate(DAMPER, 1.0)], again=[candidate(SPRING, 9.0)])
    assert case.concluded().proposed == (SPRING,)
    # Where nothing is missing nobody asks.
    noise = fitted(run(1.0, p=0.5))
    assert replace(case, base=noise).concluded().verdict == NOTHING


def test_an_effect_that_removes_next_to_nothing_is_no_finding() -> None:
    # Of the error of 10 m above the noise it leaves 9.75, or 9.7.
    for error, is_named in ((9.755, False), (9.74, True)):
        larger = {str(DAMPER): fitted(run(error))}
        case = Case([candidate(DAMPER, 20.0)], larger=larger, alone=20.0)
        assert bool(case.concluded().findings) == is_named


# ---- not named


def test_a_larger_error_of_either_free_run_is_a_doubt() -> None:
    base = fitted(run(10.0), run(10.0))
    for errors in ((10.1, 1.0), (1.0, 10.1)):
        larger = {str(DAMPER): fitted(*(run(error) for error in errors))}
        case = Case([candidate(DAMPER, 20.0)], base, larger)
        found = case.concluded()
        assert (found.verdict, found.findings) == (UNEXPLAINED, ())
        assert (
            lost(found)[str(DAMPER)] == "its free-run error is larger than without it"
        )
    assert "the held-out error rises from 10.0 to 10.1 m" in found.reason
    larger = {str(DAMPER): fitted(run(10.0), run(10.001))}
    found = Case([candidate(DAMPER, 20.0)], base, larger).concluded()
    assert "the held-out error does not change (10.0 m), noise" in found.reason
    # Within the noise an error may be larger.
    base = fitted(run(10.0), run(1.0))
    larger = {str(DAMPER): fitted(run(1.05, p=0.5), run(1.09))}
    assert Case([candidate(DAMPER, 20.0)], base, larger).concluded().findings


def test_what_is_as_likely_as_what_is_not_named_is_not_only_decisive() -> None:
    larger = {str(DAMPER): fitted(run(10.1))}
    ranking = [candidate(FRICTION, 21.0), candidate(DAMPER, 20.0)]
    found = Case(ranking, larger=larger).concluded()
    assert (found.verdict, found.findings) == (UNEXPLAINED, ())
    assert lost(found)[str(FRICTION)] == (
        f"the data cannot distinguish it from {told(DAMPER)}"
    )


def test_what_a_study_would_add_is_judged_and_not_the_brief_re_fit() -> None:
    worse = "its free-run error is larger than without it"
    base = fitted(run(10.0), run(10.0))
    later = fitted(run(1.0), run(10.1))
    case = Case([candidate(DAMPER, 20.0)], base, thorough=later)
    assert lost(case.concluded())[str(DAMPER)] == worse


def test_effects_with_a_larger_error_are_not_named() -> None:
    # Even where no force is evident beside them.
    base = fitted(run(10.0), run(10.0))
    ranking = [candidate(DAMPER, 20.0, force_left=0.9), candidate(SPRING, 6.0)]
    both = ((DAMPER, SPRING), 29.0, (23.0, 25.0))
    for error, are_named in ((9.0, True), (10.1, False)):
        larger = {
            str(DAMPER): fitted(run(9.8), run(9.8)),
            both_name(): fitted(run(2.0), run(error)),
        }
        case = Case(ranking, base, larger, several=[both], alone=10.0)
        assert bool(case.concluded().findings) == are_named


def test_several_that_leave_a_force_are_named_where_one_is_not() -> None:
    both = ((DAMPER, SPRING), 40.0, (15.0, 18.0))
    for force_left, names in ((0.5, [DAMPER]), (0.9, [SPRING, DAMPER])):
        ranking = [candidate(DAMPER, 20.0, force_left=force_left)]
        ranking.append(candidate(SPRING, 6.0))
        larger = {str(DAMPER): fitted(run(9.5)), both_name(): fitted(run(2.0))}
        case = Case(ranking, larger=larger, several=[both], alone=None)
        found = case.concluded()
        assert [one.effects[0] for one in found.findings] == names


def test_a_wave_that_leaves_more_is_not_named_alone() -> None:
    larger = {str(WAVE): fitted(run(2.0)), f"{DAMPER} and {WAVE}": fitted(run(2.0))}
    wave = Case([candidate(WAVE, 20.0)], larger=larger, alone=None)
    found = wave.concluded()
    doubt = "more is missing, and every function contains such waves"
    assert found.verdict == UNEXPLAINED and lost(found)[str(WAVE)] == doubt
    assert replace(wave, alone=19.0).concluded().verdict == NAMED
    # As one of several it is at least as likely as any function.
    larger[str(DAMPER)] = fitted(run(9.5))
    ranking = [candidate(DAMPER, 20.0, force_left=0.9), candidate(WAVE, 1.0)]
    both = ((DAMPER, WAVE), 29.0, (23.0, 25.0))
    case = Case(ranking, larger=larger, several=[both], alone=None)
    assert len(case.concluded().findings) == 2
    bells = "unknown force f(q) of 6 bells from -1 to 1"
    function = function_named(MODEL, bells, "p")
    assert function is not None
    case = replace(case, functions=[candidate(function, 29.1)])
    assert case.concluded().findings == ()


def test_an_unknown_function_is_asked_where_a_force_remains() -> None:
    bells = "unknown loss r(q) of 6 bells from -1 to 1"
    function = function_named(MODEL, bells, "p")
    assert function is not None
    case = Case(
        [candidate(DAMPER, 20.0), candidate(FRICTION, 1.0)],
        larger={str(DAMPER): fitted(run(2.0)), str(function): fitted(run(1.05, p=0.5))},
        functions=[candidate(function, 40.1)],
        alone=None,
    )
    found = case.concluded()
    assert found.verdict == NAMED
    assert found.findings[0].effects == (function,)
    # What a few laws explain as well is theirs.
    both = ((DAMPER, FRICTION), 50.0, (23.0, 25.0))
    found = replace(case, several=[both]).concluded()
    assert [one.effects for one in found.findings] == [(FRICTION,), (DAMPER,)]
    # Where none may be named, it is a doubt.
    given = replace(case, are_candidates=False)
    found = given.concluded()
    assert lost(found)[str(DAMPER)] == (
        f"{told(function)} is more likely (log evidence 40.1 against 20.0)"
    )
    less = replace(given, functions=[candidate(function, 40.0)])
    assert less.concluded().verdict == PARTLY_NAMED
    # Not where an effect leaves none.
    found = replace(case, larger={}).concluded()
    assert found.findings[0].effects == (DAMPER,)


def test_steps_coarser_than_the_motion_may_be_the_cause() -> None:
    coarse = run(10.0)
    coarse.record.data = positions(np.repeat([1.0, 2.0], 20))
    base = fitted(coarse)
    steps = "the quantisation of q, whose standard deviation is less than one step"
    found = Case([candidate(DAMPER, 20.0)], base).concluded()
    assert lost(found)[str(DAMPER)] == f"the cause may also be {steps}"
    found = Case([candidate(DAMPER, 1.0)], base).concluded()
    assert f"; it may be {steps}; " in found.reason
    # Not where the free run with the effect is off by more.
    larger = {str(DAMPER): fitted(run(1.3))}
    assert Case([candidate(DAMPER, 20.0)], base, larger).concluded().findings


def test_without_a_decisive_effect_a_force_decides() -> None:
    ranking = [
        candidate(PUSH, 30.0, was_weighed=False, lost="too small"),
        candidate(DAMPER, 3.5),
        candidate(SPRING, 1.5),
        candidate(OFFSET, -1.5),
    ]
    base = fitted(run(1.4))
    for alone, verdict in ((-4.5, NOTHING), (-4.7, UNEXPLAINED), (None, UNEXPLAINED)):
        found = Case(ranking, base, alone=alone).concluded()
        assert found.verdict == verdict
    assert found.reason == (
        "training error 1.40 m, noise floor 1 m: there is evidence that something is "
        "missing, but no effect of the catalogue explains it; the nearest is viscous "
        "damping in the equation of p, but its evidence is only strong (3.5)"
    )
    assert list(lost(found).values()) == [
        "too small",
        "its evidence is only strong (3.5)",
        "its evidence is only weak (1.5)",
        "there is no evidence for it (-1.5)",
    ]
    # What gains nothing is not the nearest; noise lacks nothing, whatever the force.
    found = Case(ranking[-1:], alone=None).concluded()
    assert found.reason.endswith("no effect of the catalogue explains it")
    # An error of several times the noise is something, also without such a force.
    far = fitted(run(1.6))
    assert Case(ranking, far, alone=0.0).concluded().verdict == UNEXPLAINED
    white = fitted(run(1.05, p=0.5), run(1.0))
    found = Case(ranking, white, alone=None).concluded()
    assert (found.verdict, found.reason) == (
        NOTHING,
        "held-out error 1.00 m, noise floor 1 m; there is no evidence of anything "
        "missing, and no effect is decisive",
    )


def test_nothing_is_named_where_the_data_are_the_cause(monkeypatch) -> None:
    """The cause is asked for beside what would be named, and takes its place."""
    asked = []

    def cause(base: DiagnosedModel, larger: DiagnosedModel) -> DataCause:
        asked.append((base.judged.rmse, larger.judged.rmse))
        return DataCause("run 3 differs", "check it")

    monkeypatch.setattr(conclusion, "data_cause", cause)
    found = Case([candidate(FRICTION, 30.0)]).concluded()
    assert asked == [(10.0, 1.05)]
    assert (found.verdict, found.reason) == (UNEXPLAINED, "run 3 differs: check it")
    assert (found.findings, found.proposed, found.proposed_fit) == ((), (), None)
    assert lost(found) == {
        FRICTION.name + " on p": "the data explain more of the misfit"
    }
    assert str(found.next_step) == "Check it. Then diagnose again."


def test_without_evidence_the_free_runs_alone_decide() -> None:
    error = SolveError("no states were found")
    for base, verdict, said in (
        (
            fitted(run(10.0)),
            UNEXPLAINED,
            "10.0 m, noise floor 1 m; no states were found",
        ),
        (
            fitted(run(1.0, p=0.5)),
            NOTHING,
            "1.00 m, noise floor 1 m; the residuals are noise",
        ),
    ):
        found = conclusion.without_evidence(base, error)
        assert (found.verdict, found.ranking) == (verdict, ())
        assert found.reason == f"training error {said}"
        assert (found.record, found.base) == (base.record, base.judged)


# ---- other optima of one model


def fit_of(deviance: float) -> Any:
    """A fit of 40 values with one free parameter."""
    model = damped_spring("k*q**2/2 + p**2/2", k=ph.Parameter(2.0, lower=0))
    bic = deviance + np.log(40)
    return SimpleNamespace(model=model, names=("k",), n_values=40, bic=bic)


def test_a_thorough_re_fit_counts_unless_it_is_another_optimum(monkeypatch) -> None:
    data, loss, brief = SimpleNamespace(), ph.MaximumLikelihood(), fit_of(100.0)
    asked: dict[str, Any] = {}

    def identify(*given: Any, **settings: Any) -> Any:
        asked.update(settings, given=given)
        if found is None:
            raise SolveError("it did not converge")
        return found

    monkeypatch.setattr(refit, "identify", identify)
    for deviance, is_taken in ((109.9, True), (110.1, False), (None, False)):
        found = None if deviance is None else fit_of(deviance)
        expected = found if is_taken else brief
        aligned: Any = data
        assert refit.thorough_fit(aligned, loss, brief) is expected
    assert asked["given"] == (brief.model, data, loss) and asked["start"] is brief
    assert asked["settings"].max_iterations == THOROUGH_ITERATIONS
