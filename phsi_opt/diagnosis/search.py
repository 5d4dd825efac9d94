"""A search over models: sets of effects, compared by their evidence beside a force.

A beam search. Of the models with one effect the likeliest three are enlarged by one
effect each: screening beside the force that a model leaves tells what every further
effect promises, less what it did not keep of its promises before, and models are
weighed in that order, at least one beside each, until none promises to come near the
likeliest of that size. So on with two effects and three, as a stand-in may be likelier
than any one of several laws, and less likely than all of them. A new likeliest model
gives back each of its effects by turns, as the first may have stood in for what was
found later. The search ends where the likeliest model is nearly as likely as if what it
leaves were noise. This is asked of the weighing with a force and of a re-fit without
one: the weighing may have ended at a worse optimum, and its corners are round.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import (
    DECISIVE_EVIDENCE,
    FAR_BEHIND,
    LEAST_FINDING,
    STRONG_EVIDENCE,
)
from phsi_opt.diagnosis.ranking import (
    Ranking,
    force_left,
    lost_of,
    screened_beside,
    weighed_of,
)
from phsi_opt.diagnosis.refit import DiagnosedModel
from phsi_opt.errors import SolveError
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.presentation.numbers import enumerated
from phsi_opt.screening.linearized_record import LinearizedRecord
from phsi_opt.screening.score_test import Screened
from phsi_opt.screening.weighing import EvidenceRecord, Weighed
from phsi_opt.sweeps.sweep import Progress, ahead

BEAM = 3  # models of one size that are enlarged
MOST_EFFECTS = 4  # of one model


@dataclass(frozen=True, eq=False)
class Combination:
    """Effects that were weighed together."""

    effects: tuple[Effect, ...]
    # Logarithm of what was tried until each was found, by its name.
    prices: Mapping[str, float]
    weighed: Weighed
    log_evidence: float  # over the base, less the prices
    force_left: float  # size of the force over that beside the base
    # Along the training record, (n_nodes, n_states).
    states: np.ndarray = field(repr=False)

    @property
    def name(self) -> str:
        return enumerated(map(str, self.effects))

    @property
    def key(self) -> frozenset[str]:
        """Its effects, in no order."""
        return frozenset(map(str, self.effects))

    @property
    def values(self) -> Mapping[str, float]:
        """Of the parameters of the model with them."""
        return self.weighed.model.values


@dataclass(frozen=True, eq=False)
class _Step:
    """A larger model to be weighed: a known one with one effect more."""

    effects: tuple[Effect, ...]  # of the larger model, the new one last
    prices: Mapping[str, float]
    record: EvidenceRecord  # beside which the new one was screened
    further: Screened
    promise: float  # expected log evidence, as that of `Combination`

    @property
    def key(self) -> frozenset[str]:
        return frozenset(map(str, self.effects))


def _promise(further: Screened, price: float) -> float:
    """Log evidence that an effect is expected to gain, less its price."""
    # The expected gain has paid for the values tried, which the price has too.
    return further.gain + float(np.log(further.n_tried)) - price


def _missing_in(comparisons: Sequence[Comparison]) -> float:
    """Log likelihood that free runs miss to leave nothing but the estimated noise."""
    tables = (one.table for one in comparisons)
    return sum(float(one["n_samples"] @ np.log(one["chi2_dof"])) / 2 for one in tables)


def _weighed(step: _Step, say: Progress) -> Weighed:
    return weighed_of(step.record, step.further, say)


class Search:
    """The models that were weighed, beginning with those of a ranking."""

    def __init__(
        self,
        base: DiagnosedModel,
        ranking: Ranking,
        effects: Sequence[Effect],
        refitted: Callable[[Combination], DiagnosedModel | None],
    ) -> None:
        self.base = base
        self.ranking = ranking
        self.effects = effects
        self.refitted = refitted  # the base with effects, where that is worth it
        self.known: dict[frozenset[str], Combination] = {}
        # The largest share of its promise that an effect kept where it was weighed.
        self.kept: dict[str, float] = {}
        # Models that were asked whether they are complete, with the answer.
        self._completed: dict[frozenset[str], bool] = {}
        for one in ranking.candidates:
            if one.was_weighed and not one.lost:
                further = ranking.screened[one.name]
                price = ranking.price(further)
                weighed = ranking.weighed[one.name]
                self._take((one.effect,), {one.name: price}, weighed)
                self._compare(one.name, _promise(further, price), one.log_evidence)

    def run(self) -> None:
        """Enlarge the likeliest models of each size, until one is complete."""
        for size in range(1, MOST_EFFECTS):
            if self.is_complete():
                return
            enlarged: set[frozenset[str]] = set()
            while fresh := [one for one in self._beam(size) if one.key not in enlarged]:
                best = self.in_order()[0]
                enlarged.add(fresh[0].key)
                self._enlarge(fresh[0])
                found = self.in_order()[0]
                # What was found first may have stood in for what came after.
                for effect in found.effects if found is not best else ():
                    self._without(found, str(effect))

    def _beam(self, size: int) -> list[Combination]:
        """The likeliest models of a size that no smaller model equals."""
        highest = max((one.log_evidence for one in self.known.values()), default=0.0)
        least = FAR_BEHIND * max(highest, 0.0)
        beam = []
        for one in self.in_order():
            is_far = len(one.effects) != size or one.log_evidence <= least
            if not is_far and not self._has_equal(one):
                beam.append(one)
        return beam[:BEAM]

    def _has_equal(self, one: Combination) -> bool:
        least = (1 - LEAST_FINDING) * one.log_evidence
        rests = (rest for rest in self.known.values() if rest.key < one.key)
        return any(rest.log_evidence > least for rest in rests)

    def is_complete(self) -> bool:
        """Whether the likeliest model is nearly as likely as if it left noise alone."""
        one = next(iter(self.in_order()), None)
        if one is None:
            return False
        if one.key not in self._completed:
            self._completed[one.key] = False  # where it is not known
            with suppress(SolveError):
                self._completed[one.key] = self._leaves_noise(one)
        return self._completed[one.key]

    def _leaves_noise(self, one: Combination) -> bool:
        """Whether that is so beside a force, or in the free runs of a re-fit."""
        weighed = one.weighed
        missing = self.ranking.record.log_noise(weighed) - weighed.log_likelihood
        least = max(DECISIVE_EVIDENCE, LEAST_FINDING * one.log_evidence)
        if missing < least:
            return True
        larger = self.refitted(one)
        return larger is not None and _missing_in(larger.comparisons) < least

    def in_order(self) -> list[Combination]:
        """What was weighed, the likeliest first."""
        return sorted(self.known.values(), key=lambda one: -one.log_evidence)

    def worth(self, one: Combination) -> dict[str, float]:
        """The evidence that is lost where each effect alone is left out, most first."""
        worth = {}
        for name in map(str, one.effects):
            rest = self._without(one, name)
            # Without a model to compare with, what all of them gain.
            worth[name] = one.log_evidence - (rest.log_evidence if rest else 0.0)
        return dict(sorted(worth.items(), key=lambda item: -item[1]))

    def path(self, one: Combination) -> tuple[Effect, ...]:
        """Its effects in an order in which the error falls.

        The last is the one without which the others are likeliest, and so on with
        these: what is worth most beside all others may do harm alone.
        """
        rests = []
        for effect in one.effects:
            rest = self._without(one, str(effect))
            if rest is not None:
                rests.append((rest.log_evidence, rest, effect))
        if not rests:
            return one.effects
        _, rest, last = max(rests, key=lambda item: item[0])
        return (*self.path(rest), last)

    def alike(self, one: Combination, name: str) -> list[Effect]:
        """Effects that the evidence does not tell from one of a model."""
        found = []
        for other in self.in_order():
            others = other.key - one.key
            is_exchange = one.key - other.key == {name} and len(others) == 1
            is_near = one.log_evidence - other.log_evidence < STRONG_EVIDENCE
            if is_exchange and is_near:
                found += [effect for effect in other.effects if str(effect) in others]
        return found

    def _enlarge(self, one: Combination) -> None:
        """Weigh a model with further effects, the most promising first.

        Until none promises to gain, or to come near the likeliest model of that size.
        """
        steps = [step for step in self._steps(one) if step.key not in self.known]
        steps.sort(key=lambda step: -step.promise)
        cases = {str(step.further.effect): step for step in steps}
        say = self.base.say
        with closing(ahead(_weighed, cases, self.base.executor, say)) as results:
            for number, step in enumerate(steps):
                least = one.log_evidence
                if number:
                    least = max(least, self._highest(len(step.effects)))
                if step.promise < least - STRONG_EVIDENCE:
                    return
                with suppress(SolveError):
                    found = self._take(step.effects, step.prices, next(results)())
                    if found is not None:
                        name = str(step.further.effect)
                        expected = _promise(step.further, step.prices[name])
                        gain = found.log_evidence - one.log_evidence
                        self._compare(name, expected, gain)

    def _highest(self, size: int) -> float:
        """Log evidence of the likeliest model of a size."""
        alike = (one for one in self.known.values() if len(one.effects) == size)
        return max((one.log_evidence for one in alike), default=-np.inf)

    def _compare(self, name: str, expected: float, gain: float) -> None:
        """Note what an effect kept of its promise."""
        if expected > 0:
            share = float(np.clip(gain / expected, 0.0, 1.0))
            self.kept[name] = max(share, self.kept.get(name, 0.0))

    def _steps(self, one: Combination) -> Iterator["_Step"]:
        """The model with each further effect, and the log evidence it promises."""
        told = self.base.told(*one.effects)
        self.base.say(f"screening further effects beside {told}")
        record = replace(self.ranking.record, base=one.weighed)
        others = [effect for effect in self.effects if str(effect) not in one.key]
        for further in screened_beside(LinearizedRecord.beside_force(record), others):
            name = str(further.effect)
            price = self.ranking.price(further)
            gain = _promise(further, price)
            gain = min(gain, gain * self.kept.get(name, 1.0))
            yield _Step(
                (*one.effects, further.effect),
                {**one.prices, name: price},
                record,
                further,
                one.log_evidence + gain,
            )

    def _without(self, larger: Combination, name: str) -> Combination | None:
        """A model less one effect, begun where it is; None: it was not found."""
        fewer = tuple(one for one in larger.effects if str(one) != name)
        known = self.known.get(frozenset(map(str, fewer)))
        if known is not None or not fewer:
            return known
        by_name = dict(zip(map(str, larger.effects), larger.effects, strict=True))
        told = self.base.told(by_name[name])
        self.base.say(f"computing the evidence without {told}")
        model = reduce(Model.add, fewer, self.ranking.record.base.model)
        values = larger.weighed.model.values
        model = model.with_values({name: values[name] for name in model.values})
        with suppress(SolveError):
            weighed = self.ranking.record.weighed_within(larger.weighed, model)
            return self._take(fewer, larger.prices, weighed)
        return None

    def _take(
        self, effects: tuple[Effect, ...], prices: Mapping[str, float], weighed: Weighed
    ) -> Combination | None:
        """Note a model; None where the record does not determine it."""
        record = self.ranking.record
        base = self.base.fit.model
        tried = 0.0
        for effect in effects:
            if lost_of(record, effect, weighed):
                return None
            tried += prices[str(effect)]
        equations = [row for effect in effects for row in base.rows(effect.equation)]
        found = Combination(
            effects,
            prices,
            weighed,
            weighed.log_evidence - record.base.log_evidence - tried,
            force_left(weighed, record.base, equations),
            weighed.states[: record.n_fitted_nodes],
        )
        self.known[found.key] = found
        return found
