"""Which disturbances a record shows, and how large they are.

By marginal likelihood, one kind after the other: forces and sensors that wander, then
functions of states. A kind is taken only where the evidence for it is clear: a
disturbance that the record does not show would widen every interval for nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from phsi_opt.criteria import STRONG_EVIDENCE
from phsi_opt.errors import SolveError
from phsi_opt.model_error.ascent import LEAST_GAIN, MOST_STEPS, ScoreTest, climbed
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
# Gain of the log evidence by a step at which the ascent of a re-fit ends: it moves its
# standard errors by a few percent.
BRIEF_GAIN = 0.2
# Share of the evidence that is asked for, from which the first step of a search makes
# the others worth while: of 37 records in which a search found something all promised
# more; of 27 in which it found nothing, and no error was put in, four did.
PROMISING_SHARE = 0.5
# The same where sizes are tied: of 134 records of chains of 8 and 16 masses in which a
# search found something, three promised less than half and one, in which no force was
# put, less than this; of 40 of 8 masses in which no force was put ten promised more.
PROMISING_SHARE_TIED = 0.25


@dataclass(frozen=True, eq=False)
class Evidence:
    """Disturbances with the logarithm of their marginal likelihood.

    Attributes:
        disturbances: with their sizes.
        log_evidence: up to a constant of the record.
        coordinates: in which they were found; None: they were given.
        information: of them, (n_coordinates, n_coordinates), about its curvature;
            None likewise.
    """

    disturbances: Disturbances
    log_evidence: float
    coordinates: Coordinates | None = None
    information: np.ndarray | None = None


@dataclass(frozen=True)
class _Promising:
    """Kinds of disturbances that a search may find.

    Attributes:
        noises: of the trajectories, each its own.
        forces: that wander.
        sensors: that wander.
        functions: of states.
    """

    noises: bool
    forces: bool
    sensors: bool
    functions: bool


@dataclass(frozen=True, eq=False)
class DisturbanceSearch:
    """A search for the disturbances of a linearised record.

    Attributes:
        problem: the linearised record.
        moving: (n_moving,) places of the parameters that are free to move.
        plain: white noise of the plain likelihood, (n_trajectories, n_states).
        scatter: noise that neighbouring samples show, in the same shape.
        channels: states whose noise is not known.
        is_brief: whether one kind of disturbance is enough: that of a re-fit.
    """

    problem: Linearization
    moving: np.ndarray
    plain: np.ndarray
    scatter: np.ndarray
    channels: tuple[int, ...]
    is_brief: bool = False

    @cached_property
    def white(self) -> Evidence:
        """White noise alone, as the plain likelihood has it.

        The evidence is that of the best white noise: it is what others are compared
        with. SolveError where the states do not follow from the data.
        """
        plain = self.evidence(Disturbances(self.plain))
        best = self.best_of([plain.disturbances])
        return replace(plain, log_evidence=max(best.log_evidence, plain.log_evidence))

    def evidence(self, disturbances: Disturbances) -> Evidence:
        """Of given disturbances.

        Raises:
            SolveError: the states do not follow from the data.
        """
        system = self.likelihood(disturbances).at(disturbances)
        return Evidence(disturbances, system.log_evidence)

    @cached_property
    def is_promising(self) -> bool:
        """Whether any kind of disturbance promises to be found.

        Raises:
            SolveError: the states do not follow from the data.
        """
        return any(vars((self.pieces or self)._promising).values())

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
        white = self.white
        # Noises keep the ratios that neighbouring samples show.
        ratios = np.log(in_pieces.sigma / pieces.noises()[0])
        sigma = self.noises()[0] * np.exp(np.mean(ratios, axis=0))
        start = replace(in_pieces, sigma=sigma)
        best = self.best_of([start], most_steps=4)
        is_clear = best.log_evidence > white.log_evidence + STRONG_EVIDENCE
        return best if is_clear else white

    @cached_property
    def _promising(self) -> "_Promising":
        """Which kinds of disturbances may be clear enough to be taken.

        By the first step of a search, which costs a small part of the whole
        (`PROMISING_SHARE`).

        Raises:
            SolveError: the states do not follow from the data.
        """
        white = Disturbances(self.plain)
        if not self.is_brief:
            white = replace(white, functions=self._function_candidates())
        system = self.likelihood(white).at(white)
        sensors = np.unique(self.problem.channel)
        n_processes = max(len(self.problem.forced), len(sensors))
        is_tied = len(self.channels) + n_processes > MOST_SIZES
        test = ScoreTest(system.without_functions(), self.channels, is_tied)
        gains = []
        for time in self.first_times():
            gains.append(test.gains(self._forces(1.0, time), self._sensors(1.0, time)))
        by_forces, by_sensors = np.max(gains, axis=0)
        share = PROMISING_SHARE_TIED if is_tied else PROMISING_SHARE
        limit = share * STRONG_EVIDENCE
        sizes = _chosen_sizes(system.border, self._rates_of(white.functions))
        return _Promising(
            noises=self.noise_differs and self._noise_by_run_promises(),
            forces=by_forces > limit,
            sensors=by_sensors > limit,
            functions=bool(np.any(sizes > 0)),
        )

    def _noise_by_run_promises(self) -> bool:
        """Whether noises in the ratios of the scatter may explain the residuals."""
        squares = self.problem.residual**2
        sigma = self.noises()[0]
        weights = self.problem.of_values(sigma) ** -2
        for channel in self.channels:
            own = self.problem.channel == channel
            sigma[:, channel] *= np.sqrt(np.mean((weights * squares)[own]))
        by_run = self.evidence(Disturbances(sigma)).log_evidence
        together = self.evidence(Disturbances(self.plain)).log_evidence
        return by_run > together + PROMISING_SHARE * self._evidence_of_runs

    @property
    def _evidence_of_runs(self) -> float:
        """Gain that is asked for where each trajectory's noise is from the data."""
        return STRONG_EVIDENCE + self.problem.n_trajectories

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
        return replace(
            self, problem=problem, plain=self.plain[runs], scatter=self.scatter[runs]
        )

    def _found_directly(self) -> Evidence:
        promising = self._promising
        best = self.white
        if promising.noises:
            noises = Disturbances(self.noises()[0])
            best = self._clearer(best, [noises], self._evidence_of_runs)
        force_starts = self._force_starts() if promising.forces else []
        sensor_starts = self._sensor_starts() if promising.sensors else []
        of_forces = self._clearer(best, force_starts)
        of_sensors = self._clearer(best, sensor_starts)
        one = max(of_forces, of_sensors, key=lambda found: found.log_evidence)
        if self.is_brief:
            return one
        # Both kinds promise, and one was found.
        if one is not best and promising.forces and promising.sensors:
            one = self._clearer(one, self._with_the_other_kind(one.disturbances))
        functions = self._chosen_functions(one.disturbances)
        if not functions:
            return one
        return self._clearer(one, [replace(one.disturbances, functions=functions)])

    def _clearer(
        self,
        best: Evidence,
        starts: Sequence[Disturbances],
        needed: float = STRONG_EVIDENCE,
    ) -> Evidence:
        """What is found from some starts, where the evidence for it is clear."""
        worth = best.log_evidence + needed
        found = self.best_of(starts, worth=worth)
        return found if found.log_evidence > worth else best

    def best_of(
        self,
        starts: Sequence[Disturbances],
        most_steps: int = MOST_STEPS,
        worth: float = -np.inf,
    ) -> Evidence:
        """The most likely disturbances, searched from the best of some starts.

        The starts have the same structure; ``most_steps`` uphill, at most. Log evidence
        below ``worth`` is of no use.
        """
        if not starts:
            return Evidence(Disturbances(self.plain), -np.inf)
        likelihood = self.likelihood(starts[0])
        values = [_log_evidence(likelihood, start) for start in starts]
        origin = starts[int(np.argmax(values))]
        coordinates = Coordinates(
            origin=origin,
            channels=self.channels,
            # The scatter is noise and what a cubic does not follow.
            least_noise=0.1 * np.mean(self.scatter, axis=0),
            shortest=self.shortest,
            longest=self._longest,
            largest_functions=tuple(
                FUNCTION_SHARES[-1] * float(rate)
                for rate in self._rates_of(origin.functions)
            ),
        )

        least_gain = BRIEF_GAIN if self.is_brief else LEAST_GAIN
        found = climbed(
            likelihood, coordinates, self.channels, most_steps, worth, least_gain
        )
        disturbances = coordinates.at(found.vector)
        moved = replace(coordinates, origin=disturbances)
        return Evidence(disturbances, found.log_evidence, moved, found.information)

    def likelihood(self, disturbances: Disturbances) -> MarginalLikelihood:
        """The marginal likelihood for disturbances of this structure."""
        return MarginalLikelihood(self.problem, disturbances, self.moving)

    @property
    def noise_differs(self) -> bool:
        """Whether the scatter says that trajectories have noises of their own."""
        return bool(np.ptp(self.scatter, axis=0).max() > 0)

    @property
    def interval(self) -> float:
        """Typical interval between nodes."""
        return float(np.median(self.problem.grid.h))

    @property
    def _longest(self) -> float:
        grid = self.problem.grid
        return float(grid.t[-1] - grid.t[grid.first[-1]])

    @property
    def shortest(self) -> float:
        """Shortest correlation time, as good as white."""
        return 0.3 * self.interval

    def first_times(self) -> list[float]:
        """Correlation times to begin a search with.

        Three intervals, a tenth of a record, and one between.
        """
        short = 3 * self.interval
        long = max(0.1 * self._longest, 2 * short)
        return [short, float(np.sqrt(short * long)), long]

    def noises(self) -> list[np.ndarray]:
        """White noises to begin with: of the residuals, and of neighbouring samples."""
        scatter = self.scatter / np.max(self.scatter, axis=0)
        largest = np.minimum(np.max(self.scatter, axis=0), np.max(self.plain, axis=0))
        lower = scatter * largest
        known = [k for k in range(lower.shape[1]) if k not in self.channels]
        lower[:, known] = self.plain[:, known]
        return [lower, self.plain]

    def rates(self) -> np.ndarray:
        """Typical rate of every state, (n_states,)."""
        rates = self.problem.grid.rates(self.problem.nodes)
        typical: np.ndarray = np.sqrt(np.mean(rates**2, axis=0))
        return np.maximum(typical, TINY ** (1 / 4))

    def _force_starts(self) -> list[Disturbances]:
        starts = []
        for sigma in self.noises():
            for time in self.first_times():
                for share in FORCE_SHARES:
                    starts.append(Disturbances(sigma, self._forces(share, time)))
        return starts if self.problem.forced else []

    def _sensor_starts(self) -> list[Disturbances]:
        starts = []
        for sigma in self.noises():
            for time in self.first_times():
                sensors = self._sensors(0.7, time)  # of the residuals
                starts.append(Disturbances(sigma, sensors=sensors))
        return starts

    def _forces(self, share: float, time: float) -> tuple[Process, ...]:
        rates = self.rates()
        forces = []
        for equation in self.problem.forced:
            forces.append(Process(equation, share * float(rates[equation]), time))
        return tuple(forces)

    def _sensors(self, share: float, time: float) -> tuple[Process, ...]:
        sensors = []
        for channel in np.unique(self.problem.channel).tolist():
            size = share * float(np.mean(self.plain[:, channel]))
            sensors.append(Process(channel, size, time))
        return tuple(sensors)

    def _with_the_other_kind(self, found: Disturbances) -> list[Disturbances]:
        """The disturbances beside a little of the kind that is not among them."""
        starts = []
        for time in self.first_times():
            if found.forces:
                sensors = self._sensors(FORCE_SHARES[0], time)
                starts.append(replace(found, sensors=sensors))
                continue
            forces = self._forces(FORCE_SHARES[-1], time)
            starts.append(replace(found, forces=forces))
        return starts if found.forces or self.problem.forced else []

    def _chosen_functions(self, beside: Disturbances) -> tuple[StateFunction, ...]:
        """Functions that the evidence asks for beside other disturbances."""
        candidates = self._function_candidates()
        if not candidates:
            return ()
        with_all = replace(beside, functions=candidates)
        border = self.likelihood(with_all).at(with_all).border
        sizes = _chosen_sizes(border, self._rates_of(candidates))
        chosen = []
        for candidate, size in zip(candidates, sizes, strict=True):
            if size > 0:
                chosen.append(replace(candidate, size=float(size)))
        return tuple(chosen)

    def _function_candidates(self) -> tuple[StateFunction, ...]:
        """The functions that are tried, as large as the typical rate.

        None where they have more than 80 columns beside the parameters: each costs as
        much as one more parameter.
        """
        problem = self.problem
        rates = self.rates()
        candidates = []
        n_columns = 0
        for equation in problem.forced:
            for state in problem.observed:
                n_functions = problem.function_values[state].shape[1]
                if n_functions:
                    size = float(rates[equation])
                    candidates.append(StateFunction(equation, state, size))
                    n_columns += n_functions
        return tuple(candidates) if n_columns <= 80 else ()

    def _rates_of(self, functions: Sequence[StateFunction]) -> np.ndarray:
        """Typical rate in the equation of each function, (n_functions,)."""
        return self.rates()[[function.equation for function in functions]]


def _log_evidence(likelihood: MarginalLikelihood, disturbances: Disturbances) -> float:
    """Of disturbances; minus infinity where no states follow."""
    try:
        value = likelihood.at(disturbances).log_evidence
    except (SolveError, np.linalg.LinAlgError):
        return -np.inf
    return value if np.isfinite(value) else -np.inf


def _chosen_sizes(border: Border, rates: np.ndarray) -> np.ndarray:
    """Sizes of functions that the evidence asks for, (n_functions,); 0: left out.

    One after the other; each time the one whose size, or change of size, gains most.

    Args:
        border: with all functions.
        rates: (n_functions,) typical rate in the equation of each.
    """
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
