"""The size of a hidden effect, set so that it shows by a given amount: above the noise
and above what the model error does.
"""

from dataclasses import dataclass, replace

import numpy as np

from problems.field_machines import disturbances
from problems.field_machines.base_error import BaseFit
from problems.field_machines.motion import recorded, simulate, typical_rate
from problems.field_machines.records import Experiment, Motion
from problems.hidden_effects.calibration import Trial, is_enough, next_size
from problems.hidden_effects.machines import log_uniform
from problems.hidden_effects.rows import Aim

# Root mean square of what acts beside the model, in that of the motion's own force.
MODEL_ERROR = 0.05
# Free-run error of the model without the effect, over the noise.
QUIETEST = 3.0
LOUDEST = 30.0
# What the effect does to a run over what the model error does to it, at least.
ABOVE_MODEL_ERROR = 2.0
WANTED_ABOVE = 2.5  # is sought where the first size is too small
TRIALS = 6
FAINT = (0.1, 0.4)  # shares of the noise, of an effect that should not be seen


@dataclass(frozen=True, eq=False)
class Sized:
    """An effect's size, the motion that it makes, what disturbs it and how it shows.

    ``ratio``, ``disturbed``: errors over the noise, see `Case`.
    """

    size: float
    motion: Motion
    kind: str
    ratio: float
    disturbed: float


@dataclass(frozen=True, eq=False)
class Sizing:
    """The search for a size.

    ``noise``: its share of the signal; ``kind``: of the disturbance; ``model_error``:
    its share of the motion's own force.
    """

    e: Experiment
    rng: np.random.Generator
    noise: float
    kind: str
    model_error: float = MODEL_ERROR

    def sized(self) -> Sized | None:
        """The experiment with its effect; None where it does not show as it should."""
        if self.e.is_faint:
            return self._faint()
        if self.e.hidden.is_drawn:
            hidden = self.e.hidden
            size = float(log_uniform(self.rng, hidden.least, hidden.largest))
            drawn = self._disturbed(size, self._base_error(size))
            return drawn if self._shows(drawn) else None
        fit = BaseFit(self.e)
        target = float(log_uniform(self.rng, QUIETEST, LOUDEST))
        found = self._aimed(fit, target)
        if found is None or self._shows(found):
            return found
        found = self._aimed(fit, WANTED_ABOVE * found.disturbed)
        return found if found is not None and self._shows(found) else None

    def without_effect(self) -> Sized:
        """The experiment with nothing hidden."""
        return self._disturbed(0.0, 0.0)

    def _faint(self) -> Sized:
        """The effect so small that it is far below the noise."""
        size = self.e.hidden.largest / 20
        share = self.rng.uniform(*FAINT)
        size *= share * self.noise / self._base_error(size)
        return self._disturbed(size, share * self.noise)

    def _shows(self, found: Sized) -> bool:
        error = found.ratio
        is_above = error > ABOVE_MODEL_ERROR * found.disturbed
        return is_above and error > QUIETEST

    def _base_error(self, size: float) -> float:
        return BaseFit(self.e).error(simulate(self.e, size))

    def _aimed(self, fit: BaseFit, target: float) -> Sized | None:
        """The size at which the model's error is near ``target`` times the noise."""
        largest = self.e.hidden.largest
        aim = Aim(self.noise, target, QUIETEST)
        size = largest / 8
        trials = [Trial(0.0, 0.0)]
        for _ in range(TRIALS):
            error = fit.error(simulate(self.e, size))
            trials.append(Trial(size, error))
            if is_enough(trials[-1], aim, largest):
                break
            size = min(next_size(trials, aim.wanted), largest)
        last = trials[-1]
        if last.error > self.e.loudest or last.error < QUIETEST * self.noise:
            return None
        return self._disturbed(last.size, last.error)

    def _disturbed(self, size: float, error: float) -> Sized:
        """The motion with what acts beside the model."""
        calm = simulate(self.e, size)
        motion = calm
        if self.model_error > 0 and self.kind != disturbances.NONE:
            one = disturbances.drawn(self.rng, self.kind, self.e, calm)
            strength = self.model_error * typical_rate(self.e, size, calm)
            motion = simulate(self.e, size, one.scaled(strength))
        off = self._change(size, motion)
        ratio = error / self.noise
        return Sized(size, motion, self.kind, ratio, off / self.noise)

    def _change(self, size: float, disturbed: Motion) -> float:
        """How far the training runs are from those without what acts beside the model.

        At the same recorded inputs, in root mean squares of the channels.
        """
        e = self.e
        if e.input_at is not None:
            e = replace(e, input_at=recorded(e, disturbed.u))
        calm = simulate(e, size)
        kept = e.kept[:, : e.n_train]
        first = calm.x[:, : e.n_train, list(e.seen)][kept]
        second = disturbed.x[:, : e.n_train, list(e.seen)][kept]
        scale = np.sqrt(np.mean(second**2, axis=0))
        return float(np.sqrt(np.mean(((first - second) / scale) ** 2)))
