"""TODO."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import comb, prod

import numpy as np
from scipy.stats import chi2

from phsi_opt.comparison.compare import Comparison, compared_from_estimate
from phsi_opt.comparison.model_selection import (
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
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.criteria import (
    A_LITTLE,
    ALONG,
    AT_A_CORNER,
    AT_CORNER,
    AT_SHARP_CORNER,
    CERTAIN,
    CLOSE,
    DRY,
    FOLLOWING,
    HOPELESS,
    LONG,
    N_PAIRS,
    N_REFITS,
    NAMED,
    NOTHING,
    PIECES,
    QUICK,
    RATE,
    SAME_WIDTH,
    STRAYED,
    SURE,
    UNEXPLAINED,
    WORSE,
    WORTH_A_FIT,
)
from phsi_opt.diagnosis.dry_friction import (
    finer_at_corner,
    new_corners,
    other_kinds,
    simple_first,
    simplest_dry,
)
from phsi_opt.diagnosis.proposal import Proposal
from phsi_opt.diagnosis.ranking import new_names, size_of, tied
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.estimation.missing_force import ForceEstimate, force_of
from phsi_opt.estimation.trajectory_parameters import parameter_matrix
from phsi_opt.initialization.relative_guesses import resolve_guesses
from phsi_opt.model.effect import Effect, is_wave
from phsi_opt.model.model import Model
from phsi_opt.optimization.settings import FEASIBLE_PATH
from phsi_opt.screening.pair_search import pairs
from phsi_opt.screening.score_test import Screen, Screened
from phsi_opt.transcription.alignment import aligned
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.sensors import outputs_at_samples


@dataclass(frozen=True, eq=False)
class Refitting:
    """The fit, the data to train on and to judge by, and what candidates are measured
    against.
    """

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
        cls,
        fit: Fit,
        data: Measurements,
        held_out: Measurements | None,
        loss: MaximumLikelihood,
        say: Callable[[str], None],
    ) -> "Refitting":
        estimate = force_of(fit, data)
        judging = data if held_out is None else aligned(fit.model, held_out)
        judged = estimate if held_out is None else force_of(fit, judging)
        trained = compared_from_estimate(fit, data, estimate)
        base = (
            trained
            if held_out is None
            else compared_from_estimate(fit, judging, judged)
        )
        return cls(
            fit,
            data,
            judging,
            estimate,
            judged,
            trained,
            base,
            loss,
            say,
            held_out is not None,
        )

    def refit(
        self,
        effects: Sequence[Effect],
        values: dict[str, float],
        beside: dict[str, float] | None = None,
        rival: Fit | None = None,
        others: Sequence[Fit] = (),
        is_likely: bool = False,
    ) -> tuple[Fit, Comparison, Comparison, Fit | None] | None:
        """The fit with the effects and its comparisons; what ``is_likely`` is solved in
        every way there is.

        It begins at the states of the missing-force estimate, the base's parameters at
        the values ``beside``, or at one of the ``others`` that has part of these
        effects, among them dry friction on a body that sticks. Dry friction is
        sharpened if it is clearly better than a ``rival``; the last is the fit before
        that, if there was one.
        """
        model = self.fit.model
        for effect in effects:
            model = model.add(effect)
        model = resolve_guesses(model, self.estimate.grid, self.estimate.x).with_values(
            values
        )
        # The fast part of a memory, that of a short delay, is not seen by steps as long
        # as the samples.
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
            return (
                new,
                trained,
                compared_from_estimate(new, self.judging, self.judged)
                if self.is_held_out
                else trained,
                blunt,
            )
        except PhsiOptError as error:
            self.say(f"not re-fitted: {error}")
            return None

    def followed(self, fit: Fit) -> tuple[Fit, Comparison]:
        """The fit and its comparison on the training record; with finer steps where the
        free run leaves its states.

        Steps as long as the samples are too long for a sharp corner, and for the fast
        part of a short memory.
        """
        trained = compared_from_estimate(fit, self.data, self.estimate)
        is_enough = fit.outcome.way == FEASIBLE_PATH and is_adequate(trained)
        if is_enough or _is_long(fit) or _strays(fit, trained) < STRAYED:
            return fit, trained
        with suppress(PhsiOptError):
            finer = identify(
                fit.model, self.data, self.loss, start=fit, settings=FOLLOWING
            )
            again = compared_from_estimate(finer, self.data, self.estimate)
            if again.rmse < trained.rmse:
                return finer, again
        return fit, trained

    def creeping(self, fit: Fit, trained: Comparison) -> tuple[Fit, Comparison]:
        """The fit and its comparison; where that is close to noise, with widths of its
        sharp corners as estimated.

        A body that sticks creeps by a share of the width, which shows where it sticks
        for long.
        """
        widths = new_corners(fit.model, self.fit.model)
        is_near = (
            not is_adequate(trained) and trained.rmse < HOPELESS * trained.noise_floor
        )
        if not (widths and is_near and fit.outcome.way == FEASIBLE_PATH):
            return fit, trained
        with suppress(PhsiOptError):
            free = identify(
                fit.model.with_free(widths),
                self.data,
                self.loss,
                start=fit,
                settings=ALONG,
            )
            held = fit.model.with_values({name: free.values[name] for name in widths})
            again = identify(held, self.data, self.loss, start=free, settings=ALONG)
            compared_again = compared_from_estimate(again, self.data, self.estimate)
            if compared_again.rmse < trained.rmse:
                return again, compared_again
        return fit, trained

    def begun(
        self,
        model: Model,
        finer: int,
        beside: dict[str, float],
        is_likely: bool = False,
    ) -> Fit:
        """The brief re-fit of a larger model, from the base's values ``beside``, else
        its own, else through windows.
        """
        grid, data, own = self.estimate.grid, self.data, self.fit.model
        channels = zip(own.states, self.estimate.sigma, strict=True)
        noise = {name: float(s) for name, s in channels if name in data.measured}
        known = own.with_values(
            {name: value for name, value in beside.items() if name in own.entries}
        )
        steps = tuple(finer * n for n in self.fit.steps)
        start = replace(
            self.fit, states=grid.split(self.estimate.x), noise=noise, steps=steps
        )
        is_hard = new_corners(model, own) or self.fit.outcome.way == FEASIBLE_PATH
        settings = DRY if is_hard or is_likely else QUICK
        attempts = (
            [(known, self.loss), (own, self.loss)] if beside else [(own, self.loss)]
        )
        window = max(float(run.t[-1] - run.t[0]) for run in data.trajectories) / PIECES
        attempts = (
            attempts[:1]
            if _is_long(self.fit)
            else [*attempts, (own, replace(self.loss, window=window))]
        )
        for begin, loss in attempts[:-1]:
            with suppress(PhsiOptError):
                return identify(
                    model,
                    data,
                    loss,
                    start=replace(start, model=begin),
                    settings=settings,
                )
        begin, loss = attempts[-1]
        return identify(
            model, data, loss, start=replace(start, model=begin), settings=settings
        )

    def extended(self, model: Model, finer: int, others: Sequence[Fit]) -> Fit | None:
        """The re-fit from the best of the ``others`` that the model extends; None:
        there is none, or it is worse.

        Only dry friction whose corner is sharp: beside it a solver cannot begin anew.
        """
        smaller = [
            o
            for o in others
            if o.outcome.way == FEASIBLE_PATH
            and set(o.model.entries) < set(model.entries)
        ]
        if not smaller or _is_long(self.fit):
            return None
        old = min(smaller, key=deviance)
        widths = {
            guess.of: old.model.values[name]
            for name, guess in new_corners(old.model, self.fit.model).items()
        }
        corner = new_corners(model, self.fit.model).items()
        if any(
            guess.of not in widths for _, guess in corner
        ):  # one that is yet to be sharpened
            return None
        sharp = model.with_values({name: widths[guess.of] for name, guess in corner})
        added = [
            e
            for name, e in model.entries.items()
            if name not in old.model.entries and e.prunable
        ]
        sharp = sharp.with_values(
            {e.name: A_LITTLE * model.values[e.name] for e in added}
        )
        steps = tuple(np.maximum(n, finer) for n in old.steps)
        with suppress(PhsiOptError):
            new = identify(
                sharp,
                self.data,
                self.loss,
                start=replace(old, steps=steps),
                settings=ALONG,
            )
            if deviance(new) < deviance(old) - CLOSE:
                return self.sharpened(new, model)
            return new if deviance(new) < deviance(old) + WORSE else None
        return None

    def sharpened(self, fit: Fit, blunt: Model) -> Fit:
        """The fit with the widths of its new effects made smaller, on a finer grid, as
        long as that explains as much.

        A solver needs the corner of dry friction rounded at first, as in the model
        ``blunt``; beside a sticking body the rounding shows. Stages that the fit has
        behind it are passed over.
        """
        guesses, best = new_corners(fit.model, self.fit.model), fit
        for stage in range(
            max((len(guess.sharper) for guess in guesses.values()), default=0)
        ):
            values = {
                n: blunt.values[n] * prod(guess.sharper[: stage + 1])
                for n, guess in guesses.items()
            }
            if all(
                fit.model.values[name] < SAME_WIDTH * width
                for name, width in values.items()
            ):
                continue
            at_corner = AT_CORNER if stage <= SURE else AT_SHARP_CORNER
            sharper = self.at_widths(fit, values, at_corner)
            if (
                sharper is None or deviance(sharper) > deviance(best) + WORSE
            ):  # too sharp, or too far
                half_way = {
                    name: float(np.sqrt(fit.model.values[name] * width))
                    for name, width in values.items()
                }
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

    def at_widths(
        self, fit: Fit, widths: dict[str, float], at_corner: int
    ) -> Fit | None:
        """The fit with other widths of its corners, with ``at_corner`` steps beside
        them; None where it fails.
        """
        steps = fit.steps
        for name, guess in new_corners(fit.model, self.fit.model).items():
            steps = finer_at_corner(
                fit, self.data, guess.of, fit.model.values[name], steps, at_corner
            )
        start, settings = (
            replace(fit, steps=steps),
            ALONG if fit.outcome.way == FEASIBLE_PATH else AT_A_CORNER,
        )
        with suppress(PhsiOptError):
            return identify(
                fit.model.with_values(widths),
                self.data,
                self.loss,
                start=start,
                settings=settings,
            )
        return None

    def best_of(
        self, screen: Screen, found: list[Screened], candidates: list[Candidate]
    ) -> list[Candidate]:
        """The best few, re-fitted and ranked; as soon as one leaves noise, only those
        that promise nearly as much.
        """
        result: list[Candidate] = []
        enough, promised, is_failing = np.inf, -np.inf, not is_adequate(self.trained)
        best: Fit | None = None
        # What chance explains as well, among so many values scanned, comes last.
        rows = sorted(
            zip(candidates, found, strict=True), key=lambda row: row[1].p_value >= 1.0
        )
        for candidate, one in simple_first(rows[:N_REFITS]):
            expected = max(screen.misfit - one.drop, screen.n_values)
            behind = screen.score(one) < CERTAIN * promised - CLOSE
            is_worth = is_failing or one.p_value * len(found) < WORTH_A_FIT
            if behind or expected > HOPELESS * enough or not is_worth:
                break
            others = [c.fit for c in result if c.fit is not None]
            new, blunt = self.refitted(
                candidate, one, best, others, is_likely=candidate is rows[0][0]
            )
            result.append(new)
            if new.trained is not None and is_adequate(new.trained):
                enough, promised, blunt = (
                    min(enough, expected),
                    max(promised, screen.score(one)),
                    new.fit,
                )
            if blunt is not None and (best is None or delta_bic(best, blunt, 1.0) < 0):
                # what leaves noise is the rival as it is, the others before they are
                # sharpened
                best = blunt
        return self.ranked(result)

    def refitted(
        self,
        candidate: Candidate,
        screened: Screened,
        rival: Fit | None,
        others: Sequence[Fit],
        is_likely: bool,
    ) -> tuple[Candidate, Fit | None]:
        """The candidate with its re-fit, and the fit before dry friction is sharpened."""
        self.say(f"re-fitting with {candidate.effect}")
        result = self.refit(
            [candidate.effect],
            candidate.values,
            screened.beside,
            rival,
            others,
            is_likely,
        )
        if result is None:
            return candidate, None
        new, trained, comparison, blunt = result
        names = new_names(self.fit, new)
        linear = [n for n in names if new.model.entries[n].prunable] or names[:1]
        size, error = size_of(
            new, linear, is_wave(candidate.effect) and len(linear) == 2
        )
        p_value = screened.n_tried * self.p_value(new, trained)
        found = replace(
            candidate,
            coefficient=size,
            std_error=error,
            fit=new,
            trained=trained,
            comparison=comparison,
        )
        return replace(found, p_value=p_value), blunt

    def p_value(self, new: Fit, trained: Comparison) -> float:
        """Of the likelihood ratio, correlated residuals counted as fewer independent
        ones.
        """
        gain = (deviance(self.fit) - deviance(new)) * share_of(self.trained, trained)
        return float(chi2.sf(max(gain, 0.0), len(new.names) - len(self.fit.names)))

    def ranked(self, refitted: list[Candidate]) -> list[Candidate]:
        """By BIC, the best one's share of independent residuals taken for all; those
        that were not re-fitted last.

        Those that BIC hardly tells apart and that have as many parameters exchange
        places by what they leave on the data held out, counted in the same way; a
        larger one is not preferred for what it bends to fit there. Where none leaves
        noise, all are wrong, and of those the simplest comes first.
        """
        done = [
            (c, c.fit, c.trained)
            for c in refitted
            if c.fit is not None and c.trained is not None
        ]
        if not done:
            return refitted
        best = min(done, key=lambda row: deviance(row[1]))
        share = share_of(self.trained, best[2])
        rows = sorted(
            ((delta_bic(self.fit, fit, share), fit, c) for c, fit, _ in done),
            key=lambda row: row[0],
        )
        n_close = sum(bic < rows[0][0] + CLOSE for bic, _, _ in rows)
        close, clear = rows[:n_close], rows[n_close:]
        if any(is_adequate(trained) for _, _, trained in done):
            by_size: dict[int, list[tuple[float, Fit, Candidate]]] = {}
            for row in sorted(
                close, key=lambda row: row[0] + share * self.left_over(row[2])
            ):
                by_size.setdefault(len(row[1].names), []).append(row)
            close = [by_size[len(fit.names)].pop(0) for _, fit, _ in close]
        else:
            close = sorted(close, key=lambda row: len(row[1].names))
        result = [replace(c, delta_bic=bic) for bic, _, c in close + clear]
        result = [replace(c, confusable_with=tied(c, result)) for c in result]
        return result + [c for c in refitted if c.fit is None]

    def left_over(self, c: Candidate) -> float:
        """What the candidate leaves on the data held out; zero where there are none."""
        return (
            left_over(c.comparison)
            if self.is_held_out and c.comparison is not None
            else 0.0
        )

    def proposed(
        self, screen: Screen, found: list[Screened], everyone: tuple[Candidate, ...]
    ) -> Proposal | None:
        """The best significant effect; two together where one alone leaves more than
        noise and two explain more.

        The two are among ``found``; what could not be re-fitted alone can hardly be
        beside another. Dry friction is the simplest of its kinds there, as it would
        fill the list with each of them; the others are tried in the best pair.
        """
        best = None
        c = next((c for c in everyone if self.is_significant(c)), None)
        if (
            c is not None
            and c.fit is not None
            and c.trained is not None
            and c.comparison is not None
        ):
            tie = (
                f"; not told apart from {', '.join(c.confusable_with)}"
                if c.confusable_with
                else ""
            )
            error = f" +- {c.std_error:.2g}" if np.isfinite(c.std_error) else ""
            words = f", coefficient {c.coefficient:.4g}{error}{tie}"
            best = Proposal((c.effect,), c.fit, c.trained, c.comparison, words)
        if is_adequate(self.trained) or (
            best and explains(self.base, best.trained, best.comparison)
        ):
            return best
        alone = [c.fit for c in everyone if c.fit is not None]
        for pair in pairs(screen, simplest_dry(found), N_PAIRS):
            best = self.better_of(best, pair, len(found), alone)
        if best is not None and len(best.effects) == 2:
            others = [*alone, best.fit]
            for kinds in other_kinds(best.effects, found):
                for pair in pairs(screen, kinds, 1):
                    best = self.better_of(best, pair, len(found), others)
        return best

    def better_of(
        self,
        best: Proposal | None,
        pair: tuple[Screened, Screened],
        n_found: int,
        others: Sequence[Fit],
    ) -> Proposal | None:
        """The pair, or what of it is needed, where that is clearly better than the best
        so far; else the best so far.

        Its p-value counts all pairs of the ``n_found`` candidates; it may begin at one
        of the ``others``.
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
        better &= (
            comb(n_found, 2)
            * pair[0].n_tried
            * pair[1].n_tried
            * self.p_value(new, trained)
            < RATE
        )
        if better and falls_or_most(
            self.base if best is None else best.comparison, comparison
        ):
            return self.needed(Proposal(effects, new, trained, comparison), pair)
        return best

    def needed(self, both: Proposal, pair: tuple[Screened, Screened]) -> Proposal:
        """The pair, or the one of the two that does as much alone, from its values
        beside the other.
        """
        best, share = both, share_of(self.trained, both.trained)
        for one in pair:
            result = self.refit([one.effect], one.values, rival=both.fit)
            if result is not None and delta_bic(best.fit, result[0], share) < CLOSE:
                best = Proposal((one.effect,), *result[:3])
        return best

    def verdict(self, proposal: Proposal | None) -> tuple[str, str, tuple[Effect, ...]]:
        """Verdict, reason in words, and the effects that it names or, if they leave
        more than noise, proposes.
        """
        base, where = self.base, "held-out" if self.is_held_out else "training"
        errors = f"{where} error {base.rmse:.4g}, noise floor {base.noise_floor:.4g}"
        none = "no effect of the catalogue lowers it significantly"
        if proposal is None:
            is_failing = (
                not is_adequate(self.trained)
                or base.rmse > ABOVE_FLOOR * base.noise_floor
            )
            return (
                (UNEXPLAINED, f"{errors}, but {none}", ())
                if is_failing
                else (NOTHING, f"{errors}; {none}", ())
            )
        after = proposal.comparison
        names = " and ".join(map(str, proposal.effects)) + (
            " together" if len(proposal.effects) > 1 else ""
        )
        change = f"the {where} error falls from {base.rmse:.4g} to {after.rmse:.4g} (noise floor {after.noise_floor:.4g})"
        if explains(base, proposal.trained, after):
            return NAMED, f"{names}{proposal.words}; {change}", proposal.effects
        share = explained_share(base, after)
        verbs = (
            ("explains", "leaves")
            if len(proposal.effects) == 1
            else ("explain", "leave")
        )
        part = f"{verbs[0]} {100 * share:.0f} % of the squared error above the noise floor, and {verbs[1]} more than noise"
        reason = f"no known effect explains it all. The nearest, {names}{proposal.words}, {part}: {change}"
        return UNEXPLAINED, reason, proposal.effects if share > MOST else ()

    def is_significant(self, c: Candidate) -> bool:
        """Whether p-value and BIC hold, and the error on the judging data falls."""
        return (
            c.comparison is not None
            and c.p_value < RATE
            and c.delta_bic < 0
            and falls(self.base, c.comparison)
        )


def _strays(fit: Fit, trained: Comparison) -> float:
    """Root mean square distance of the free run from the states of the fit, in standard
    deviations of the noise.
    """
    seen = outputs_at_samples(
        fit.model, trained.data, fit.states, parameter_matrix(fit.model, trained.values)
    )
    triples = zip(trained.shown, seen, trained.data.trajectories, strict=True)
    apart = [((run - x) / trained.noise)[np.isfinite(of.x)] for run, x, of in triples]
    return float(np.sqrt(np.mean(np.concatenate(apart) ** 2)))


def _is_long(fit: Fit) -> bool:
    return sum(int(n.sum()) for n in fit.steps) > LONG
