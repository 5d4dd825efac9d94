"""Which disturbances a record shows, and how large they are.

By marginal likelihood, one kind after the other: forces and sensors that last, then
functions of states. A kind is taken only where the evidence for it is clear: a
disturbance that the record does not show would widen every interval for nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from phsi_opt.criteria import STRONG_EVIDENCE
from phsi_opt.errors import SolveError
from phsi_opt.model_error.ascent import Evidence, climbed, first_gains
from phsi_opt.model_error.disturbances import (
    MOST_SIZES,
    Coordinates,
    Disturbances,
    Process,
    StateFunction,
)
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import Border, MarginalLikelihood
from phsi_opt.statistics import TINY

# Sizes of a force to begin with, as shares of the typical rate of its state.
FORCE_SHARES = (0.1, 0.01)
# Sizes of a function that are tried, as shares of the typical rate. The last is also
# the limit: a model that lacks more is wrong and not inexact, and a smooth function of
# any size would imitate the corner of a friction that is not smooth.
FUNCTION_SHARES = (0.003, 0.01, 0.03, 0.1)
# Share of the evidence that is asked for, from which the first step of a search makes
# the others worth while: of 37 records in which a search found something all promised
# more; of 27 in which it found nothing, and no error was put in, four did.
PROMISING_SHARE = 0.5
# The same where sizes are tied: of 134 records of chains of 8 and 16 masses in which a
# search found something, three promised less than half and one, in which no force was
# put, less than this; of 40 of 8 masses in which no force was put ten promised more.
PROMISING_SHARE_TIED = 0.25


@dataclass(frozen=True, eq=False)
class DisturbanceSearch:
    """A search for the disturbances of a linearised record."""

    problem: Linearization  # the linearised record
    moving: np.ndarray  # (n_moving,) places of the parameters that are free to move
    plain: np.ndarray  # white noise of the plain likelihood, (n_trajectories, n_states)
    scatter: np.ndarray  # noise that neighbouring samples show, in the same shape
    channels: tuple[int, ...]  # states whose noise is not known
    # Whether one kind of disturbance is enough: that of a re-fit.
    is_brief: bool = False

    def likelihood(self, disturbances: Disturbances) -> MarginalLikelihood:
        return MarginalLikelihood(self.problem, disturbances, self.moving)

    def evidence(self, disturbances: Disturbances) -> Evidence:
        """Of given disturbances.

        Raises:
            SolveError: the states do not follow from the data.
        """
        system = self.likelihood(disturbances).at(disturbances)
        return Evidence(disturbances, system.log_evidence)

    @cached_property
    def white(self) -> Evidence:
        """White noise alone, as the plain likelihood has it.

        The evidence is that of the best white noise: it is what others are compared
        with. SolveError where the states do not follow from the data.
        """
        plain = self.evidence(Disturbances(self.plain))
        best = self.best_of([plain.disturbances])
        return replace(plain, log_evidence=max(best.log_evidence, plain.log_evidence))

    @cached_property
    def pieces(self) -> "DisturbanceSearch | None":
        """The same search on a part of a long record; None for one that is short.

        Sizes and times are known to a few percent from so many intervals and states,
        and the whole record has the last word.
        """
        spread = self.problem.evenly_spread()
        if spread is None:
            return None
        problem, runs = spread
        plain, scatter = self.plain[runs], self.scatter[runs]
        return replace(self, problem=problem, plain=plain, scatter=scatter)

    # --- What promises to be found

    @property
    def is_promising(self) -> bool:
        """Whether any kind of disturbance promises to be found.

        Raises:
            SolveError: the states do not follow from the data.
        """
        return bool((self.pieces or self).promising)

    @cached_property
    def promising(self) -> frozenset[str]:
        """Which of noises, forces, sensors and functions may be clear enough.

        By the first step of a search, which costs a small part of the whole
        (`PROMISING_SHARE`).

        Raises:
            SolveError: the states do not follow from the data.
        """
        white = Disturbances(self.plain)
        if not self.is_brief:
            white = replace(white, functions=self._function_candidates())
        system = self.likelihood(white).at(white)
        n_processes = max(
            len(self.problem.forced), len(np.unique(self.problem.grid.channel))
        )
        is_tied = len(self.channels) + n_processes > MOST_SIZES
        alone = system.without_functions()
        gains = []
        for time in self.first_times():
            both = self._with_kind(alone.disturbances, "forces", 1.0, time)
            both = self._with_kind(both, "sensors", 1.0, time)
            gains.append(first_gains(alone, self.channels, both, is_tied))
        by_forces, by_sensors = np.max(gains, axis=0)
        share = PROMISING_SHARE_TIED if is_tied else PROMISING_SHARE
        limit = share * STRONG_EVIDENCE
        sizes = _chosen_sizes(system.border, self._rates_of(white.functions))
        kinds = {
            "noises": self.noise_differs and self._noise_by_run_promises(),
            "forces": by_forces > limit,
            "sensors": by_sensors > limit,
            "functions": np.any(sizes > 0),
        }
        return frozenset(kind for kind, promises in kinds.items() if promises)

    @property
    def noise_differs(self) -> bool:
        """Whether the scatter says that trajectories have noises of their own."""
        return bool(np.ptp(self.scatter, axis=0).max() > 0)

    def _noise_by_run_promises(self) -> bool:
        """Whether noises in the ratios of the scatter may explain the residuals."""
        sigma = self._noises()[0]
        in_noise = (self.problem.residual / self.problem.of_values(sigma)) ** 2
        for channel in self.channels:
            own = self.problem.grid.channel == channel
            sigma[:, channel] *= np.sqrt(np.mean(in_noise[own]))
        by_run = self.evidence(Disturbances(sigma)).log_evidence
        together = self.evidence(Disturbances(self.plain)).log_evidence
        return by_run > together + PROMISING_SHARE * self._evidence_of_runs

    @property
    def _evidence_of_runs(self) -> float:
        """Gain that is asked for where each trajectory's noise is from the data."""
        return STRONG_EVIDENCE + self.problem.grid.n_trajectories

    # --- What is found

    def found(self) -> Evidence:
        """What the record shows, white noise where it shows no more.

        Nothing is searched for where no kind of disturbance promises a gain. Of a long
        record evenly spread pieces are searched, and the sizes then moved to the
        optimum of the whole.

        Raises:
            SolveError: the states do not follow from the data.
        """
        pieces = self.pieces
        if not self.is_promising:
            return self.evidence(Disturbances(self.plain))
        if pieces is None:
            return self._found_directly()
        in_pieces = pieces._found_directly().disturbances
        if in_pieces.is_white and not self.noise_differs:
            return self.evidence(Disturbances(self.plain))
        # Noises keep the ratios that neighbouring samples show.
        ratios = np.log(in_pieces.sigma / pieces._noises()[0])
        sigma = self._noises()[0] * np.exp(np.mean(ratios, axis=0))
        start = replace(in_pieces, sigma=sigma)
        best = self.best_of([start], most_steps=4)
        is_clear = best.log_evidence > self.white.log_evidence + STRONG_EVIDENCE
        return best if is_clear else self.white

    def _found_directly(self) -> Evidence:
        best = self.white
        if "noises" in self.promising:
            noises = Disturbances(self._noises()[0])
            best = self._clearer(best, [noises], self._evidence_of_runs)
        of_forces = self._clearer(best, self._starts("forces", FORCE_SHARES))
        of_sensors = self._clearer(best, self._starts("sensors", (0.7,)))
        found = max(of_forces, of_sensors, key=lambda one: one.log_evidence)
        if self.is_brief:
            return found
        # Both kinds promise, and one was found.
        if found is not best and {"forces", "sensors"} <= self.promising:
            # With a little of the kind that is not among them.
            other = ("sensors", FORCE_SHARES[0])
            if found is of_sensors:
                other = ("forces", FORCE_SHARES[-1])
            starts = []
            for time in self.first_times():
                starts.append(self._with_kind(found.disturbances, *other, time))
            found = self._clearer(found, starts)
        functions = self._chosen_functions(found.disturbances)
        if not functions:
            return found
        with_functions = replace(found.disturbances, functions=functions)
        return self._clearer(found, [with_functions])

    def _clearer(
        self,
        best: Evidence,
        starts: Sequence[Disturbances],
        needed: float = STRONG_EVIDENCE,
    ) -> Evidence:
        """What is found from some starts, where the evidence for it is clear."""
        worth = best.log_evidence + needed
        found = self.best_of(starts, worth=worth) if starts else best
        return found if found.log_evidence > worth else best

    def best_of(
        self,
        starts: Sequence[Disturbances],
        most_steps: int = 25,
        worth: float = -np.inf,
    ) -> Evidence:
        """The most likely disturbances, searched from the best of some starts.

        The starts have the same structure; ``most_steps`` uphill, at most. Log evidence
        below ``worth`` is of no use.
        """
        likelihood = self.likelihood(starts[0])
        origin = starts[0]
        if len(starts) > 1:
            values = [_log_evidence(likelihood, start) for start in starts]
            origin = starts[int(np.argmax(values))]
        largest = FUNCTION_SHARES[-1] * self._rates_of(origin.functions)
        coordinates = Coordinates(
            origin=origin,
            channels=self.channels,
            # The scatter is noise and what a cubic does not follow.
            least_noise=0.1 * np.mean(self.scatter, axis=0),
            shortest=0.3 * self._interval,  # as good as white
            longest=self._longest,
            largest_functions=tuple(largest.tolist()),
        )
        if not self.is_brief:
            return climbed(likelihood, coordinates, most_steps, worth)
        # It moves the standard errors of a re-fit by a few percent.
        return climbed(likelihood, coordinates, most_steps, worth, least_gain=0.2)

    # --- Where searches begin

    @property
    def _interval(self) -> float:
        """Typical interval between nodes."""
        return float(np.median(self.problem.grid.h))

    @property
    def _longest(self) -> float:
        grid = self.problem.grid
        return float(grid.t[-1] - grid.t[grid.first[-1]])

    def first_times(self) -> list[float]:
        """Correlation times to begin a search with.

        Three intervals, a tenth of a record, and one between.
        """
        short = 3 * self._interval
        long = max(0.1 * self._longest, 2 * short)
        return [short, float(np.sqrt(short * long)), long]

    def _noises(self) -> list[np.ndarray]:
        """White noises to begin with: of neighbouring samples, and of the residuals."""
        highest = np.max(self.scatter, axis=0)
        largest = np.minimum(highest, np.max(self.plain, axis=0))
        lower = self.scatter / highest * largest
        known = [k for k in range(lower.shape[1]) if k not in self.channels]
        lower[:, known] = self.plain[:, known]
        return [lower, self.plain]

    def rates(self) -> np.ndarray:
        """Typical rate of every state, (n_states,)."""
        rates = self.problem.grid.rates(self.problem.nodes)
        typical: np.ndarray = np.sqrt(np.mean(rates**2, axis=0))
        return np.maximum(typical, TINY ** (1 / 4))

    def _rates_of(self, functions: Sequence[StateFunction]) -> np.ndarray:
        """Typical rate in the equation of each function, (n_functions,)."""
        return self.rates()[[function.equation for function in functions]]

    def _starts(self, kind: str, shares: Sequence[float]) -> list[Disturbances]:
        """With forces or sensors of some sizes; none where they do not promise."""
        starts = []
        times = self.first_times() if kind in self.promising else []
        for sigma, time, share in product(self._noises(), times, shares):
            starts.append(self._with_kind(Disturbances(sigma), kind, share, time))
        return starts

    def _with_kind(
        self, beside: Disturbances, kind: str, share: float, time: float
    ) -> Disturbances:
        """With forces, or sensors: a share of the rates, or of the residuals."""
        sizes = np.mean(self.plain, axis=0)
        places = np.unique(self.problem.grid.channel).tolist()
        if kind == "forces":
            sizes = self.rates()
            places = list(self.problem.forced)
        processes = tuple(Process(k, float(share * sizes[k]), time) for k in places)
        changed: dict[str, Any] = {kind: processes}
        return replace(beside, **changed)

    def _chosen_functions(self, beside: Disturbances) -> tuple[StateFunction, ...]:
        """Functions that the evidence asks for, given other disturbances."""
        candidates = self._function_candidates()
        if not candidates:
            return ()
        with_all = replace(beside, functions=candidates)
        border = self.likelihood(with_all).at(with_all).border
        sizes = _chosen_sizes(border, self._rates_of(candidates)).tolist()
        chosen = []
        for candidate, size in zip(candidates, sizes, strict=True):
            if size > 0:
                chosen.append(replace(candidate, size=size))
        return tuple(chosen)

    def _function_candidates(self) -> tuple[StateFunction, ...]:
        """The functions that are tried, as large as the typical rate."""
        # None where they have more than 80 columns in the border: each costs as much as
        # one more parameter.
        problem = self.problem
        rates = self.rates().tolist()
        candidates = []
        n_columns = 0
        for equation, state in product(problem.forced, problem.observed):
            n_functions = problem.function_values[state].shape[1]
            if n_functions:
                candidates.append(StateFunction(equation, state, rates[equation]))
                n_columns += n_functions
        return tuple(candidates) if n_columns <= 80 else ()


def _log_evidence(likelihood: MarginalLikelihood, disturbances: Disturbances) -> float:
    """Of disturbances; minus infinity where no states follow."""
    try:
        value = likelihood.at(disturbances).log_evidence
    except (SolveError, np.linalg.LinAlgError):
        return -np.inf
    return value if np.isfinite(value) else -np.inf


def _chosen_sizes(border: Border, rates: np.ndarray) -> np.ndarray:
    """Sizes of functions that the evidence asks for, (n_functions,); 0: left out."""
    # One after the other; each time the one whose size, or change of size, gains most.
    sizes = np.zeros(len(rates))
    for _ in rates:
        trials = []
        for number, rate in enumerate(rates):
            shares = np.array([0.0, *FUNCTION_SHARES])
            tried = np.append(shares * rate, sizes[number])
            gains = replace(border, sizes=sizes).gains_by_function(number, tried)
            best = int(np.argmax(gains))
            trials.append((gains[best] - gains[-1], number, tried[best]))
        gain, number, size = max(trials, key=lambda found: found[0])
        if gain < STRONG_EVIDENCE / 2:
            break
        sizes[number] = size
    return sizes
