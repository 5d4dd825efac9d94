"""Forces that repeat along a position: cogging, teeth of a gear, a wheel off centre.

A shaft that turns passes the same places again and again, and functions with a few
knots along its angle cannot show what repeats there. A wave with its second harmonic
can. Its period is found on the stretches of time that a fit sees, as that of a wave in
time, so that it earns nothing by being sought.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phsi_opt.criteria import CLEAR_PATTERN, NAMED_CAUSE
from phsi_opt.force_analysis.cross_validation import CrossValidation
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.piecewise_linear import piecewise_linear_basis
from phsi_opt.force_analysis.waves import drawn, explained_by_wave, harmonics
from phsi_opt.model.structure import exchange_partners
from phsi_opt.statistics import TINY

# Periods within the positions that were visited: fewer are a curve, which knots show.
LEAST_REPEATS = 2
MOST_REPEATS = 200
TRIED_PER_REPEAT = 4  # frequencies that are tried for each period more
N_REFINED = 21  # about the best of them


@dataclass(frozen=True, eq=False)
class PositionWave:
    """A force that repeats along a position.

    Attributes:
        position: the name of the state.
        period: after which the force comes again, in the unit of the position.
        waves: sine and cosine, and those of the second harmonic, as the estimate of the
            force shows them, (n_intervals, 4).
    """

    position: str
    period: float
    waves: np.ndarray


def position_wave(force: ForceRecord, equation: str) -> PositionWave | None:
    """The wave along a state that the equation exchanges energy with.

    None where it does not predict a tenth of the force's mean square more than
    functions of that state with a few knots do.
    """
    best = None
    least = np.inf
    for name in exchange_partners(force.fit.model, equation):
        if np.ptp(force.variable(name)) > 0:
            search = _Search.of(force, equation, name)
            error = search.error_left_out()
            if error < least:
                best = search
                least = error
    return None if best is None else best.found


@dataclass(frozen=True, eq=False)
class _Search:
    """The wave along one state, beside functions of the state with a few knots.

    Attributes:
        z: the state, (n_intervals,).
        functions: of the state, and slopes in the parameters, (n_intervals, k).
    """

    force: ForceRecord
    equation: str
    name: str
    validation: CrossValidation
    z: np.ndarray
    functions: np.ndarray

    @classmethod
    def of(cls, force: ForceRecord, equation: str, name: str) -> "_Search":
        z = force.variable(name)
        of_state = force.as_estimated(equation, piecewise_linear_basis(z))
        functions = np.hstack([force.by_parameters(equation), of_state])
        validation = CrossValidation.of(force.force_on(equation), force.run)
        return cls(force, equation, name, validation, z, functions)

    @property
    def found(self) -> PositionWave:
        """The wave that fits the whole force best."""
        frequency, _ = self.of_whole_force
        return PositionWave(self.name, 1 / frequency, self.waves(frequency))

    @cached_property
    def of_whole_force(self) -> tuple[float, float]:
        """`best_frequency` where the force is seen everywhere."""
        return self.best_frequency(np.ones(len(self.z), dtype=bool))

    def error_left_out(self) -> float:
        """Sum of squares on the stretches left out; infinite where that is no less.

        The wave has to be seen in the whole force first, which costs less.
        """
        _, share = self.of_whole_force
        if share < CLEAR_PATTERN:
            return np.inf
        clear = NAMED_CAUSE * self.validation.total
        error = 0.0
        for is_fitted in self.validation.training_masks:
            frequency, _ = self.best_frequency(is_fitted)
            columns = np.hstack([self.functions, self.waves(frequency)])
            error += self.validation.error_left_out(columns, is_fitted)
        without = self.validation.leave_out_error([self.functions])
        return error if error < without - clear else np.inf

    def waves(self, frequency: float) -> np.ndarray:
        """Waves of a frequency, as the estimate shows them, (n_intervals, 4)."""
        phase = 2 * np.pi * frequency * self.z
        return self.force.as_estimated(self.equation, harmonics(phase))

    def best_frequency(self, is_fitted: np.ndarray) -> tuple[float, float]:
        """Frequency of the wave that fits best what the functions leave.

        Returns:
            In cycles per unit of the state, 0 where that stands still; and the share of
            what the functions leave that the wave explains.
        """
        w = self.validation.w
        fitted = self.functions[is_fitted]
        coefficients = np.linalg.lstsq(fitted, w[is_fitted], rcond=None)[0]
        chosen = drawn(np.flatnonzero(is_fitted))
        left = w[chosen] - self.functions[chosen] @ coefficients
        z = self.z[chosen]
        if not np.ptp(z) > 0:
            return 0.0, 0.0
        apart = 1 / (TRIED_PER_REPEAT * np.ptp(z))
        number = np.arange(LEAST_REPEATS, MOST_REPEATS, 1 / TRIED_PER_REPEAT)
        tried = number / np.ptp(z)
        for step in (apart, apart / N_REFINED):
            best = tried[np.argmax(explained_by_wave(z, left, tried))]
            tried = best + step * np.linspace(-1, 1, N_REFINED)
        falls = explained_by_wave(z, left, tried)
        share = falls.max() / max(float(np.sum(left**2)), TINY)
        return float(tried[np.argmax(falls)]), float(share)
