"""Where a model fails, and which effect is missing.

1. The missing force along every trajectory, with the states it implies (`missing`).
2. Every effect of the catalogue is screened on the whole record without re-fitting (`screen`).
3. The best few, and where one is not enough the best pairs, are re-fitted by maximum likelihood and judged by BIC, with
   correlated residuals counted for the independent ones they are worth, and by the free run on data held out.
4. The verdict: an effect is named when it is significant (false-discovery rate over all candidates), when the held-out
   error falls, and when it, alone or with one more, leaves residuals like noise. Effects that explain most of what is
   missing but leave more than noise are proposed, and the verdict says that something remains unexplained.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import comb, prod

import numpy as np
from scipy.stats import chi2, false_discovery_control

from phsi_opt.compare import Comparison, compared, force_of
from phsi_opt.diagnosis import NAMED, NOTHING, UNEXPLAINED, Candidate, Diagnosis
from phsi_opt.effects import Effect, catalogue, is_wave
from phsi_opt.errors import PhsiOptError
from phsi_opt.evidence import (
    ABOVE_FLOOR,
    MOST,
    delta_bic,
    deviance,
    explained_share,
    explains,
    falls,
    falls_or_most,
    is_adequate,
    left_over,
    share_of,
)
from phsi_opt.fit import Fit
from phsi_opt.guesses import corners, resolved
from phsi_opt.identify import identify, matched
from phsi_opt.losses import MaximumLikelihood
from phsi_opt.measurements import Measurements
from phsi_opt.missing import ForceEstimate
from phsi_opt.model import Model
from phsi_opt.pairs import pairs
from phsi_opt.record import matrix_of, shown
from phsi_opt.screen import Screen, Screened
from phsi_opt.solver import EXACT, FEASIBLE_PATH, GAUSS_NEWTON, WAYS, Settings
from phsi_opt.terms import Share

N_REFITS = 5
N_PAIRS = 4
HOPELESS = 2.0  # expected residual variance over the best one's, beyond which no candidate is re-fitted
CERTAIN = 0.8  # share of the best one's score below which a candidate is no rival, once the best leaves noise
SEEN = 0.01  # screened p-value up to which a candidate is compared with the others
WORTH_A_FIT = 0.1  # the same up to which a candidate for a model that does not fail is re-fitted
RATE = 0.01  # false-discovery rate over all candidates
CLOSE = 6.0  # difference in BIC up to which two re-fitted candidates are a tie
# Rise of -2 log likelihood up to which the sharper corner of dry friction is taken: friction is sharp, and the corners
# that fall between samples make the likelihood rough.
WORSE = 4.0
SURE = 1  # number of the first stage of sharpening that is the last one unless it is clearly better
LONG = 4_000  # intervals beyond which a re-fit that fails is not begun again, and none begins at a sharp corner
PIECES = 4  # windows of the longest record with which a re-fit begins that failed along the whole
# Widths of a corner within which steps between samples are finer, and how many they are; friction that is very sharp is
# stiff, and with steps that are too long a body that sticks trembles.
CORNER, AT_CORNER, AT_SHARP_CORNER = 4.0, 8, 24

# A candidate that takes more is hardly the one.
QUICK = Settings(1e-7, max_iterations=40, thorough=False, max_seconds=20.0, ways=(GAUSS_NEWTON, EXACT))
DRY = replace(QUICK, max_seconds=120.0, ways=WAYS)
STRAYED = 0.1  # noise deviations between a fit's states and its free run, from which its steps are made finer
FOLLOWING = replace(DRY, thorough=True)
SAME_WIDTH = 1.01  # factor up to which two widths of a corner are the same
A_LITTLE = 0.1  # share of its expected size with which a further effect begins beside a sharp corner
# Beside a sharp corner IPOPT converges at once or not at all.
ALONG = replace(DRY, ways=(FEASIBLE_PATH,))
AT_A_CORNER = replace(DRY, max_iterations=15, ways=(GAUSS_NEWTON, FEASIBLE_PATH))


def diagnose(
    fit: Fit,
    data: Measurements,
    held_out: Measurements | None = None,
    *,
    effects: list[Effect] | None = None,
    loss: MaximumLikelihood | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Estimate what the fitted model lacks on ``data`` and name it, if the data allow (see the module's text).

    Args:
        held_out: measurements not used for fitting; without them the verdict rests on the training record alone.
        effects: candidates; default: `catalogue` of the model. loss: how candidates are re-fitted.
        progress: called with a line of text as the work goes on.
    """
    say = progress or (lambda line: None)
    data = matched(fit.model, data)
    say("estimating the missing force")
    work = _Work.begin(fit, data, held_out, loss or MaximumLikelihood(), say)
    listed = catalogue(fit.model) if effects is None else effects
    say(f"screening {len(listed)} candidate effects")
    screen = Screen(fit, data, work.estimate, work.trained.simulated)
    found = screen.screened(listed)
    candidates = [_candidate(one, found, screen) for one in found]
    refitted = work.best_of(screen, found, candidates)
    tried = [c.effect for c in refitted]
    everyone = _adjusted(refitted + [c for c in candidates if c.effect not in tried])
    failed = [c.effect for c in refitted if c.fit is None]
    proposal = work.proposed(screen, [one for one in found if one.effect not in failed], everyone)
    if proposal is not None:
        everyone = tuple(sorted(everyone, key=lambda c: c.effect not in proposal.effects))
    verdict, reason, named = work.verdict(proposal)
    nearest = proposal.fit if proposal is not None and named else None
    return Diagnosis(fit, data, work.estimate, work.base, everyone, verdict, reason, named, nearest)


