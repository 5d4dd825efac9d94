"""Which prior of a model error is taken: compared by prediction, not by evidence alone.

A force that is free to last can explain whatever the model itself could: its evidence
is the higher the more it swallows, and the parameters that it leaves predict badly. So
several priors are estimated by evidence, each, and then judged by how the model alone,
with the parameters that a prior leads to, runs along parts of the record that were not
used; and by whether the parts agree about the parameters. Among the priors that
predict well the evidence chooses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.criteria import AGREEMENT_LEVEL, WORSE_PREDICTION
from phsi_opt.errors import SolveError
from phsi_opt.model_error.disturbance_search import DisturbanceSearch, Evidence
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import Border, MarginalLikelihood
from phsi_opt.model_error.processes import Process
from phsi_opt.statistics import TINY, chi_square_tail
from phsi_opt.transcription.grid import Grid

FEWEST_PARTS = 4  # of a record, for predictions of one from the others
SHORT_INTERVALS = 3.0  # correlation time of the short prior, in sampling intervals
UNKNOWN_FORCE_SHARE = (
    0.03  # of the typical rate, size of a force of which nothing is known
)
SMALL_SHARE = 0.1  # factor on the size of a force of which another has taken the place


@dataclass(frozen=True, eq=False)
class Prior:
    """A prior of the model error, with what speaks for it.

    Attributes:
        name: "white", "short", "lasting", "white and lasting", "orthogonal", "with
            functions of states".
        evidence: disturbances, and the logarithm of their marginal likelihood.
        prediction: root mean square of the free-run residuals, in standard deviations
            of the plain likelihood's noise, on every part with the parameters that the
            other parts lead to.
        agreement: p-value of the hypothesis that all parts have the same parameters.
        has_fixed_times: whether the times of its forces are given.
        is_chosen: whether it was taken.
    """

    name: str
    evidence: Evidence
    prediction: float
    agreement: float
    has_fixed_times: bool
    is_chosen: bool = False


def compared_priors(search: DisturbanceSearch, horizon: float | None) -> list[Prior]:
    """The priors, each with its sizes by evidence, one of them chosen.

    Args:
        search: of the linearised record.
        horizon: length in time of the parts whose runs are predicted; None: whole
            trajectories, or quarters where they are fewer than four. A longer one than
            that of a single trajectory means quarters too.

    Raises:
        SolveError: the states do not follow from the data.
    """
    parts = _Parts.of(search, horizon)
    priors = []
    for name, best, is_fixed in _candidates(search):
        judged = parts.judged(best.disturbances)
        priors.append(Prior(name, best, judged.prediction, judged.agreement, is_fixed))
    chosen = _chosen(priors)
    return [replace(prior, is_chosen=prior is chosen) for prior in priors]


def _candidates(search: DisturbanceSearch) -> list[tuple[str, Evidence, bool]]:
    """Name, best sizes, and whether times stay, of every prior.

    Errors of sensors that the record shows are beside each of them.
    """
    found = search.found().disturbances
    starts = _Starts(search, found)
    short = SHORT_INTERVALS * search.interval
    lasting = search.best_of(starts.at_times(search.first_times()))
    one = lasting.disturbances
    small = _scaled(starts.forces(search.shortest), SMALL_SHARE)
    both = [
        replace(one, forces=(*small, *one.forces)),
        replace(one, forces=(*starts.forces(search.shortest), *one.forces)),
    ]
    orthogonal = replace(one, is_orthogonal=True)
    candidates = [
        ("white", search.best_of(starts.at_times([search.shortest]), True), True),
        ("short", search.best_of(starts.at_times([short]), True), True),
        ("lasting", lasting, False),
        ("white and lasting", search.best_of(both), False),
    ]
    if len(search.moving):
        candidates.append(("orthogonal", search.best_of([orthogonal]), False))
    if found.functions:
        forces = found.forces or _scaled(one.forces, SMALL_SHARE)
        with_functions = search.best_of([replace(found, forces=forces)])
        candidates.append(("with functions of states", with_functions, False))
    return candidates


@dataclass(frozen=True, eq=False)
class _Starts:
    """Where the searches for the sizes of a prior begin.

    Attributes:
        search: of the record.
        found: what the record shows by evidence alone.
    """

    search: DisturbanceSearch
    found: Disturbances

    def at_times(self, times: Sequence[float]) -> list[Disturbances]:
        """Forces with each of these correlation times, as found and small."""
        starts = []
        for time in times:
            forces = self.forces(time)
            for factor in (1.0, SMALL_SHARE):
                scaled = _scaled(forces, factor)
                starts.append(replace(self.found, forces=scaled, functions=()))
        return starts

    def forces(self, time: float) -> tuple[Process, ...]:
        """A force per equation, as strong over long times as the one that was found."""
        rates = self.search.rates()
        sizes = {
            row: UNKNOWN_FORCE_SHARE * rates[row] for row in self.search.problem.forced
        }
        for force in self.found.forces:
            strength = np.sqrt(max(force.time / time, 1.0))
            sizes[force.place] = force.size * strength
        return tuple(Process(row, float(size), time) for row, size in sizes.items())


def _scaled(forces: Sequence[Process], factor: float) -> tuple[Process, ...]:
    return tuple(replace(force, size=factor * force.size) for force in forces)


@dataclass(frozen=True)
class _Judged:
    """What the parts of a record say about a prior."""

    prediction: float
    agreement: float


@dataclass(frozen=True, eq=False)
class _Parts:
    """A record in parts, and what the plain likelihood says of each.

    Attributes:
        problem: the linearised record, cut.
        moving: places of the free parameters.
        plain: of every part, as a function of the parameters, its squared free-run
            residuals in units of the plain noise.
        run: (n_parts,) trajectory that a part comes from.
    """

    problem: Linearization
    moving: np.ndarray
    plain: Sequence[Border]
    run: np.ndarray

    @classmethod
    def of(cls, search: DisturbanceSearch, horizon: float | None) -> "_Parts":
        whole = search.problem
        grid = whole.grid
        piece = grid.trajectory
        if horizon is not None:
            piece = _windows(grid, horizon)
        is_whole = piece[-1] == 0
        if is_whole or (horizon is None and whole.n_trajectories < FEWEST_PARTS):
            piece = whole.piece_numbers(FEWEST_PARTS)
        _, first = np.unique(piece, return_index=True)
        run = grid.trajectory[first]
        problem = whole.cut(piece)
        white = Disturbances(search.plain[run])
        likelihood = MarginalLikelihood(problem, white.structure, search.moving)
        try:
            plain = likelihood.borders_by_run(white)
        except SolveError as error:
            length = "" if horizon is None else f" of horizon={horizon:g}"
            raise SolveError(
                f"the states in parts{length} of the record do not follow from what "
                "was measured there, so that no prior of the model error can be judged "
                "by predictions; let the parts be longer."
            ) from error
        return cls(problem, search.moving, plain, run)

    def judged(self, whole: Disturbances) -> _Judged:
        """How the parts predict each other, and whether they agree."""
        disturbances = replace(whole, sigma=whole.sigma[self.run])
        likelihood = MarginalLikelihood(
            self.problem, disturbances.structure, self.moving
        )
        borders = likelihood.borders_by_run(disturbances)
        sizes = np.array([function.size for function in disturbances.functions])
        estimate = _estimate(borders, sizes)
        square = 0.0
        statistic = 0.0
        for number, plain in enumerate(self.plain):
            others = [b for k, b in enumerate(borders) if k != number]
            square += _squares(plain, _estimate(others, sizes))
            alone = _estimate([borders[number]], sizes)
            information = _information([borders[number]], sizes)
            difference = alone - estimate
            statistic += float(difference @ information @ difference)
        freedom = (len(borders) - 1) * len(self.moving)
        return _Judged(
            prediction=float(np.sqrt(max(square, 0.0) / self.problem.n_values)),
            agreement=chi_square_tail(statistic, freedom) if freedom else 1.0,
        )


def _windows(grid: Grid, horizon: float) -> np.ndarray:
    """Number of the window of every node, (n_nodes,).

    Every trajectory is cut evenly, so that no short rest is left at its end, into
    windows whose length is nearest to the horizon.
    """
    numbers = np.zeros(grid.n_nodes, dtype=int)
    first = 0
    for run in range(int(grid.trajectory[-1]) + 1):
        is_in = grid.trajectory == run
        elapsed = grid.t[is_in] - grid.t[is_in][0]
        n_windows = max(round(elapsed[-1] / horizon), 1)
        place = np.floor(elapsed * (n_windows / max(elapsed[-1], TINY))).astype(int)
        numbers[is_in] = first + np.minimum(place, n_windows - 1)
        first += n_windows
    return numbers


def _squares(plain: Border, theta: np.ndarray) -> float:
    """Squared residuals of a free run with these parameters."""
    linear = float(plain.gradient @ theta)
    return plain.constant - 2 * linear + float(theta @ plain.information @ theta)


def _estimate(borders: Sequence[Border], sizes: np.ndarray) -> np.ndarray:
    """Parameters that some parts lead to, (n_moving,)."""
    together = Border.sum(borders)
    information = together.with_priors(sizes)
    found: np.ndarray = np.linalg.lstsq(information, together.gradient)[0]
    return found[: together.n_theta]


def _information(borders: Sequence[Border], sizes: np.ndarray) -> np.ndarray:
    """Information about the parameters alone, (n_moving, n_moving)."""
    information = Border.sum(borders).with_priors(sizes)
    n = borders[0].n_theta
    if len(information) == n:
        return information
    across = information[:n, n:]
    inner = np.linalg.pinv(information[n:, n:], hermitian=True)
    left: np.ndarray = information[:n, :n] - across @ inner @ across.T
    return left


def _chosen(priors: Sequence[Prior]) -> Prior:
    """The largest evidence among the priors that predict well and whose parts agree.

    Every size and time that was estimated counts as one (Akaike 1974).
    """
    least = min(prior.prediction for prior in priors)
    good = [p for p in priors if p.prediction <= WORSE_PREDICTION * least]
    agreeing = [p for p in good if p.agreement > AGREEMENT_LEVEL]
    return max(agreeing or good, key=_evidence_less_size)


def _evidence_less_size(prior: Prior) -> float:
    coordinates = prior.evidence.coordinates
    n_estimated = len(coordinates.bounds) if coordinates is not None else 0
    return prior.evidence.log_evidence - n_estimated
