"""The marginal likelihood of a linearised record, and its solver.

Where measurements are linear in states, parameters and disturbances, all of them are
Gaussian, and what is not known can be integrated out in closed form: the parameters and
starting states as well, with flat priors, so that the sizes of the disturbances are not
taken too small because the parameters followed them (restricted maximum likelihood;
Patterson and Thompson, Biometrika 58, 1971)::

    K = [ A   J' ]      A: information of data and priors, J: slopes of the dynamics,
        [ J   -Q ]      Q: variance of a white force; zero where the dynamics hold

In the order of time K is banded; parameters and the coefficients of functions of states
are its border. `MarginalLikelihood` knows the pattern, `OptimalitySystem` is factorised
and answers: evidence, estimate, covariance, response, and solutions for further data.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, hstack

from phsi_opt.errors import SolveError
from phsi_opt.model_error.disturbances import Disturbances, Process, Whitener
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.optimization.banded import FEWEST_STATES, Banded, BandLayout, Chained
from phsi_opt.optimization.bounded_step import (
    ANY_ROOM,
    REGULAR,
    RIDGE,
    Room,
    bounded_step,
)
from phsi_opt.statistics import TINY

EVERY = slice(None)
NOTHING_HELD = np.zeros(0, dtype=int)
LOST_TO_ROUNDING = (
    "the information about the parameters is lost in rounding errors: noise and "
    "model error differ too much in size."
)


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Everything unknown, where the linearised record makes it most likely."""

    # (n_theta,) step of the scaled parameters; zero for those that are held.
    theta: np.ndarray
    x: np.ndarray  # (n_nodes, n_states) step of the scaled states
    processes: np.ndarray  # (n_inner,) values of all processes, forces first
    coefficients: np.ndarray  # (n_coefficients,) of the functions of states
    multipliers: np.ndarray  # (n_intervals * n_states,) of the dynamics