@dataclass(frozen=True, eq=False)
class _Proposal:
    """One effect, or two together, with what is left when they are added; ``words`` on the first one's size."""

    effects: tuple[Effect, ...]
    fit: Fit
    trained: Comparison
    comparison: Comparison
    words: str = ""


def _candidate(one: Screened, found: list[Screened], screen: Screen) -> Candidate:
    is_seen = one.p_value < SEEN  # what leaves nothing is like everything
    alike = tuple(str(o.effect) for o in found if o is not one and is_seen and screen.stands_in(one, o))
    return Candidate(one.effect, one.coefficient, one.std_error, one.drop, one.values, alike, one.p_value)


@dataclass(frozen=True, eq=False)
class _Work:
    """The fit, the data to train on and to judge by, and what candidates are measured against."""

    fit: Fit
    data: Measurements
    judging: Measurements
    estimate: ForceEstimate
    judged: ForceEstimate
    trained: Comparison
    base: Comparison
    loss: MaximumLikelihood
    say: Callable[[str], None]
    is_held_out: bool

    @classmethod
    def begin(
        cls, fit: Fit, data: Measurements, held_out: Measurements | None, loss: MaximumLikelihood,
        say: Callable[[str], None],
    ) -> "_Work":  # fmt: skip
        estimate = force_of(fit, data)
        judging = data if held_out is None else matched(fit.model, held_out)
        judged = estimate if held_out is None else force_of(fit, judging)
        trained = _compared(fit, data, estimate)
        base = trained if held_out is None else _compared(fit, judging, judged)
        return cls(fit, data, judging, estimate, judged, trained, base, loss, say, held_out is not None)

    def refit(
        self, effects: Sequence[Effect], values: dict[str, float], beside: dict[str, float] | None = None,
        rival: Fit | None = None, others: Sequence[Fit] = (), is_likely: bool = False,
    ) -> tuple[Fit, Comparison, Comparison, Fit | None] | None:  # fmt: skip
        """The fit with the effects and its comparisons; what ``is_likely`` is solved in every way there is.

        It begins at the states of the missing-force estimate, the base's parameters at the values ``beside``, or at one
        of the ``others`` that has part of these effects, among them dry friction on a body that sticks. Dry friction
        is sharpened if it is clearly better than a ``rival``; the last is the fit before that, if there was one.
        """
        model = self.fit.model
        for effect in effects:
            model = model.add(effect)
        model = resolved(model, self.estimate.grid, self.estimate.x).with_values(values)
        # The fast part of a memory, that of a short delay, is not seen by steps as long as the samples.
        finer = 2 if any(effect.memory for effect in effects) else 1
        try:
            new, blunt = self.extended(model, finer, others), None
            if new is None:
                new = blunt = self.begun(model, finer, beside or {}, is_likely)
                if rival is None or delta_bic(rival, new, 1.0) < -CLOSE:
                    new = self.sharpened(new, model)
            is_sharpened = new is not blunt
            new, trained = self.followed(new)
            if is_sharpened:
                new, trained = self.creeping(new, trained)
            return new, trained, _compared(new, self.judging, self.judged) if self.is_held_out else trained, blunt
        except PhsiOptError as error:
            self.say(f"not re-fitted: {error}")
            return None

    def followed(self, fit: Fit) -> tuple[Fit, Comparison]:
        """The fit and its comparison on the training record; with finer steps where the free run leaves its states.

        Steps as long as the samples are too long for a sharp corner, and for the fast part of a short memory.
        """
        trained = _compared(fit, self.data, self.estimate)
        is_enough = fit.outcome.way == FEASIBLE_PATH and is_adequate(trained)
        if is_enough or _is_long(fit) or _strays(fit, trained) < STRAYED:
            return fit, trained
        with suppress(PhsiOptError):
            finer = identify(fit.model, self.data, self.loss, start=fit, settings=FOLLOWING)
            again = _compared(finer, self.data, self.estimate)
            if again.rmse < trained.rmse:
                return finer, again
        return fit, trained

    def creeping(self, fit: Fit, trained: Comparison) -> tuple[Fit, Comparison]:
        """The fit and its comparison; where that is close to noise, with widths of its sharp corners as estimated.

        A body that sticks creeps by a share of the width, which shows where it sticks for long.
        """
        widths = _corners(fit.model, self.fit.model)
        is_near = not is_adequate(trained) and trained.rmse < HOPELESS * trained.noise_floor
        if not (widths and is_near and fit.outcome.way == FEASIBLE_PATH):
            return fit, trained
        with suppress(PhsiOptError):
            free = identify(fit.model.with_free(widths), self.data, self.loss, start=fit, settings=ALONG)
            held = fit.model.with_values({name: free.values[name] for name in widths})
            again = identify(held, self.data, self.loss, start=free, settings=ALONG)
            compared_again = _compared(again, self.data, self.estimate)
            if compared_again.rmse < trained.rmse:
                return again, compared_again
        return fit, trained

    def begun(self, model: Model, finer: int, beside: dict[str, float], is_likely: bool = False) -> Fit:
        """The brief re-fit of a larger model, from the base's values ``beside``, else its own, else through windows."""
        grid, data, own = self.estimate.grid, self.data, self.fit.model
        channels = zip(own.states, self.estimate.sigma, strict=True)
        noise = {name: float(s) for name, s in channels if name in data.measured}
        known = own.with_values({name: value for name, value in beside.items() if name in own.entries})
        steps = tuple(finer * n for n in self.fit.steps)
        start = replace(self.fit, states=grid.split(self.estimate.x), noise=noise, steps=steps)
        is_hard = _corners(model, own) or self.fit.outcome.way == FEASIBLE_PATH
        settings = DRY if is_hard or is_likely else QUICK
        attempts = [(known, self.loss), (own, self.loss)] if beside else [(own, self.loss)]
        window = max(float(run.t[-1] - run.t[0]) for run in data.trajectories) / PIECES
        attempts = attempts[:1] if _is_long(self.fit) else [*attempts, (own, replace(self.loss, window=window))]
        for begin, loss in attempts[:-1]:
            with suppress(PhsiOptError):
                return identify(model, data, loss, start=replace(start, model=begin), settings=settings)
        begin, loss = attempts[-1]
        return identify(model, data, loss, start=replace(start, model=begin), settings=settings)

    def extended(self, model: Model, finer: int, others: Sequence[Fit]) -> Fit | None:
        """The re-fit from the best of the ``others`` that the model extends; None: there is none, or it is worse.

        Only dry friction whose corner is sharp: beside it a solver cannot begin anew.
        """
        smaller = [o for o in others if o.outcome.way == FEASIBLE_PATH and set(o.model.entries) < set(model.entries)]
        if not smaller or _is_long(self.fit):
            return None
        old = min(smaller, key=deviance)
        widths = {guess.of: old.model.values[name] for name, guess in _corners(old.model, self.fit.model).items()}
        corner = _corners(model, self.fit.model).items()
        if any(guess.of not in widths for _, guess in corner):  # one that is yet to be sharpened
            return None
        sharp = model.with_values({name: widths[guess.of] for name, guess in corner})
        added = [e for name, e in model.entries.items() if name not in old.model.entries and e.prunable]
        sharp = sharp.with_values({e.name: A_LITTLE * model.values[e.name] for e in added})
        steps = tuple(np.maximum(n, finer) for n in old.steps)
        with suppress(PhsiOptError):
            new = identify(sharp, self.data, self.loss, start=replace(old, steps=steps), settings=ALONG)
            if deviance(new) < deviance(old) - CLOSE:
                return self.sharpened(new, model)
            return new if deviance(new) < deviance(old) + WORSE else None
        return None

    def sharpened(self, fit: Fit, blunt: Model) -> Fit:
        """The fit with the widths of its new effects made smaller, on a finer grid, as long as that explains as much.

        A solver needs the corner of dry friction rounded at first, as in the model ``blunt``; beside a sticking body
        the rounding shows. Stages that the fit has behind it are passed over.
        """
        guesses, best = _corners(fit.model, self.fit.model), fit
        for stage in range(max((len(guess.sharper) for guess in guesses.values()), default=0)):
            values = {n: blunt.values[n] * prod(guess.sharper[: stage + 1]) for n, guess in guesses.items()}
            if all(fit.model.values[name] < SAME_WIDTH * width for name, width in values.items()):
                continue
            at_corner = AT_CORNER if stage <= SURE else AT_SHARP_CORNER
            sharper = self.at_widths(fit, values, at_corner)
            if sharper is None or deviance(sharper) > deviance(best) + WORSE:  # too sharp, or too far
                half_way = {name: float(np.sqrt(fit.model.values[name] * width)) for name, width in values.items()}
                sharper = self.at_widths(fit, half_way, at_corner) or sharper
            if sharper is None:
                break
            fit = sharper
            is_better = deviance(fit) < deviance(best) - CLOSE
            if deviance(fit) < deviance(best) + WORSE:
                best = fit
            if stage >= SURE and not is_better:
                break
        return best

    def at_widths(self, fit: Fit, widths: dict[str, float], at_corner: int) -> Fit | None:
        """The fit with other widths of its corners, with ``at_corner`` steps beside them; None where it fails."""
        steps = fit.steps
        for name, guess in _corners(fit.model, self.fit.model).items():
            steps = _finer_at_corner(fit, self.data, guess.of, fit.model.values[name], steps, at_corner)
        start, settings = replace(fit, steps=steps), ALONG if fit.outcome.way == FEASIBLE_PATH else AT_A_CORNER
        with suppress(PhsiOptError):
            return identify(fit.model.with_values(widths), self.data, self.loss, start=start, settings=settings)
        return None

    def best_of(self, screen: Screen, found: list[Screened], candidates: list[Candidate]) -> list[Candidate]:
        """The best few, re-fitted and ranked; as soon as one leaves noise, only those that promise nearly as much."""
        result: list[Candidate] = []
        enough, promised, is_failing = np.inf, -np.inf, not is_adequate(self.trained)
        best: Fit | None = None
        # What chance explains as well, among so many values scanned, comes last.
        rows = sorted(zip(candidates, found, strict=True), key=lambda row: row[1].p_value >= 1.0)
        for candidate, one in _simple_first(rows[:N_REFITS]):
            expected = max(screen.misfit - one.drop, screen.n_values)
            behind = screen.score(one) < CERTAIN * promised - CLOSE
            is_worth = is_failing or one.p_value * len(found) < WORTH_A_FIT
            if behind or expected > HOPELESS * enough or not is_worth:
                break
            others = [c.fit for c in result if c.fit is not None]
            new, blunt = self.refitted(candidate, one, best, others, is_likely=candidate is rows[0][0])
            result.append(new)
            if new.trained is not None and is_adequate(new.trained):
                enough, promised, blunt = min(enough, expected), max(promised, screen.score(one)), new.fit
            if blunt is not None and (best is None or delta_bic(best, blunt, 1.0) < 0):
                best = blunt  # what leaves noise is the rival as it is, the others before they are sharpened
        return self.ranked(result)

    def refitted(
        self, candidate: Candidate, screened: Screened, rival: Fit | None, others: Sequence[Fit], is_likely: bool
    ) -> tuple[Candidate, Fit | None]:
        """The candidate with its re-fit, and the fit before dry friction is sharpened."""
        self.say(f"re-fitting with {candidate.effect}")
        result = self.refit([candidate.effect], candidate.values, screened.beside, rival, others, is_likely)
        if result is None:
            return candidate, None
        new, trained, comparison, blunt = result
        names = _new_names(self.fit, new)
        linear = [n for n in names if new.model.entries[n].prunable] or names[:1]
        size, error = _size(new, linear, is_wave(candidate.effect) and len(linear) == 2)
        p_value = screened.n_tried * self.p_value(new, trained)
        found = replace(candidate, coefficient=size, std_error=error, fit=new, trained=trained, comparison=comparison)
        return replace(found, p_value=p_value), blunt

    def p_value(self, new: Fit, trained: Comparison) -> float:
        """Of the likelihood ratio, correlated residuals counted as fewer independent ones."""
        gain = (deviance(self.fit) - deviance(new)) * share_of(self.trained, trained)
        return float(chi2.sf(max(gain, 0.0), len(new.names) - len(self.fit.names)))

    def ranked(self, refitted: list[Candidate]) -> list[Candidate]:
        """By BIC, the best one's share of independent residuals taken for all; those that were not re-fitted last.

        Those that BIC hardly tells apart and that have as many parameters exchange places by what they leave on the
        data held out, counted in the same way; a larger one is not preferred for what it bends to fit there.
        Where none leaves noise, all are wrong, and of those the simplest comes first.
        """
        done = [(c, c.fit, c.trained) for c in refitted if c.fit is not None and c.trained is not None]
        if not done:
            return refitted
        best = min(done, key=lambda row: deviance(row[1]))
        share = share_of(self.trained, best[2])
        rows = sorted(((delta_bic(self.fit, fit, share), fit, c) for c, fit, _ in done), key=lambda row: row[0])
        n_close = sum(bic < rows[0][0] + CLOSE for bic, _, _ in rows)
        close, clear = rows[:n_close], rows[n_close:]
        if any(is_adequate(trained) for _, _, trained in done):
            by_size: dict[int, list[tuple[float, Fit, Candidate]]] = {}
            for row in sorted(close, key=lambda row: row[0] + share * self.left_over(row[2])):
                by_size.setdefault(len(row[1].names), []).append(row)
            close = [by_size[len(fit.names)].pop(0) for _, fit, _ in close]
        else:
            close = sorted(close, key=lambda row: len(row[1].names))
        result = [replace(c, delta_bic=bic) for bic, _, c in close + clear]
        result = [replace(c, confusable_with=_tied(c, result)) for c in result]
        return result + [c for c in refitted if c.fit is None]

    def left_over(self, c: Candidate) -> float:
        """What the candidate leaves on the data held out; zero where there are none."""
        return left_over(c.comparison) if self.is_held_out and c.comparison is not None else 0.0

    def proposed(self, screen: Screen, found: list[Screened], everyone: tuple[Candidate, ...]) -> _Proposal | None:
        """The best significant effect; two together where one alone leaves more than noise and two explain more.

        The two are among ``found``; what could not be re-fitted alone can hardly be beside another. Dry friction is the
        simplest of its kinds there, as it would fill the list with each of them; the others are tried in the best pair.
        """
        best = None
        c = next((c for c in everyone if self.is_significant(c)), None)
        if c is not None and c.fit is not None and c.trained is not None and c.comparison is not None:
            tie = f"; not told apart from {', '.join(c.confusable_with)}" if c.confusable_with else ""
            error = f" +- {c.std_error:.2g}" if np.isfinite(c.std_error) else ""
            words = f", coefficient {c.coefficient:.4g}{error}{tie}"
            best = _Proposal((c.effect,), c.fit, c.trained, c.comparison, words)
        if is_adequate(self.trained) or (best and explains(self.base, best.trained, best.comparison)):
            return best
        alone = [c.fit for c in everyone if c.fit is not None]
        for pair in pairs(screen, _simplest_dry(found), N_PAIRS):
            best = self.better_of(best, pair, len(found), alone)
        if best is not None and len(best.effects) == 2:
            others = [*alone, best.fit]
            for kinds in _other_kinds(best.effects, found):
                for pair in pairs(screen, kinds, 1):
                    best = self.better_of(best, pair, len(found), others)
        return best

    def better_of(
        self, best: _Proposal | None, pair: tuple[Screened, Screened], n_found: int, others: Sequence[Fit]
    ) -> _Proposal | None:
        """The pair, or what of it is needed, where that is clearly better than the best so far; else the best so far.

        Its p-value counts all pairs of the ``n_found`` candidates; it may begin at one of the ``others``.
        """
        effects = tuple(one.effect for one in pair)
        self.say(f"re-fitting with {effects[0]} and {effects[1]}")
        rival, values = best.fit if best else None, {**pair[0].values, **pair[1].values}
        result = self.refit(effects, values, rival=rival, others=others)
        if result is None:
            return best
        new, trained, comparison, _ = result
        share = share_of(self.trained if best is None else best.trained, trained)
        better = delta_bic(self.fit if best is None else best.fit, new, share) < -CLOSE
        better &= comb(n_found, 2) * pair[0].n_tried * pair[1].n_tried * self.p_value(new, trained) < RATE
        if better and falls_or_most(self.base if best is None else best.comparison, comparison):
            return self.needed(_Proposal(effects, new, trained, comparison), pair)
        return best

    def needed(self, both: _Proposal, pair: tuple[Screened, Screened]) -> _Proposal:
        """The pair, or the one of the two that does as much alone, from its values beside the other."""
        best, share = both, share_of(self.trained, both.trained)
        for one in pair:
            result = self.refit([one.effect], one.values, rival=both.fit)
            if result is not None and delta_bic(best.fit, result[0], share) < CLOSE:
                best = _Proposal((one.effect,), *result[:3])
        return best

    def verdict(self, proposal: _Proposal | None) -> tuple[str, str, tuple[Effect, ...]]:
        """Verdict, reason in words, and the effects that it names or, if they leave more than noise, proposes."""
        base, where = self.base, "held-out" if self.is_held_out else "training"
        errors = f"{where} error {base.rmse:.4g}, noise floor {base.noise_floor:.4g}"
        none = "no effect of the catalogue lowers it significantly"
        if proposal is None:
            is_failing = not is_adequate(self.trained) or base.rmse > ABOVE_FLOOR * base.noise_floor
            return (UNEXPLAINED, f"{errors}, but {none}", ()) if is_failing else (NOTHING, f"{errors}; {none}", ())
        after = proposal.comparison
        names = " and ".join(map(str, proposal.effects)) + (" together" if len(proposal.effects) > 1 else "")
        change = (
            f"the {where} error falls from {base.rmse:.4g} to {after.rmse:.4g} (noise floor {after.noise_floor:.4g})"
        )
        if explains(base, proposal.trained, after):
            return NAMED, f"{names}{proposal.words}; {change}", proposal.effects
        share = explained_share(base, after)
        verbs = ("explains", "leaves") if len(proposal.effects) == 1 else ("explain", "leave")
        part = (
            f"{verbs[0]} {100 * share:.0f} % of the squared error above the noise floor, and {verbs[1]} more than noise"
        )
        reason = f"no known effect explains it all. The nearest, {names}{proposal.words}, {part}: {change}"
        return UNEXPLAINED, reason, proposal.effects if share > MOST else ()

    def is_significant(self, c: Candidate) -> bool:
        """Whether p-value and BIC hold, and the error on the judging data falls."""
        return c.comparison is not None and c.p_value < RATE and c.delta_bic < 0 and falls(self.base, c.comparison)


