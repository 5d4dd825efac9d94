"""What may be added to a model, singly or in pairs, with what each would leave.

Screening gives the start; a second look along each larger model then says what it
leaves on the record, and on data held out, before any is re-fitted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from phsi_opt.comparison.compare import Comparison
from phsi_opt.criteria import FEWEST_INDEPENDENT, N_LOOKED_PAIRS
from phsi_opt.errors import ModelError
from phsi_opt.estimation.record import Record
from phsi_opt.model.catalogue_storages import is_second_storage
from phsi_opt.model.effect import Effect
from phsi_opt.screening.pair_search import best_pairs
from phsi_opt.screening.score_test import ScoreTest, Screened
from phsi_opt.screening.second_look import Look, independent_share, second_look
from phsi_opt.statistics import TINY, likelihood_ratio_p_value

# Share of the misfit that is left at least when its logarithm is taken.
LEAST_MISFIT = 1e-9


@dataclass(frozen=True, eq=False)
class Prospect:
    """One effect, or two together, with what they would leave.

    Attributes:
        effects: that are added.
        screened: what screening expects of each, with values beside the other.
        coefficient: of the first effect, the amplitude of a wave; ``std_error``: of it,
            for the independent residuals that there are.
        values: of the effects' parameters, from which a re-fit starts; ``base_values``:
            of the base's own.
        misfit: squared residuals that are left, in units of the noise variance.
        n_free: number of parameters that are added; ``n_tried``: of values scanned.
        share: of the residuals that are independent.
        p_value: of the fall, for independent residuals and all values scanned.
        look: the second look; None where there is none: what is expected is screening's
            alone.
        held_out: misfit on the data that judge; NaN where it is not known.
    """

    effects: tuple[Effect, ...]
    screened: tuple[Screened, ...] = field(repr=False)
    coefficient: float
    std_error: float
    values: dict[str, float]
    base_values: dict[str, float]
    misfit: float
    n_free: int
    n_tried: int
    share: float
    p_value: float
    look: Look | None = field(repr=False, default=None)
    held_out: float = np.nan

    @property
    def effect(self) -> Effect:
        """The first effect."""
        return self.effects[0]

    @property
    def name(self) -> str:
        """What is added, in words."""
        return " and ".join(str(effect) for effect in self.effects)


@dataclass(frozen=True, eq=False)
class Prospects:
    """All that may be added to a model.

    Attributes:
        test: the screening of the record.
        run: the base model's free run on that record.
        base: the look at the base model itself; None where its steps do not settle.
        singles: the effects, the most convincing first.
    """

    test: ScoreTest
    run: Comparison
    base: Look | None = field(repr=False)
    singles: tuple[Prospect, ...]

    @classmethod
    def of(
        cls,
        test: ScoreTest,
        effects: Sequence[Effect],
        run: Comparison,
        judging: Record | None = None,
    ) -> "Prospects":
        """Screen effects, then look at each again.

        Args:
            test: of the base model along the training record.
            effects: the candidates.
            run: the base model's free run there.
            judging: the base model along the data held out.
        """
        base = second_look(test.linearized.record, (), {})
        prospects = cls(test, run, base, ())
        singles = []
        for one in test.screened(effects):
            looked = prospects.looked_at((one,))
            if prospects.score(looked) > 0:
                looked = prospects.held_out_of(looked, judging)
            singles.append(looked)
        ordered = sorted(singles, key=lambda one: -prospects.score(one))
        return cls(test, run, base, tuple(ordered))

    @property
    def misfit(self) -> float:
        """What the base leaves, in units of the noise variance."""
        return self.run.misfit if self.base is None else self.base.misfit

    @property
    def deviance(self) -> float:
        """Of the base, up to a constant."""
        return self.run.deviance if self.base is None else self.base.deviance

    @property
    def n_values(self) -> int:
        """Number of measured values."""
        return self.test.n_values

    def score(self, one: Prospect) -> float:
        """n log(misfit before / after) - k log n: minus the expected change of BIC."""
        return -self.delta_bic(one, 1.0)

    def delta_bic(self, one: Prospect, share: float) -> float:
        """Expected change of BIC where a share of the residuals is independent."""
        n = max(share * self.n_values, FEWEST_INDEPENDENT)
        return float(one.n_free * np.log(n) - share * self._fall(one))

    def _fall(self, one: Prospect) -> float:
        """Of the deviance, were all residuals independent."""
        if one.look is not None:
            return self.deviance - one.look.deviance
        left = max(one.misfit, LEAST_MISFIT * self.misfit)
        return self.n_values * float(np.log(max(self.misfit, left) / left))

    def looked_at(self, screened: tuple[Screened, ...]) -> Prospect:
        """Effects together, from the values that screening gives them."""
        effects = tuple(one.effect for one in screened)
        values: dict[str, float] = {}
        for one in screened:
            values |= one.values
        record = self.test.linearized.record
        look = None
        if self._is_worth_a_look(screened):
            look = second_look(record, effects, values)
        if look is None:
            return self._as_screened(screened, values)
        names = set(record.model.entries)
        reached: dict[str, float] = {}
        base_values: dict[str, float] = {}
        for name in look.model.free:
            target = base_values if name in names else reached
            target[name] = look.model.values[name]
        share = 1.0 if self.base is None else independent_share(self.base, look)
        n_tried = int(np.prod([one.n_tried for one in screened]))
        n_free = sum(one.n_free for one in screened)
        size = look.size(effects[0], record.model, share)
        return Prospect(
            effects=effects,
            screened=screened,
            coefficient=size.value,
            std_error=size.std_error,
            values=values | reached,
            base_values=base_values,
            misfit=look.misfit,
            n_free=n_free,
            n_tried=n_tried,
            share=share,
            p_value=self._p_value(look, share, n_free, n_tried),
            look=look,
        )

    def _is_worth_a_look(self, screened: tuple[Screened, ...]) -> bool:
        """All but effects with a memory of which screening expects nothing."""
        for one in screened:
            if one.effect.memory and self.test.score(one) <= 0:
                return False
        return True

    def pairs(
        self, singles: Sequence[Prospect], judging: Record | None = None
    ) -> list[Prospect]:
        """Pairs of effects, those that leave least first.

        Looked at are those that the joint regression of screening likes best, and the
        effect that leaves least alone with each of the others. Where a second look does
        not settle, a pair comes after the others, in the order of the regression.

        Args:
            singles: among which pairs are made, best first.
            judging: the base model along the data held out, on which the best pairs are
                looked at too.
        """
        found = [one.screened[0] for one in singles]
        likely = [tuple(p) for p in best_pairs(self.test, found, N_LOOKED_PAIRS)]
        known = [_key(pair) for pair in likely]
        pairs = list(likely)
        settled = [one for one in singles if one.look is not None]
        for other in settled[1:]:
            pair = (_reached(settled[0]), _reached(other))
            if _key(pair) not in known and self._is_compatible(pair):
                pairs.append(pair)
        looked = [self.looked_at(pair) for pair in pairs]
        best = [pair for pair in looked if pair.look is not None]
        best.sort(key=lambda one: -self.score(one))
        best = best[:N_LOOKED_PAIRS]
        told = [self.held_out_of(pair, judging) for pair in best]
        others = [pair for pair in looked[: len(likely)] if pair.look is None]
        return told + others

    def held_out_of(self, one: Prospect, judging: Record | None) -> Prospect:
        """With what is left on data held out, parameters as they are."""
        if judging is None or one.look is None:
            return one
        there = second_look(judging, one.effects, one.look.model.values, is_held=True)
        return one if there is None else replace(one, held_out=there.misfit)

    def _is_compatible(self, pair: tuple[Screened, ...]) -> bool:
        """Whether both can be in one model: Stribeck's friction contains Coulomb's."""
        model = self.test.model
        try:
            for one in pair:
                model = model.add(one.effect)
        except ModelError:
            return False
        return True

    def _as_screened(
        self, screened: tuple[Screened, ...], values: dict[str, float]
    ) -> Prospect:
        """Without a second look; of a pair what its better one leaves alone."""
        best = max(screened, key=lambda one: one.drop)
        if len(screened) == 1:
            values = best.near.values
        if is_second_storage(best.effect):
            values = {}  # from the middle of what is tried
        share = self.misfit / max(self.test.misfit, TINY)
        return Prospect(
            effects=tuple(one.effect for one in screened),
            screened=screened,
            coefficient=screened[0].coefficient,
            std_error=screened[0].std_error,
            values=values,
            base_values=best.near.base_values if len(screened) == 1 else {},
            misfit=share * max(self.test.misfit - best.drop, 0.0),
            n_free=sum(one.n_free for one in screened),
            n_tried=int(np.prod([one.n_tried for one in screened])),
            share=1.0,
            p_value=best.p_value,
        )

    def _p_value(self, look: Look, share: float, n_free: int, n_tried: int) -> float:
        """Of the likelihood ratio, for independent residuals and all values scanned."""
        gain = share * max(self.deviance - look.deviance, 0.0)
        return min(1.0, n_tried * likelihood_ratio_p_value(gain, n_free))


def _reached(one: Prospect) -> Screened:
    """An effect as screened, from the values that the second look reached."""
    return replace(one.screened[0], values=one.values)


def _key(pair: Sequence[Screened]) -> frozenset[tuple[str, str, str]]:
    """A pair without its order."""
    return frozenset((e.effect.name, e.effect.slot, e.effect.equation) for e in pair)