@dataclass(frozen=True, eq=False)
class Border:
    """The likelihood in parameters and function coefficients, all else integrated out.

    ::

        misfit = constant - 2 gradient'b + b' information b
    """

    # (n, n), of parameters, then coefficients of functions of size one.
    information: np.ndarray
    gradient: np.ndarray  # (n,)
    constant: float  # sum of squares without them
    log_constant: float  # part of the log evidence that does not depend on them
    n_theta: int  # number of parameters
    # Number of the function that a coefficient belongs to, after the parameters;
    # (n_coefficients,).
    owner: np.ndarray
    sizes: np.ndarray  # (n_functions,) of the functions
    of_theta: np.ndarray  # (n_theta,) information by the parameters' own priors

    @classmethod
    def sum(cls, borders: Sequence["Border"]) -> "Border":
        """Of several records together."""
        total, *others = borders
        for border in others:
            total = replace(
                total,
                information=total.information + border.information,
                gradient=total.gradient + border.gradient,
                constant=total.constant + border.constant,
                log_constant=total.log_constant + border.log_constant,
            )
        return total

    def tilted(self, slope: np.ndarray) -> "Border":
        """With a further term of the log likelihood, of this slope in the parameters.

        A parameter goes no further than by its own scale where the record says little.
        """
        n = self.n_theta
        most = np.diag(self.information)[:n]
        gradient = self.gradient.copy()
        gradient[:n] += np.clip(slope, -most, most)
        return replace(self, gradient=gradient)

    @property
    def prior(self) -> np.ndarray:
        """Information by the priors of parameters and coefficients, a ridge, (n,)."""
        prior = np.full(len(self.gradient), RIDGE)
        prior[: self.n_theta] += self.of_theta
        prior[self.n_theta :] = 1 / self.sizes[self.owner] ** 2
        return prior

    @cached_property
    def precision(self) -> np.ndarray:
        """Information with that of the priors, (n, n).

        Raises:
            SolveError: it is not finite.
        """
        precision: np.ndarray = self.information + np.diag(self.prior)
        if not np.all(np.isfinite(precision)):
            raise SolveError(LOST_TO_ROUNDING)
        return precision

    @cached_property
    def estimate(self) -> np.ndarray:
        """The most likely parameters and coefficients, (n,)."""
        return solve_border(self.precision, self.gradient)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Of all of them, (n, n)."""
        return solve_border(self.precision, np.eye(len(self.gradient)))

    @property
    def log_prior(self) -> float:
        """Logarithm of the normalisation of the coefficients' prior."""
        return -float(np.sum(np.log(self.sizes[self.owner])))

    @property
    def log_evidence(self) -> float:
        """Logarithm of the marginal likelihood, parameters integrated out as well.

        With flat priors of the starting states in their units and of the scaled
        parameters; without the factor 2 pi of each value and unknown.

        Raises:
            SolveError: rounding has made the information indefinite.
        """
        misfit = self.constant - self.gradient @ self.estimate
        sign, log_det = np.linalg.slogdet(self.precision)
        if sign <= 0:
            raise SolveError(LOST_TO_ROUNDING)
        return float(self.log_constant - (misfit + log_det) / 2 + self.log_prior)

    def gains_by_function(self, number: int, tried: np.ndarray) -> np.ndarray:
        """Gains of the log evidence by one function and the others, (n_tried,).

        Args:
            number: of the function. Others whose size is zero are not there.
            tried: its sizes, (n_tried,); of zero it gains nothing.
        """
        is_own = np.r_[np.full(self.n_theta, -1), self.owner] == number
        with np.errstate(divide="ignore"):  # of those that are not there
            prior = np.where(is_own, 0.0, self.prior)
        own = np.flatnonzero(is_own)
        others = np.flatnonzero(~is_own & np.isfinite(prior))
        precision = self.information + np.diag(prior)
        schur, gradient, _ = _without(precision, self.gradient, own, others)
        values, vectors = np.linalg.eigh(schur)
        ratios = np.maximum(values, 0.0)[:, None] * tried**2
        pulls = ((vectors.T @ gradient)[:, None] * tried) ** 2
        gains: np.ndarray = np.sum(pulls / (1 + ratios) - np.log1p(ratios), axis=0) / 2
        return gains

    def step(
        self, damping: float, room: Room, silent: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The best step of parameters, and of coefficients.

        Arguments as those of `OptimalitySystem.smoothed`.
        """
        places = np.arange(len(self.gradient))
        theta, others = places[: self.n_theta], places[self.n_theta :]
        schur, pull, through = _without(self.precision, self.gradient, theta, others)
        schur = schur + damping * np.diag(np.abs(np.diag(schur)))
        best = bounded_step(schur, pull, room, silent)
        return best, through[:, -1] - through[:, :-1] @ best


def _without(
    matrix: np.ndarray, right: np.ndarray, own: np.ndarray, others: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Schur complement and right side of own unknowns, and the others' solutions."""
    mixed = matrix[np.ix_(others, own)]
    inner = matrix[np.ix_(others, others)]
    through = solve_border(inner, np.c_[mixed, right[others]])
    schur = matrix[np.ix_(own, own)] - mixed.T @ through[:, :-1]
    return schur, right[own] - mixed.T @ through[:, -1], through


def _numbered(matrix: Any) -> csc_matrix:
    """A matrix that has the numbers of its entries in their place."""
    numbers = matrix.copy()
    numbers.data = np.arange(matrix.nnz)
    return csc_matrix(numbers)


class MarginalLikelihood:
    """The marginal likelihood of a linearised record for disturbances of one structure.

    Args:
        problem: the linearised record.
        disturbances: which there are; their sizes do not matter.
        moving: (n_moving,) places of the parameters that are free to move.

    Attributes:
        sites: where processes act, forces first.
        places: of the values of every process among the unknowns.
        n_unknowns: number of states at all nodes and of values of processes.
        effects: what processes do to data and dynamics, sparse.
        shown: slope of the measured values in states and processes, sparse.
        shown_transposed: the same, transposed.
        border_in_shown: (n_values, n_border), in parameters and coefficients.
        border_in_dynamics: (n_intervals * n_states, n_border).
        owner: number of the function that each coefficient belongs to.
    """

    def __init__(
        self, problem: Linearization, disturbances: Disturbances, moving: np.ndarray
    ) -> None:
        self.problem = problem
        self.moving = moving
        self._functions = [(f.equation, f.state) for f in disturbances.functions]
        self.sites = problem.sites(disturbances)
        empty = csc_matrix((problem.n_values + len(problem.offset), 0))
        self.effects = csc_matrix(hstack([empty, *(one.effects for one in self.sites)]))
        self._set_layout()
        self._set_slopes()
        self._set_border()

    def relinearized(
        self, problem: Linearization, moving: np.ndarray | None = None
    ) -> "MarginalLikelihood":
        """The same for other values of a record, and slopes of the same pattern.

        Args:
            problem: the record; slopes that are the same object are kept.
            moving: parameters that are free to move; None: as before.
        """
        other = copy(self)
        other.problem = problem
        is_new = problem.dynamics_in_states is not self.problem.dynamics_in_states
        if is_new:
            other._set_slopes()
        if moving is not None and not np.array_equal(moving, self.moving):
            other.moving = moving
            is_new = True
        if is_new:
            other._set_border()
        return other

    def with_moving(self, moving: np.ndarray) -> "MarginalLikelihood":
        """The same where other parameters are free to move."""
        return self.relinearized(self.problem, moving)

    def _set_layout(self) -> None:
        """Places of all entries, in the order in which `_entries` has them."""
        problem, grid = self.problem, self.problem.grid
        of_values = self.effects[: problem.n_values]
        of_dynamics = self.effects[problem.n_values :]
        self._of_processes = of_values.data, of_dynamics.data
        dynamics = coo_matrix(hstack([problem.dynamics_in_states, of_dynamics]))
        shown = hstack([_numbered(problem.shown_in_states), _numbered(of_values)])
        self._shown = shown = csr_matrix(shown)
        # Entries of processes come behind those of states.
        shown.data[shown.indices >= problem.nodes.size] += problem.shown_in_states.nnz
        self.n_unknowns = n = shown.shape[1]
        below = n + dynamics.row
        self._set_pairs(shown)
        rows = [below, dynamics.col, shown.indices[self._one]]
        columns = [dynamics.col, below, shown.indices[self._other]]
        every_state = np.arange(problem.nodes.size)
        rows.append(every_state)
        columns.append(every_state)
        self.places = []
        first = problem.nodes.size
        for site in self.sites:
            on_diagonal = first + np.arange(len(site.t))
            after, before = on_diagonal[1:], on_diagonal[:-1]
            # Nothing joins trajectories; places for it would widen the band.
            joins = np.diff(site.trajectory) == 0
            before = np.where(joins, before, after)
            rows += [on_diagonal, after, before]
            columns += [on_diagonal, before, after]
            self.places.append(slice(first, first + len(site.t)))
            first += len(site.t)
        if problem.softness is not None:
            multipliers = n + np.arange(len(problem.softness))
            rows.append(multipliers)
            columns.append(multipliers)
        if problem.curvature is not None:
            upper = problem.curvature.of_states
            rows += [upper.row, upper.col]
            columns += [upper.col, upper.row]
        # Node, or middle between two, of every unknown and multiplier.
        of_state = np.repeat(np.arange(grid.n_nodes, dtype=float), problem.n_states)
        of_multiplier = np.repeat(grid.begin + 0.5, problem.n_states)
        of_process = [site.place for site in self.sites]
        place = np.concatenate([of_state, *of_process, of_multiplier])
        self._run_of_unknown = grid.trajectory[place.astype(int)]
        self._layout = BandLayout(
            np.concatenate(rows),
            np.concatenate(columns),
            np.argsort(place, kind="stable"),
            is_symmetric=True,
        )
        is_bare = problem.softness is None and problem.curvature is None
        has_diagonal = np.array_equal(self._one, self._other)  # C' W C
        is_larger = problem.n_states >= FEWEST_STATES
        self._may_chain = is_larger and is_bare and has_diagonal and not self.sites

    def _set_pairs(self, shown: csr_matrix) -> None:
        """Pairs of entries in one row of C, whose products make C' W C."""
        n_in_row = np.diff(shown.indptr)
        row = np.repeat(np.arange(shown.shape[0]), n_in_row)
        n_partners = n_in_row[row]
        self._one = np.repeat(np.arange(len(row)), n_partners)
        self._row = row[self._one]
        before = np.cumsum(n_partners) - n_partners
        number = np.arange(len(self._one)) - np.repeat(before, n_partners)
        self._other = shown.indptr[self._row] + number

    def _set_slopes(self) -> None:
        problem, layout = self.problem, self._shown
        of_values, of_dynamics = self._of_processes
        entries = np.concatenate([problem.shown_in_states.data, of_values])
        entries = entries[layout.data]
        self.shown = csr_matrix((entries, layout.indices, layout.indptr), layout.shape)
        self.shown_transposed = self.shown.T
        self._products = self.shown.data[self._one] * self.shown.data[self._other]
        self._slopes = np.concatenate([problem.dynamics_in_states.data, of_dynamics])

    def _set_border(self) -> None:
        problem = self.problem
        in_dynamics = [problem.dynamics_in_theta[:, self.moving]]
        owner = []
        for number, (equation, state) in enumerate(self._functions):
            columns = problem.dynamics_of_function(equation, state)
            in_dynamics.append(columns)
            owner += [number] * columns.shape[1]
        self.border_in_dynamics = np.hstack(in_dynamics)
        self.owner = np.array(owner, dtype=int)
        in_shown = np.zeros((problem.n_values, self.border_in_dynamics.shape[1]))
        in_shown[:, : len(self.moving)] = problem.shown_in_theta[:, self.moving]
        self.border_in_shown = in_shown

    def whiteners(self, disturbances: Disturbances) -> list[Whitener]:
        """Of every process, forces first, of size one."""
        pairs = zip(self.sites, disturbances.processes, strict=True)
        return [site.whitener(process.time) for site, process in pairs]

    def innovations(
        self, processes: np.ndarray, disturbances: Disturbances
    ) -> np.ndarray:
        """Values of all processes (n_inner, ...) as standard normals."""
        found = np.zeros(processes.shape)
        first = self.problem.nodes.size
        for places, process, whitener in zip(
            self.places,
            disturbances.processes,
            self.whiteners(disturbances),
            strict=True,
        ):
            own = slice(places.start - first, places.stop - first)
            found[own] = whitener.whitened(processes[own]) / process.size
        return found

    def at(
        self,
        disturbances: Disturbances,
        regular: float = 0.0,
        held: np.ndarray = NOTHING_HELD,
    ) -> "OptimalitySystem":
        """The system for disturbances with their sizes, factorised.

        Args:
            disturbances: of this structure.
            regular: share of the largest curvature that is added to every state's, for
                a point at which one has none.
            held: places of states, (n_held,) among all, that do not move.

        Raises:
            SolveError: the states do not follow from the data.
        """
        problem = self.problem
        weights = 1 / problem.of_values(disturbances.sigma)
        log_noise = float(np.sum(np.log(weights)))
        weights = weights**2
        whiteners = self.whiteners(disturbances)
        curvature = self._products * weights[self._row]
        largest = np.max(curvature)
        shift = np.full(problem.nodes.size, regular * largest)
        shift[held] = 1e9 * largest
        entries = [self._slopes, self._slopes, curvature, shift]
        log_prior = 0.0
        for process, whitener in zip(disturbances.processes, whiteners, strict=True):
            diagonal, below = (part / process.size**2 for part in whitener.precision)
            entries += [diagonal, below, below]
            log_prior += whitener.log_det - len(diagonal) * np.log(process.size)
        if problem.softness is not None:
            entries.append(-problem.softness)
        if problem.curvature is not None:
            upper = problem.curvature.of_states
            below = np.where(upper.row < upper.col, upper.data, 0.0)
            entries += [upper.data, below]
        chained = self._chained(curvature, shift) if self._may_chain else None
        factors = chained or Banded(self._layout, np.concatenate(entries))
        right = self._right(weights)
        return OptimalitySystem(
            likelihood=self,
            disturbances=disturbances,
            weights=weights,
            whiteners=whiteners,
            factors=factors,
            log_constant=log_noise + log_prior - factors.log_abs_det / 2,
            right=right,
            solved=factors.solve(right),
        )

    def _chained(self, curvature: np.ndarray, shift: np.ndarray) -> Chained | None:
        """Factors by the states' own curvature; None where the band serves."""
        own = self.shown.indices[self._one]
        diagonal = np.bincount(own, curvature, minlength=len(shift)) + shift
        nodes = self.problem.nodes
        slopes = csr_matrix(self.problem.dynamics_in_states)
        return Chained.of(
            slopes, self.problem.grid.begin, diagonal.reshape(nodes.shape)
        )

    def _right(self, weights: np.ndarray) -> np.ndarray:
        """Right-hand sides of each column of the border, and of the data."""
        problem = self.problem
        n, n_border = self.n_unknowns, self.border_in_dynamics.shape[1]
        n_theta = len(self.moving)
        # Column after column in memory, as it is solved for.
        right = np.zeros((n + len(problem.offset), n_border + 1), order="F")
        in_theta = weights[:, None] * self.border_in_shown[:, :n_theta]
        right[:n, :n_theta] += self.shown_transposed @ in_theta
        right[n:, :n_border] = self.border_in_dynamics
        if problem.curvature is not None:
            mixed = problem.curvature.mixed[:, self.moving]
            right[: len(mixed), :n_theta] += mixed
        right[:, n_border] = self.right_of_data(weights)
        return right

    def right_of_data(self, weights: np.ndarray) -> np.ndarray:
        """Right-hand side of the measured values, (n_unknowns + n_dynamics,)."""
        of_values = self.shown_transposed @ (weights * self.problem.residual)
        return np.concatenate([of_values, -self.problem.offset])


@dataclass(frozen=True, eq=False)
class OptimalitySystem:
    """The factorised system K of a linearised record under given disturbances.

    What it asks of numbers comes when a property is asked for: SolveError where the
    information is lost to rounding.
    """

    likelihood: MarginalLikelihood  # of the record
    disturbances: Disturbances  # with their sizes
    weights: np.ndarray  # (n_values,) one over the noise variance
    whiteners: list[Whitener]  # of the processes, forces first, of size one
    factors: Banded | Chained  # of the matrix of unknowns and multipliers
    # Part of the log evidence that depends neither on the border nor on the volume of
    # the states.
    log_constant: float
    # (n_unknowns + n_dynamics, n_border + 1) right-hand sides, the last of the data.
    right: np.ndarray
    solved: np.ndarray  # in the same shape

    @property
    def problem(self) -> Linearization:
        return self.likelihood.problem

    @property
    def _in_shown(self) -> np.ndarray:
        """Slopes of the measured values in the border, (n_values, n_border)."""
        return self.likelihood.border_in_shown[:, : self.right.shape[1] - 1]

    # --- Evidence and estimate

    @cached_property
    def _border(self) -> Border:
        """Without the constant of the log evidence, which costs a factorisation."""
        border = self._border_of(0.0)
        tilt = self.problem.tilt
        return border if tilt is None else border.tilted(tilt[self.likelihood.moving])

    @cached_property
    def border(self) -> Border:
        """States and processes integrated out."""
        log_constant = self.log_constant + self.problem.log_volume
        return replace(self._border, log_constant=log_constant)

    def borders_by_trajectory(self) -> list[Border]:
        """The border of every trajectory.

        The constant of the log evidence and the pull of priors are shared out evenly,
        and a tilt as the information about each parameter.
        """
        problem = self.problem
        run_of_value = problem.grid.run_of_value
        borders = []
        for run in range(problem.grid.n_trajectories):
            values = np.flatnonzero(run_of_value == run)
            unknowns = np.flatnonzero(self.likelihood._run_of_unknown == run)
            share = self.border.log_constant * len(values) / problem.n_values
            runs = problem.grid.n_trajectories
            borders.append(self._border_of(share, values, unknowns, 1 / runs))
        if problem.tilt is None:
            return borders
        n = len(self.likelihood.moving)
        own = np.array([np.diag(border.information)[:n] for border in borders])
        shares = own / (np.sum(own, axis=0) + TINY)
        slopes = problem.tilt[self.likelihood.moving] * shares
        pairs = zip(borders, slopes, strict=True)
        return [border.tilted(slope) for border, slope in pairs]

    def _border_of(
        self,
        log_constant: float,
        values: Any = EVERY,
        unknowns: Any = EVERY,
        share: float = 1.0,
    ) -> Border:
        """From some of the values, the unknowns that belong to them, and of priors."""
        likelihood, problem = self.likelihood, self.problem
        in_shown = self._in_shown[values]
        residual = problem.residual[values]
        products = self.right[unknowns].T @ self.solved[unknowns]
        n = in_shown.shape[1]
        weights = self.weights[values]
        weighted = weights[:, None] * in_shown
        information = in_shown.T @ weighted - products[:n, :n]
        k = len(likelihood.moving)
        if problem.curvature is not None:
            of_theta = problem.curvature.of_theta
            information[:k, :k] += of_theta[
                np.ix_(likelihood.moving, likelihood.moving)
            ]
        missed, of_theta = problem.prior[:, likelihood.moving]
        gradient = weighted.T @ residual - products[:n, n]
        gradient[:k] += share * of_theta * missed
        constant = np.sum(weights * residual**2) - products[n, n]
        return Border(
            information=(information + information.T) / 2,
            gradient=gradient,
            constant=float(constant + share * np.sum(of_theta * missed**2)),
            log_constant=log_constant,
            n_theta=k,
            owner=likelihood.owner[: n - k],
            sizes=self.disturbances.function_sizes,
            of_theta=of_theta,
        )

    @property
    def information(self) -> np.ndarray:
        """Of the border, states and processes integrated out, (n_border, n_border)."""
        border = self._border
        information = border.information.copy()
        places = np.arange(border.n_theta)
        information[places, places] += border.of_theta
        return information

    @property
    def log_evidence(self) -> float:
        return self.border.log_evidence

    @property
    def theta(self) -> np.ndarray:
        """Step of the scaled parameters that move to their estimate, (n_moving,)."""
        return self._border.estimate[: self._border.n_theta]

    @property
    def covariance(self) -> np.ndarray:
        """Of the scaled parameters that move, (n_moving, n_moving)."""
        n = self._border.n_theta
        return self._border.covariance[:n, :n]

    @property
    def log_likelihood(self) -> float:
        """Logarithm of the likelihood of the measurements at the best parameters.

        Disturbances and starting states are integrated out, with a flat prior of
        density one in the units of the states. Parameters are not, so that models with
        other parameters can be compared.
        """
        border = self.border
        inner = border.precision[border.n_theta :, border.n_theta :]
        log_det = np.linalg.slogdet(border.precision)[1] - np.linalg.slogdet(inner)[1]
        constant = self.n_free * np.log(2 * np.pi) / 2
        return float(border.log_evidence + log_det / 2 - constant)

    @property
    def n_free(self) -> int:
        """Number of values that starting states leave free."""
        problem = self.problem
        return problem.n_values - len(problem.grid.starts) * problem.n_states

    @property
    def log_model_evidence(self) -> float:
        """`log_likelihood`, less BIC's half log n for every parameter that is free.

        Differences between models of the same measurements are logarithms of Bayes
        factors (Schwarz, Annals of Statistics 6, 1978).
        """
        n_moving = len(self.likelihood.moving)
        price = n_moving * float(np.log(self.problem.n_values)) / 2
        return self.log_likelihood - price

    @property
    def response(self) -> np.ndarray:
        """How the estimate answers errors, (n_theta, n_values + n_dynamics + n_theta).

        Of measured values, of the dynamics with opposite sign, as `Site.effects` has
        them, and of the means of priors in their standard deviations.
        """
        n, n_theta = self.likelihood.n_unknowns, self._border.n_theta
        answers = self.solved[:, :-1]
        shown = self._in_shown - self.likelihood.shown @ answers[:n]
        of_priors = np.zeros((self.problem.n_theta, shown.shape[1]))
        of_priors[self.likelihood.moving, range(n_theta)] = np.sqrt(
            self._border.of_theta
        )
        both = np.vstack([self.weights[:, None] * shown, -answers[n:], of_priors])
        response = np.zeros((self.problem.n_theta, len(both)))
        response[self.likelihood.moving] = self._border.covariance[:n_theta] @ both.T
        return response

    # --- Solutions

    @cached_property
    def optimum(self) -> np.ndarray:
        """Unknowns and multipliers where they are most likely."""
        solved = self.solved
        optimum: np.ndarray = solved[:, -1] - solved[:, :-1] @ self._border.estimate
        return optimum

    @cached_property
    def residual(self) -> np.ndarray:
        """Measured values less what is shown there, (n_values,)."""
        return self.problem.residual - self.shown(self.optimum, self._border.estimate)

    @cached_property
    def projected_data(self) -> np.ndarray:
        """What `projected` gives for the data themselves, (n_values + n_dynamics,)."""
        multipliers = self.optimum[self.likelihood.n_unknowns :]
        return np.concatenate([self.weights * self.residual, -multipliers])

    def projected(self, shifts: np.ndarray) -> np.ndarray:
        """P times shifts of data and dynamics (n_values + n_dynamics, k).

        P is the inverse covariance of the data, unknown parameters and starting states
        projected out (Gilmour, Thompson and Cullis, Biometrics 51, 1995).
        """
        n_values, n = self.problem.n_values, self.likelihood.n_unknowns
        values = shifts[:n_values]
        answer, of_border = self.solve(values, shifts[n_values:])
        remaining = self.weights[:, None] * (values - self.shown(answer, of_border))
        return np.concatenate([remaining, -answer[n:]])

    def solve(
        self, values: np.ndarray, dynamics: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """How all that is unknown answers shifts, and the border.

        Args:
            values: (n_values, k).
            dynamics: (n_dynamics, k), of the data of the dynamics.
        """
        likelihood = self.likelihood
        n = likelihood.n_unknowns
        inner = np.empty((len(self.right), values.shape[1]), order="F")
        weighted = self.weights[:, None] * values
        inner[:n] = likelihood.shown_transposed @ weighted
        inner[n:] = dynamics
        answer = self.factors.solve(inner)
        pull = self._in_shown.T @ weighted - self.right[:, :-1].T @ answer
        of_border = solve_border(self._border.precision, pull)
        answer -= self.solved[:, :-1] @ of_border
        return answer, of_border

    def shown(self, answer: np.ndarray, of_border: np.ndarray) -> np.ndarray:
        """What sensors show of unknowns and border, (n_values,) or (n_values, k)."""
        likelihood = self.likelihood
        shown: np.ndarray = likelihood.shown @ answer[: likelihood.n_unknowns]
        return shown + self._in_shown @ of_border

    def smoothed(
        self, damping: float = 0.0, room: Room = ANY_ROOM, silent: float = 0.0
    ) -> Smoothed:
        """The most likely parameters, states and disturbances.

        Args:
            damping: share of each parameter's information that is added to it, for a
                shorter step.
            room: how far the parameters may move, (n_moving,).
            silent: information up to which parameters do not move.
        """
        theta, coefficients = self._border.step(damping, room, silent)
        border = np.concatenate([theta, coefficients])
        found = self.solved[:, -1] - self.solved[:, :-1] @ border
        problem, n = self.problem, self.likelihood.n_unknowns
        n_x = problem.nodes.size
        all_theta = np.zeros(problem.n_theta)
        all_theta[self.likelihood.moving] = theta
        return Smoothed(
            theta=all_theta,
            x=found[:n_x].reshape(problem.nodes.shape),
            processes=found[n_x:n],
            coefficients=coefficients,
            multipliers=found[n:],
        )

    def at_values(self, residual: np.ndarray, offset: np.ndarray) -> "OptimalitySystem":
        """For other values and offsets, where the slopes are the same."""
        problem = replace(self.problem, residual=residual, offset=offset)
        likelihood = self.likelihood.relinearized(problem)
        right, solved = self.right.copy("F"), self.solved.copy("F")
        right[:, -1] = likelihood.right_of_data(self.weights)
        solved[:, -1] = self.factors.solve(right[:, -1])
        return replace(self, likelihood=likelihood, right=right, solved=solved)

    def without_functions(self) -> "OptimalitySystem":
        """The same without any function of a state."""
        functions = slice(len(self.likelihood.moving), -1)
        return replace(
            self,
            disturbances=replace(self.disturbances, functions=()),
            right=np.delete(self.right, functions, axis=1),
            solved=np.delete(self.solved, functions, axis=1),
        )

    # --- States that follow the parameters, where noise is white

    @property
    def multipliers(self) -> np.ndarray:
        """Of the dynamics, (n_dynamics,), where the parameters stay."""
        return self.solved[self.likelihood.n_unknowns :, -1]

    @property
    def following(self) -> np.ndarray:
        """How the states follow a change of theta, (n_nodes, n_states, n_theta)."""
        shape = (*self.problem.nodes.shape, -1)
        return -self.solved[: self.problem.nodes.size, :-1].reshape(shape)

    def start_covariances(self) -> np.ndarray:
        """Covariance of each node's states when theta is known.

        It is that of the starting states, carried along the trajectory.
        (n_nodes, n_states, n_states).
        """
        grid, n = self.problem.grid, self.problem.n_states
        starts = grid.starts[:, None] * n + np.arange(n)
        unit = np.zeros((self.factors.n, n))
        # One column serves all starts: what follows one touches no other.
        unit[starts.ravel(), np.tile(np.arange(n), len(starts))] = 1.0
        columns = self.factors.solve(unit)[: self.problem.nodes.size]
        at_start = columns[starts.ravel()].reshape(len(starts), n, n)
        per_node = columns.reshape(-1, n, n)
        inverses = np.linalg.pinv(at_start, hermitian=True)
        return per_node @ inverses[grid.piece] @ per_node.transpose(0, 2, 1)


def white_system(linear: Linearization, sigma: np.ndarray) -> OptimalitySystem:
    """The system of all parameters under white noise (n_states,) alone.

    Raises:
        SolveError: the states do not follow from the parameters and the data.
    """
    noise = Disturbances(np.tile(sigma, (linear.grid.n_trajectories, 1)))
    likelihood = MarginalLikelihood(linear, noise, np.arange(linear.n_theta))
    return likelihood.at(noise, REGULAR)


@dataclass(frozen=True, eq=False)
class ForcePosterior:
    """The forces given the measurements and the parameters."""

    likelihood: MarginalLikelihood  # of the linearised record; no parameter moves in it
    disturbances: Disturbances  # with their sizes, forces among them
    most_solved: float = 3e7  # numbers that are held at once: 240 MB

    @cached_property
    def _system(self) -> OptimalitySystem:
        return self.likelihood.at(self.disturbances)

    @property
    def _forces(self) -> list[tuple[Process, slice, Whitener]]:
        """Every force with the places of its values and the whitener of its prior."""
        parts = (self.disturbances.forces, self.likelihood.places)
        return list(zip(*parts, self._system.whiteners, strict=False))

    @property
    def log_evidence(self) -> float:
        """Logarithm of the marginal likelihood, up to a constant."""
        return self._system.log_evidence

    @property
    def mean(self) -> np.ndarray:
        """Of the forces, (n_intervals, n_forced)."""
        solved = self._system.solved[:, -1]
        return np.array([solved[places] for _, places, _ in self._forces]).T

    @cached_property
    def deviation(self) -> np.ndarray:
        """Standard deviation of the forces, (n_intervals, n_forced).

        It changes slowly, is solved for at 16 to 400 intervals, as many as fit in
        memory, and interpolated between.
        """
        most = int(np.clip(self.most_solved / len(self._system.right), 16, 400))
        n_intervals = self.likelihood.problem.grid.n_intervals
        evenly = np.linspace(0, n_intervals - 1, min(most, n_intervals))
        chosen = np.unique(evenly.astype(int))
        columns = np.arange(len(chosen))
        deviations = []
        for _, places, _ in self._forces:
            own = places.start + chosen
            units = self._zeros(len(chosen))
            units[own, columns] = 1.0
            variance = self._system.factors.solve(units)[own, columns]
            exact = np.sqrt(np.maximum(variance, 0.0))
            deviations.append(np.interp(np.arange(n_intervals), chosen, exact))
        return np.array(deviations).T

    @property
    def times_noise(self) -> np.ndarray:
        """Size of the forces over their typical (median) deviation, (n_forced,)."""
        size = np.sqrt(np.mean(self.mean**2, axis=0))
        typical = np.median(self.deviation, axis=0)
        return np.asarray(size / np.maximum(typical, TINY))

    def shown(self, number: int, forces: np.ndarray) -> np.ndarray:
        """What the mean would show of forces in one equation, (n_intervals, k).

        It is less than they are by what noise and prior hide::

            w_shown = w - C P^-1 w

        with the forces' covariance P before and C after the measurements.

        Args:
            number: of the equation among those with a force.
            forces: (n_intervals, k).
        """
        force, places, whitener = self._forces[number]
        n_forces = forces.shape[1]
        n_parts = 1 + int(len(self._system.right) * n_forces / self.most_solved)
        shown = np.empty_like(forces)
        for part in np.array_split(np.arange(n_forces), n_parts):
            right = self._zeros(len(part))
            pulled = whitener.transposed(whitener.whitened(forces[:, part]))
            right[places] = pulled / force.size**2
            hidden = self._system.factors.solve(right)[places]
            shown[:, part] = forces[:, part] - hidden
        return shown

    def _zeros(self, n_columns: int) -> np.ndarray:
        return np.zeros((len(self._system.right), n_columns), order="F")


def solve_border(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The solution of a system in parameters and coefficients, as ``right``.

    Args:
        matrix: (n, n).
        right: (n,) or (n, k).

    Raises:
        SolveError: rounding has made it singular.
    """
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError as error:
        raise SolveError(LOST_TO_ROUNDING) from error