def _simple_first(rows: list[tuple[Candidate, Screened]]) -> list[tuple[Candidate, Screened]]:
    """The same order, but of dry frictions on one equation the one with fewer parameters comes first."""
    result = list(rows)
    for equation in {candidate.effect.equation for candidate, _ in rows}:
        at = [i for i, (c, _) in enumerate(rows) if c.effect.equation == equation and _is_dry(c.effect)]
        for i, row in zip(at, sorted((rows[i] for i in at), key=lambda row: row[1].n_free), strict=True):
            result[i] = row
    return result


def _simplest_dry(found: list[Screened]) -> list[Screened]:
    """Of dry frictions on one equation only the one with the fewest parameters; all else as it is."""
    dry = sorted((one for one in found if _is_dry(one.effect)), key=lambda one: -one.n_free)
    simplest = {one.effect.equation: one for one in dry}
    return [one for one in found if not _is_dry(one.effect) or one is simplest[one.effect.equation]]


def _other_kinds(pair: tuple[Effect, ...], found: list[Screened]) -> list[list[Screened]]:
    """The pair with another kind of dry friction on the same equation."""
    result = []
    for effect, beside in (pair, pair[::-1]):
        same = [o for o in found if _is_dry(effect) and _is_dry(o.effect) and o.effect.equation == effect.equation]
        rest = [one for one in found if one.effect == beside]
        result += [[other, *rest] for other in same if other.effect != effect]
    return result


