"""Which prior of a model error is taken: compared by prediction, not by evidence alone.

A force that is free to last can explain whatever the model itself could: its evidence is
the higher the more it swallows, and the parameters that it leaves predict badly. So
several priors are estimated by evidence, each, and then judged by how the model alone,
with the parameters that a prior leads to, runs along parts of the record that were not
used; and by whether the parts agree about the parameters. Among the priors that
predict well the evidence chooses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from phsi_opt.criteria import AGREEMENT_LEVEL, WORSE_PREDICTION
from phsi_opt.model_error.disturbance_search import DisturbanceSearch, Evidence
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import Border, MarginalLikelihood
from phsi_opt.model_error.processes import Process

FEWEST_PARTS = 4  # of a record, for predictions of one from the others
SHORT_INTERVALS = 3.0  # correlation time of the short prior, in sampling intervals


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
            trajectories, or quarters where they are fewer than four.

    Raises:
        SolveError: the states do not follow from the data.
    """
    found = search.found().disturbances
    parts = _Parts.of(search, horizon)
    priors = []
    for name, start, is_fixed in _starts(search, found):
        best = search.best_of(start, is_fixed)
        judged = parts.judged(best.disturbances)
        priors.append(Prior(name, best, judged.prediction, judged.agreement, is_fixed))
    chosen = _chosen(priors)
    return [replace(prior, is_chosen=prior is chosen) for prior in priors]


def _starts(
    search: DisturbanceSearch, found: Disturbances
) -> list[tuple[str, list[Disturbances], bool]]:
    """Name, starts, and whether times stay, of every prior."""
    noise = found.sigma
    beside = {"sensors": found.sensors}
    interval = search.interval
    short = SHORT_INTERVALS * interval
    sizes = _sizes(search, found)
    white = _forces(sizes, search.shortest)
    lasting = []
    for time in search.first_times():
        lasting.append(Disturbances(noise, _forces(sizes, time), **beside))
    long = search.first_times()[-1]
    both = (*white, *_forces(sizes, long))
    starts = [
        ("white", [Disturbances(noise, white, **beside)], True),
        ("short", [Disturbances(noise, _forces(sizes, short), **beside)], True),
        ("lasting", lasting, False),
        ("white and lasting", [Disturbances(noise, both, **beside)], False),
        ("orthogonal", [replace(one, is_orthogonal=True) for one in lasting], False),
    ]
    if found.functions:
        with_functions = found
        if not found.forces:
            with_functions = replace(found, forces=_forces(sizes, long))
        starts.append(("with functions of states", [with_functions], False))
    return starts


def _sizes(search: DisturbanceSearch, found: Disturbances) -> dict[int, float]:
    """Size of the force in every equation, to begin with."""
    rates = search.rates()
    sizes = {row: 0.01 * float(rates[row]) for row in search.problem.forced}
    for force in found.forces:
        sizes[force.place] = force.size
    return sizes


def _forces(sizes: dict[int, float], time: float) -> tuple[Process, ...]:
    return tuple(Process(row, size, time) for row, size in sizes.items())


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
            elapsed = grid.t - grid.t[grid.first][grid.trajectory]
            window = np.floor(elapsed / horizon).astype(int)
            changes = np.diff(grid.trajectory, prepend=grid.trajectory[0]) != 0
            changes |= np.diff(window, prepend=window[0]) != 0
            piece = np.cumsum(changes)
        elif whole.n_trajectories < FEWEST_PARTS:
            piece = whole.piece_numbers(FEWEST_PARTS)
        _, first = np.unique(piece, return_index=True)
        run = grid.trajectory[first]
        problem = whole.cut(piece)
        white = Disturbances(search.plain[run])
        likelihood = MarginalLikelihood(problem, white.structure, search.moving)
        return cls(problem, search.moving, likelihood.borders_by_run(white), run)

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
            agreement=float(chi2.sf(statistic, freedom)),
        )


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