def _is_dry(effect: Effect) -> bool:
    inner = [parameter.guess for term in effect.term for parameter in term.inner.values()]
    return any(isinstance(guess, Share) and bool(guess.sharper) for guess in inner)


def _compared(fit: Fit, data: Measurements, estimate: ForceEstimate) -> Comparison:
    return compared(fit, data, estimate.sigma, estimate.grid.split(estimate.x))


def _strays(fit: Fit, trained: Comparison) -> float:
    """Root mean square distance of the free run from the states of the fit, in standard deviations of the noise."""
    seen = shown(fit.model, trained.data, fit.states, matrix_of(fit.model, trained.values))
    triples = zip(trained.shown, seen, trained.data.trajectories, strict=True)
    apart = [((run - x) / trained.noise)[np.isfinite(of.x)] for run, x, of in triples]
    return float(np.sqrt(np.mean(np.concatenate(apart) ** 2)))


def _is_long(fit: Fit) -> bool:
    return sum(int(n.sum()) for n in fit.steps) > LONG


def _corners(model: Model, base: Model) -> dict[str, Share]:
    """Those that the base does not have."""
    return {name: guess for name, guess in corners(model).items() if name not in base.entries}


def _finer_at_corner(
    fit: Fit, data: Measurements, of: str, width: float, steps: tuple[np.ndarray, ...], at_corner: int = AT_CORNER
) -> tuple[np.ndarray, ...]:
    """More steps in the gaps between samples in which ``of`` passes its corner: is zero, or near it."""
    formula, result = fit.model.function(of), []
    theta = np.array([fit.model.values[name] for name in fit.model.free])
    for run, x, n in zip(data.trajectories, fit.states, steps, strict=True):
        v = np.array(formula.map("v", "serial", len(x), [3], [])(x.T, run.u.T, run.t[None, :], theta)).ravel()
        near = (v[1:] * v[:-1] < 0) | (np.minimum(np.abs(v[1:]), np.abs(v[:-1])) < CORNER * width)
        near = np.convolve(near, np.ones(3))[1:-1] > 0  # the corner may move to the gap beside
        result.append(np.where(near, np.maximum(n, at_corner), n))
    return tuple(result)


def _new_names(old: Fit, new: Fit) -> list[str]:
    return [n for n, e in new.model.entries.items() if n not in old.model.entries and not e.parameter.fixed]


def _tied(one: Candidate, all_of: list[Candidate]) -> tuple[str, ...]:
    """What the data cannot tell from the candidate: by its trace, or by BIC after the re-fits."""
    close = [str(c.effect) for c in all_of if c is not one and abs(c.delta_bic - one.delta_bic) < CLOSE]
    far = {str(c.effect) for c in all_of} - set(close)
    return tuple(dict.fromkeys([*close, *(name for name in one.confusable_with if name not in far)]))


def _adjusted(candidates: list[Candidate]) -> tuple[Candidate, ...]:
    """P-values adjusted for the number of candidates, so that the share of false names is controlled."""
    if not candidates:
        return ()
    p = np.clip(np.nan_to_num([c.p_value for c in candidates], nan=1.0), 0.0, 1.0)
    return tuple(replace(c, p_value=float(q)) for c, q in zip(candidates, false_discovery_control(p), strict=True))


def _size(fit: Fit, names: list[str], is_wave: bool) -> tuple[float, float]:
    """Coefficient (amplitude, for a sine and a cosine; the last of several) and its standard error."""
    at = [fit.names.index(n) for n in names if n in fit.names]
    values = np.array([fit.estimates[fit.names[i]] for i in at])
    covariance = fit.covariance[np.ix_(at, at)]
    if not is_wave:
        return float(values[-1]), float(np.sqrt(covariance[-1, -1]))
    size = float(np.linalg.norm(values))
    direction = values / max(size, 1e-300)
    return size, float(np.sqrt(direction @ covariance @ direction))
