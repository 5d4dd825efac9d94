"""How likely measurements are under disturbances, whatever they and the states were.

At a solution the measurements are taken as linear in states, parameters and
disturbances. All of them are then Gaussian, and what is not known can be integrated out
in closed form: the parameters and starting states as well, with flat priors, so that
the sizes of the disturbances are not taken too small because the parameters followed
them (restricted maximum likelihood; Patterson and Thompson, Biometrika 58, 1971). In
the order of time the matrix is banded; parameters and functions of states are its
border.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, hstack

from phsi_opt.errors import SolveError
from phsi_opt.model_error.disturbances import Disturbances, Process, Structure, Whitener
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.optimization.banded import Banded, Chain, Chained, TimeLayout
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
    "the information about the parameters is lost to rounding: noise and model error "
    "are too far apart in size."
)


@dataclass(frozen=True, eq=False)
class Marginal:
    """What measurements say under given disturbances.

    Attributes:
        log_evidence: logarithm of the marginal likelihood, with flat priors of the
            starting states in their units and of the scaled parameters; without the
            factor 2 pi of each value and unknown.
        theta: (n_theta,) step of the scaled parameters to their estimate.
        covariance: (n_theta, n_theta) of the scaled parameters.
        border: (n_border,) the step of the parameters, then coefficients of functions.
    """

    log_evidence: float
    theta: np.ndarray
    covariance: np.ndarray
    border: np.ndarray


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Everything unknown, where the linearised record makes it most likely.

    Attributes:
        theta: (n_theta,) step of the scaled parameters; zero for those that are held.
        x: (n_nodes, n_states) step of the scaled states.
        processes: (n_inner,) values of all processes, forces first.
        coefficients: (n_coefficients,) of the functions of states.
        multipliers: (n_intervals * n_states,) of the dynamics.
    """

    theta: np.ndarray
    x: np.ndarray
    processes: np.ndarray
    coefficients: np.ndarray
    multipliers: np.ndarray


@dataclass(frozen=True, eq=False)
class Border:
    """The parameters and function coefficients, once states and processes are gone.

    ::

        misfit = constant - 2 gradient'b + b' information b

    Attributes:
        information: (n, n), of parameters, then coefficients of functions of size one.
        gradient: (n,).
        constant: sum of squares without them.
        log_evidence: all that does not depend on them.
        n_theta: number of parameters.
        owner: number of the function that a coefficient belongs to, after the
            parameters; (n_coefficients,).
    """

    information: np.ndarray
    gradient: np.ndarray
    constant: float
    log_evidence: float
    n_theta: int
    owner: np.ndarray

    @classmethod
    def sum(cls, borders: Sequence["Border"]) -> "Border":
        """What several records say together."""
        first = borders[0]
        return replace(
            first,
            information=np.sum([border.information for border in borders], axis=0),
            gradient=np.sum([border.gradient for border in borders], axis=0),
            constant=sum(border.constant for border in borders),
            log_evidence=sum(border.log_evidence for border in borders),
        )

    def tilted(self, slope: np.ndarray) -> "Border":
        """Beside a logarithm that rises by this slope in parameters, (n_theta,).

        What the record says little of goes no further than by its own scale.
        """
        told = np.diag(self.information)[: self.n_theta]
        gradient = self.gradient.copy()
        gradient[: self.n_theta] += np.clip(slope, -told, told)
        return replace(self, gradient=gradient)

    def with_priors(self, sizes: np.ndarray) -> np.ndarray:
        """Information with that of functions of these sizes, (n_functions,).

        Raises:
            SolveError: it is not finite.
        """
        precision = np.zeros(len(self.gradient))
        precision[: self.n_theta] = RIDGE
        coefficients = slice(self.n_theta, self.n_theta + len(self.owner))
        precision[coefficients] = 1 / sizes[self.owner] ** 2
        information: np.ndarray = self.information + np.diag(precision)
        if not np.all(np.isfinite(information)):
            raise SolveError(LOST_TO_ROUNDING)
        return information

    def gains_by_function(
        self, number: int, tried: np.ndarray, sizes: np.ndarray
    ) -> np.ndarray:
        """Gains of the log evidence by one function beside others, (n_tried,).

        Args:
            number: of the function.
            tried: its sizes, (n_tried,); of zero it gains nothing.
            sizes: (n_functions,) of the others; zero: not there.
        """
        place = np.arange(len(self.owner))
        own = self.n_theta + place[self.owner == number]
        is_other = (self.owner != number) & (sizes[self.owner] > 0)
        others = np.r_[np.arange(self.n_theta), self.n_theta + place[is_other]]
        precision = np.full(len(others), RIDGE)
        precision[self.n_theta :] = 1 / sizes[self.owner[is_other]] ** 2
        inner = self.information[np.ix_(others, others)] + np.diag(precision)
        mixed = self.information[np.ix_(others, own)]
        through = solve_border(inner, mixed)
        left = self.information[np.ix_(own, own)] - mixed.T @ through
        gradient = self.gradient[own] - through.T @ self.gradient[others]
        values, vectors = np.linalg.eigh(left)
        told = np.maximum(values, 0.0)[:, None] * tried**2
        pulls = ((vectors.T @ gradient)[:, None] * tried) ** 2
        gains: np.ndarray = np.sum(pulls / (1 + told) - np.log1p(told), axis=0) / 2
        return gains

    def step(
        self, sizes: np.ndarray, damping: float, room: Room, silent: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The best step of parameters, and of coefficients.

        Arguments as those of `MarginalLikelihood.smoothed`.

        Raises:
            SolveError: rounding has made the information indefinite.
        """
        information = self.with_priors(sizes)
        n = self.n_theta
        mixed = information[:n, n:]
        through = solve_border(information[n:, n:], np.c_[mixed.T, self.gradient[n:]])
        left = information[:n, :n] - mixed @ through[:, :n]
        left = left + damping * np.diag(np.abs(np.diag(left)))
        pull = self.gradient[:n] - mixed @ through[:, n]
        best = bounded_step(left, pull, room, silent)
        return best, through[:, n] - through[:, :n] @ best

    def marginal(self, sizes: np.ndarray) -> Marginal:
        """With functions of these sizes, (n_functions,).

        Raises:
            SolveError: rounding has made the information indefinite.
        """
        information = self.with_priors(sizes)
        found = solve_border(information, self.gradient)
        misfit = self.constant - self.gradient @ found
        sign, log_det = np.linalg.slogdet(information)
        if sign <= 0:
            raise SolveError(LOST_TO_ROUNDING)
        log_prior = -np.sum(np.log(sizes[self.owner]))
        covariance = solve_border(information, np.eye(len(information)))
        n = self.n_theta
        return Marginal(
            log_evidence=float(self.log_evidence - (misfit + log_det) / 2 + log_prior),
            theta=found[:n],
            covariance=covariance[:n, :n],
            border=found,
        )


@dataclass(frozen=True, eq=False)
class Response:
    """How an estimate answers errors, in the scale of the parameters.

    Attributes:
        to_dynamics: (n_theta, n_intervals * n_states), to an offset of the dynamics.
        to_values: (n_theta, n_values), to an error of a measured value.
    """

    to_dynamics: np.ndarray
    to_values: np.ndarray

    def over(self, share: float) -> "Response":
        """That of an estimate whose information is a share of what was taken."""
        return Response(self.to_dynamics / share, self.to_values / share)


class MarginalLikelihood:
    """The marginal likelihood of a linearised record for disturbances of one structure.

    Args:
        problem: the linearised record.
        structure: which disturbances there are.
        moving: (n_moving,) places of the parameters that are free to move.
        softness: (n_intervals * n_states,) variance by which the scaled dynamics may
            fail to hold, that of a white force; None: they hold.

    Attributes:
        n_unknowns: number of states at all nodes and of values of processes.
        shown: slope of the measured values in them, sparse.
        shown_transposed: the same, transposed.
        border_in_shown: (n_values, n_border), in parameters and coefficients.
        border_in_dynamics: (n_intervals * n_states, n_border).
    """

    def __init__(
        self,
        problem: Linearization,
        structure: Structure,
        moving: np.ndarray,
        softness: np.ndarray | None = None,
    ) -> None:
        self.problem = problem
        self.structure = structure
        self.moving = moving
        self._softness = np.zeros(0) if softness is None else softness
        self._set_layout()
        self._set_slopes()

    def relinearized(self, problem: Linearization) -> "MarginalLikelihood":
        """The same where slopes of the same pattern are others."""
        other = copy(self)
        other.problem = problem
        other._set_slopes()
        return other

    def with_softness(self, softness: np.ndarray | None) -> "MarginalLikelihood":
        """The same where the dynamics fail to hold by other variances."""
        other = copy(self)
        other._softness = np.zeros(0) if softness is None else softness
        return other

    def tilted(self, tilt: np.ndarray | None) -> "MarginalLikelihood":
        """The same beside a log likelihood with this slope in the parameters."""
        other = copy(self)
        other.problem = replace(self.problem, tilt=tilt)
        return other

    def with_moving(self, moving: np.ndarray) -> "MarginalLikelihood":
        """The same where other parameters are free to move."""
        if np.array_equal(moving, self.moving):
            return self
        other = copy(self)
        other.moving = moving
        other._set_border()
        return other

    def _set_slopes(self) -> None:
        """What the slopes of the record fill."""
        self.shown = self._shown_in_unknowns()
        self.shown_transposed = self.shown.T
        self._products = self._pairs.products(self.shown)
        slopes = coo_matrix(self.problem.dynamics_in_states).data
        dynamics = np.concatenate([slopes, self._slopes_of_forces])
        self._dynamics_entries = np.concatenate([dynamics, dynamics])
        self._set_border()

    @property
    def _curved_entries(self) -> list[np.ndarray]:
        """Of the curvature of the dynamics, both triangles."""
        if self.problem.curvature is None:
            return []
        upper = self.problem.curvature.of_states
        return [upper.data, np.where(upper.row < upper.col, upper.data, 0.0)]

    def _shown_in_unknowns(self) -> csr_matrix:
        """Slope of what is shown in states and processes."""
        problem = self.problem
        structure = self.structure
        if not structure.forces and not structure.sensors:
            return problem.shown_in_states
        n_values = problem.n_values
        blocks = [problem.shown_in_states]
        for _ in structure.forces:
            blocks.append(csr_matrix((n_values, problem.grid.n_intervals)))
        for channel in structure.sensors:
            values = problem.values_of(channel)
            column = np.arange(len(values))
            ones = np.ones(len(values))
            shape = (n_values, len(values))
            blocks.append(csr_matrix((ones, (values, column)), shape=shape))
        return csr_matrix(hstack(blocks))

    def _set_layout(self) -> None:
        """Places of all entries: dynamics, products of slopes, priors of processes."""
        problem = self.problem
        places = self.places_of_processes()
        slopes = coo_matrix(problem.dynamics_in_states)
        self.n_unknowns = slopes.shape[1] + sum(n for _, n in places)
        row, column = [slopes.row], [slopes.col]
        of_forces = [np.zeros(0)]
        for equation, (first, _) in zip(self.structure.forces, places, strict=False):
            effect = problem.dynamics_of_force(equation).tocoo()
            row.append(effect.row)
            column.append(first + effect.col)
            of_forces.append(-effect.data)
        self._slopes_of_forces = np.concatenate(of_forces)
        below = np.concatenate(row) + self.n_unknowns
        unknown = np.concatenate(column)
        self._pairs = _Pairs.of(self._shown_in_unknowns())
        every_state = np.arange(problem.nodes.size)
        rows = [below, unknown, self._pairs.row, every_state]
        columns = [unknown, below, self._pairs.column, every_state]
        grid = problem.grid
        run = self._of_unknowns(grid.trajectory, grid.runs)
        for first, n in places:
            on_diagonal = first + np.arange(n)
            after, before = on_diagonal[1:], on_diagonal[:-1]
            # Nothing joins trajectories; places for it would widen the band.
            before = np.where(run[before] == run[after], before, after)
            rows += [on_diagonal, after, before]
            columns += [on_diagonal, before, after]
        every_multiplier = self.n_unknowns + np.arange(len(self._softness))
        rows.append(every_multiplier)
        columns.append(every_multiplier)
        if problem.curvature is not None:
            upper = problem.curvature.of_states
            rows += [upper.row, upper.col]
            columns += [upper.col, upper.row]
        of_nodes = np.arange(grid.n_nodes, dtype=float)
        order = np.argsort(self._of_unknowns(of_nodes, grid.begin + 0.5), kind="stable")
        is_soft = bool(len(self._softness))
        whole = Chain(grid.begin, grid.n_nodes, problem.n_states)
        is_bare = not is_soft and problem.curvature is None
        chain = whole if is_bare else None
        self._layout = TimeLayout(
            np.concatenate(rows), np.concatenate(columns), order, chain
        )

    def places_of_processes(self) -> list[tuple[int, int]]:
        """First place and length of every process among the unknowns."""
        problem = self.problem
        lengths = [problem.grid.n_intervals] * len(self.structure.forces)
        for channel in self.structure.sensors:
            lengths.append(len(problem.values_of(channel)))
        places = []
        first = problem.dynamics_in_states.shape[1]
        for length in lengths:
            places.append((first, length))
            first += length
        return places

    def _of_unknowns(
        self, of_nodes: np.ndarray, of_intervals: np.ndarray
    ) -> np.ndarray:
        """A value for every unknown and multiplier, of its node or interval."""
        problem = self.problem
        parts = [np.repeat(of_nodes, problem.n_states)]
        parts += [of_intervals] * len(self.structure.forces)
        for channel in self.structure.sensors:
            parts.append(of_nodes[problem.node[problem.values_of(channel)]])
        parts.append(np.repeat(of_intervals, problem.n_states))
        return np.concatenate(parts)

    def _set_border(self) -> None:
        problem = self.problem
        in_dynamics = [problem.dynamics_in_theta[:, self.moving]]
        owner = []
        for number, (equation, state) in enumerate(self.structure.functions):
            columns = problem.dynamics_of_function(equation, state)
            in_dynamics.append(columns)
            owner += [number] * columns.shape[1]
        self.border_in_dynamics = np.hstack(in_dynamics)
        self._owner = np.array(owner, dtype=int)
        in_shown = np.zeros((problem.n_values, self.border_in_dynamics.shape[1]))
        in_shown[:, : len(self.moving)] = problem.shown_in_theta[:, self.moving]
        self.border_in_shown = in_shown

    def values_of_processes(self, unknowns: np.ndarray) -> np.ndarray:
        """What processes alone add to the measured values, (n_values, k).

        Args:
            unknowns: (n_unknowns, k).
        """
        n_x = self.problem.dynamics_in_states.shape[1]
        processes = unknowns.copy()
        processes[:n_x] = 0.0
        shown: np.ndarray = self.shown @ processes
        return shown

    def dynamics_of_processes(self, unknowns: np.ndarray) -> np.ndarray:
        """What forces alone do to the dynamics, (n_intervals * n_states, k).

        Args:
            unknowns: (n_unknowns, k).
        """
        problem = self.problem
        moved = np.zeros((problem.dynamics_in_states.shape[0], unknowns.shape[1]))
        places = self.places_of_processes()
        for equation, (first, n) in zip(self.structure.forces, places, strict=False):
            force = unknowns[first : first + n]
            moved += problem.dynamics_of_force(equation) @ force
        return moved

    @property
    def n_coefficients(self) -> int:
        """Number of the coefficients of all functions of states."""
        return len(self._owner)

    def dynamics_of_functions(self, coefficients: np.ndarray) -> np.ndarray:
        """What functions of states do to the dynamics, (n_intervals * n_states,).

        Args:
            coefficients: (n_coefficients,).
        """
        first = len(self.moving)
        columns = self.border_in_dynamics[:, first : first + len(coefficients)]
        moved: np.ndarray = columns @ coefficients
        return moved

    def coefficient_sizes(self, disturbances: Disturbances) -> np.ndarray:
        """Prior standard deviation of every coefficient, (n_coefficients,)."""
        return disturbances.function_sizes[self._owner]

    def whiteners(self, disturbances: Disturbances) -> list[Whitener]:
        """Of every process, forces first, of size one."""
        problem = self.problem
        whiteners = []
        for force in disturbances.forces:
            whiteners.append(whitener_of_force(problem, force))
        for sensor in disturbances.sensors:
            whiteners.append(whitener_of_sensor(problem, sensor))
        return whiteners

    def by_process(self, processes: np.ndarray) -> list[np.ndarray]:
        """Values of all processes (n_inner, ...), one by one."""
        ends = np.cumsum([n for _, n in self.places_of_processes()], dtype=int)
        return np.split(processes, ends)[:-1]

    def innovations(
        self, processes: np.ndarray, disturbances: Disturbances
    ) -> list[np.ndarray]:
        """Values of all processes (n_inner, ...) as standard normals, one by one."""
        found = []
        for values, process, whitener in zip(
            self.by_process(processes),
            disturbances.processes,
            self.whiteners(disturbances),
            strict=True,
        ):
            found.append(whitener.whitened(values) / process.size)
        return found

    def eliminated(
        self,
        disturbances: Disturbances,
        regular: float = 0.0,
        held: np.ndarray = NOTHING_HELD,
    ) -> "Eliminated":
        """States and processes solved for, in terms of the border.

        Args:
            disturbances: with their sizes.
            regular: share of the largest curvature that is added to every state's, for
                a point at which one has none.
            held: places of states, (n_held,) among all, that do not move.

        Raises:
            SolveError: the states do not follow from the data.
        """
        problem = self.problem
        weight = noise_weights(problem, disturbances.sigma)
        squared = weight**2
        processes = disturbances.processes
        whiteners = self.whiteners(disturbances)
        curvature = self._products * squared[self._pairs.value]
        largest = np.max(curvature)
        shift = np.full(problem.nodes.size, regular * largest)
        shift[held] = 1e9 * largest
        entries = [self._dynamics_entries, curvature, shift]
        log_prior = 0.0
        for process, whitener in zip(processes, whiteners, strict=True):
            entries.append(whitener.precision_diagonal / process.size**2)
            below = whitener.precision_below / process.size**2
            entries += [below, below]
            n = len(whitener.diagonal)
            log_prior += whitener.log_det - n * np.log(process.size)
        entries.append(-self._softness)
        entries += self._curved_entries
        factors = self._layout.factors(np.concatenate(entries))
        n, n_border = self.n_unknowns, self.border_in_dynamics.shape[1]
        n_theta = len(self.moving)
        # Column after column in memory, as it is solved for.
        right = np.zeros((n + len(problem.offset), n_border + 1), order="F")
        in_theta = squared[:, None] * self.border_in_shown[:, :n_theta]
        right[:n, :n_theta] += self.shown_transposed @ in_theta
        right[n:, :n_border] = self.border_in_dynamics
        if problem.curvature is not None:
            mixed = problem.curvature.mixed[:, self.moving]
            right[: len(mixed), :n_theta] += mixed
        right[:, n_border] = self._right_of_data(squared)
        log_noise = float(np.sum(np.log(weight)))
        return Eliminated(
            weights=squared,
            right=right,
            solved=factors.solve(right),
            factors=factors,
            whiteners=whiteners,
            log_evidence=log_noise + log_prior - factors.log_abs_det / 2,
        )

    def _right_of_data(self, weights: np.ndarray) -> np.ndarray:
        """Right-hand side of the measured values, (n_unknowns + n_dynamics,)."""
        of_values = self.shown_transposed @ (weights * self.problem.residual)
        return np.concatenate([of_values, -self.problem.offset])

    def solved_again(self, eliminated: "Eliminated") -> "Eliminated":
        """The same for other values and offsets, where the slopes are the same."""
        right, solved = eliminated.right.copy("F"), eliminated.solved.copy("F")
        right[:, -1] = self._right_of_data(eliminated.weights)
        solved[:, -1] = eliminated.factors.solve(right[:, -1])
        return replace(eliminated, right=right, solved=solved)

    def border(self, disturbances: Disturbances) -> Border:
        """What is left when states and processes are integrated out.

        Raises:
            SolveError: the states do not follow from the data.
        """
        return self.border_of(self.eliminated(disturbances))

    def border_of(self, eliminated: "Eliminated") -> Border:
        """What is left of states and processes that were solved for."""
        log_evidence = eliminated.log_evidence + self.problem.log_volume
        border = self._border_of(eliminated, log_evidence)
        return border.tilted(self.problem.slope[self.moving])

    def borders_by_run(self, disturbances: Disturbances) -> list[Border]:
        """The same, what every trajectory says by itself.

        The log evidence is that of all of them, shared out evenly; its slope as the
        information about each parameter.

        Raises:
            SolveError: the states do not follow from the data.
        """
        eliminated = self.eliminated(disturbances)
        log_evidence = eliminated.log_evidence + self.problem.log_volume
        run_of_value = self.problem.grid.trajectory[self.problem.node]
        run_of_unknown = self._of_unknowns(
            self.problem.grid.trajectory, self.problem.grid.runs
        )
        borders = []
        for run in range(self.problem.n_trajectories):
            values = np.flatnonzero(run_of_value == run)
            unknowns = np.flatnonzero(run_of_unknown == run)
            share = log_evidence * len(values) / self.problem.n_values
            borders.append(self._border_of(eliminated, share, values, unknowns))
        told = []
        for border in borders:
            told.append(np.diag(border.information)[: border.n_theta])
        slopes = (
            self.problem.slope[self.moving]
            * np.array(told)
            / (np.sum(told, axis=0) + TINY)
        )
        return [one.tilted(slope) for one, slope in zip(borders, slopes, strict=True)]

    def at_values(
        self, residual: np.ndarray, offset: np.ndarray
    ) -> "MarginalLikelihood":
        """The same with other values, (n_values,) and (n_intervals * n_states,).

        Its slopes stay.
        """
        other = copy(self)
        other.problem = replace(self.problem, residual=residual, offset=offset)
        return other

    def smoothed(
        self,
        eliminated: "Eliminated",
        disturbances: Disturbances,
        damping: float = 0.0,
        room: Room = ANY_ROOM,
        silent: float = 0.0,
    ) -> Smoothed:
        """The most likely parameters, states and disturbances.

        Args:
            eliminated: states and processes, in terms of the border.
            disturbances: with their sizes.
            damping: share of each parameter's information that is added to it, for a
                shorter step.
            room: how far the parameters may move, (n_moving,).
            silent: information up to which parameters do not move.

        Raises:
            SolveError: rounding has made the information indefinite.
        """
        sizes = disturbances.function_sizes
        border = self._border_of(eliminated, 0.0)
        border = border.tilted(self.problem.slope[self.moving])
        theta, of_functions = border.step(sizes, damping, room, silent)
        solved = eliminated.solved
        moved = np.concatenate([theta, of_functions])
        found = solved[:, -1] - solved[:, :-1] @ moved
        unknowns = found[: self.n_unknowns]
        problem = self.problem
        all_theta = np.zeros(problem.n_theta)
        all_theta[self.moving] = theta
        n_x = problem.nodes.size
        return Smoothed(
            theta=all_theta,
            x=unknowns[:n_x].reshape(problem.nodes.shape),
            processes=unknowns[n_x:],
            coefficients=of_functions,
            multipliers=found[self.n_unknowns :],
        )

    def response(self, disturbances: Disturbances) -> Response:
        """How the estimate under these disturbances answers errors.

        Raises:
            SolveError: the states do not follow from the data.
        """
        eliminated = self.eliminated(disturbances)
        border = self.border_of(eliminated)
        sizes = disturbances.function_sizes
        information = border.with_priors(sizes)
        inverse = solve_border(information, np.eye(len(information)))[: border.n_theta]
        answers = eliminated.solved[:, :-1]
        shown = self.border_in_shown - self.shown @ answers[: self.n_unknowns]
        of_dynamics = answers[self.n_unknowns :]
        n_theta = self.problem.n_theta
        to_dynamics = np.zeros((n_theta, len(of_dynamics)))
        to_dynamics[self.moving] = inverse @ of_dynamics.T
        to_values = np.zeros((n_theta, len(shown)))
        to_values[self.moving] = inverse @ (shown.T * eliminated.weights)
        return Response(to_dynamics, to_values)

    def _border_of(
        self,
        eliminated: "Eliminated",
        log_evidence: float,
        values: Any = EVERY,
        unknowns: Any = EVERY,
    ) -> Border:
        """From some of the values, and the unknowns that belong to them."""
        weights = eliminated.weights[values]
        in_shown = self.border_in_shown[values]
        residual = self.problem.residual[values]
        right = eliminated.right[unknowns]
        products = right.T @ eliminated.solved[unknowns]
        n = in_shown.shape[1]
        weighted = weights[:, None] * in_shown
        information = in_shown.T @ weighted - products[:n, :n]
        if self.problem.curvature is not None:
            k = len(self.moving)
            own = self.problem.curvature.of_theta[np.ix_(self.moving, self.moving)]
            information[:k, :k] += own
        squares = float(np.sum(weights * residual**2))
        return Border(
            information=(information + information.T) / 2,
            gradient=weighted.T @ residual - products[:n, n],
            constant=squares - float(products[n, n]),
            log_evidence=log_evidence,
            n_theta=len(self.moving),
            owner=self._owner,
        )

    def log_likelihood(self, disturbances: Disturbances) -> float:
        """Logarithm of the likelihood of the measurements at the best parameters.

        Disturbances and starting states are integrated out, with a flat prior of
        density one in the units of the states. Parameters are not, so that models with
        other parameters can be compared.

        Raises:
            SolveError: the states do not follow from the data.
        """
        sizes = disturbances.function_sizes
        border = self.border(disturbances)
        marginal = border.marginal(sizes)
        information = border.with_priors(sizes)
        inner = information[border.n_theta :, border.n_theta :]
        log_det = np.linalg.slogdet(information)[1] - np.linalg.slogdet(inner)[1]
        problem = self.problem
        n_free = problem.n_values - problem.n_trajectories * problem.n_states
        constant = n_free * np.log(2 * np.pi) / 2
        return float(marginal.log_evidence + log_det / 2 - constant)

    def log_volume_of_unknowns(self, disturbances: Disturbances) -> float:
        """What the log likelihood of given parameters has beside the squares.

        It is the logarithm of the volume that disturbances have under these parameters.
        Starting states are unknown numbers like the parameters, and not integrated out:
        a flat prior of theirs would prefer parameters that tell less of them (Cox and
        Reid, Journal of the Royal Statistical Society B 49, 1987).

        Raises:
            SolveError: the states do not follow from the data.
        """
        n = self.problem.n_states
        starts = self.problem.grid.first[:, None] * n + np.arange(n)
        border = self.border_of(self.eliminated(disturbances, held=starts.ravel()))
        information = border.with_priors(disturbances.function_sizes)
        return float(border.log_evidence - np.linalg.slogdet(information)[1] / 2)

    def log_model_evidence(self, disturbances: Disturbances) -> float:
        """`log_likelihood`, less BIC's half log n for every parameter that is free.

        Differences between models of the same measurements are logarithms of Bayes
        factors (Schwarz, Annals of Statistics 6, 1978).

        Raises:
            SolveError: the states do not follow from the data.
        """
        price = len(self.moving) * float(np.log(self.problem.n_values)) / 2
        return self.log_likelihood(disturbances) - price

    def at(self, disturbances: Disturbances) -> Marginal:
        """The marginal likelihood and the estimate under these disturbances.

        Raises:
            SolveError: the states do not follow from the data.
        """
        return self.border(disturbances).marginal(disturbances.function_sizes)


@dataclass(frozen=True, eq=False)
class Eliminated:
    """States and processes solved for, for each column of the border and the data.

    Attributes:
        weights: (n_values,) one over the noise variance.
        right: (n_unknowns, n_border + 1) right-hand sides, the last of the data.
        solved: in the same shape.
        factors: of the matrix of unknowns and multipliers.
        whiteners: of the processes, forces first, of size one.
        log_evidence: all that depends neither on the border nor on the volume of the
            states.
    """

    weights: np.ndarray
    right: np.ndarray
    solved: np.ndarray
    factors: Banded | Chained
    whiteners: list[Whitener]
    log_evidence: float


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of entries in one row of a sparse matrix C, whose products make C' W C.

    Attributes:
        one: (n_pairs,) place of an entry among those of C.
        other: (n_pairs,).
        row: (n_pairs,) of the product.
        column: (n_pairs,).
        value: (n_pairs,) row of C that both are from.
    """

    one: np.ndarray
    other: np.ndarray
    row: np.ndarray
    column: np.ndarray
    value: np.ndarray

    @classmethod
    def of(cls, slopes: csr_matrix) -> "_Pairs":
        """All pairs of a matrix."""
        n_in_row = np.diff(slopes.indptr)
        value = np.repeat(np.arange(slopes.shape[0]), n_in_row)
        n_partners = n_in_row[value]
        one = np.repeat(np.arange(len(value)), n_partners)
        number = np.arange(len(one)) - np.repeat(
            np.cumsum(n_partners) - n_partners, n_partners
        )
        other = slopes.indptr[value[one]] + number
        return cls(one, other, slopes.indices[one], slopes.indices[other], value[one])

    def products(self, slopes: csr_matrix) -> np.ndarray:
        """Of the entries of a matrix of the same pattern, (n_pairs,)."""
        products: np.ndarray = slopes.data[self.one] * slopes.data[self.other]
        return products


class ReducedSystem:
    """A linearised likelihood with white noise alone, its states eliminated.

    ::

        min over z = (theta, x) of  1/2 z'Hz   subject to  Jz = e

    The states of a record follow the parameters through the constraints, and what is
    left is a small dense problem in the parameters: the information.

    Args:
        linear: the likelihood, linearised.
        sigma: (n_states,) noise.

    Attributes:
        information: (n_theta, n_theta), the curvature that is left for theta when the
            states follow it.
        multipliers: (n_constraints,) of the constraints, where z is most likely.

    Raises:
        SolveError: the states do not follow from the parameters and the data.
    """

    def __init__(self, linear: Linearization, sigma: np.ndarray) -> None:
        every = np.arange(linear.n_theta)
        likelihood = MarginalLikelihood(linear, Structure(), every)
        noise = Disturbances(np.tile(sigma, (linear.n_trajectories, 1)))
        found = likelihood.eliminated(noise, REGULAR)
        self._shape = linear.nodes.shape
        self._factors = found.factors
        self._coupling = found.right[:, :-1]
        self._per_theta = found.solved[:, :-1]
        self.multipliers = found.solved[linear.nodes.size :, -1]
        shown = likelihood.border_in_shown
        curvature = shown.T @ (found.weights[:, None] * shown)
        information = curvature - self._coupling.T @ self._per_theta
        self.information = (information + information.T) / 2

    def respond(
        self, e: np.ndarray, covariance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Change of theta and x when the constraints are offset by ``e``.

        Args:
            e: (n_constraints,).
            covariance: (n_theta, n_theta) inverse of the information.

        Returns:
            Scaled, (n_theta,) and (n_nodes, n_states).
        """
        n_x = len(self._per_theta) - len(e)
        alone = self._factors.solve(np.concatenate([np.zeros(n_x), e]))
        theta = covariance @ (-self._coupling.T @ alone)
        states = alone - self._per_theta @ theta
        return theta, states[:n_x].reshape(self._shape)

    @property
    def following(self) -> np.ndarray:
        """How the states follow a change of theta, (n_nodes, n_states, n_theta)."""
        n_nodes, n_states = self._shape
        return -self._per_theta[: n_nodes * n_states].reshape(n_nodes, n_states, -1)

    def start_covariances(
        self, starts: np.ndarray, trajectory: np.ndarray
    ) -> np.ndarray:
        """Covariance of each node's states when theta is known.

        It is that of the starting states, carried along the trajectory.

        Args:
            starts: (n_trajectories, n_states) places of the starting states in x.
            trajectory: (n_nodes,) number of the trajectory of each node.

        Returns:
            (n_nodes, n_states, n_states).
        """
        n_runs, n = starts.shape
        unit = np.zeros((self._factors.n, n))
        # One column serves all trajectories: none touches another one.
        unit[starts.ravel(), np.tile(np.arange(n), n_runs)] = 1.0
        columns = self._factors.solve(unit)[: self._shape[0] * n]
        at_start = columns[starts.ravel()].reshape(n_runs, n, n)
        per_node = columns.reshape(-1, n, n)
        inverses = np.linalg.pinv(at_start, hermitian=True)
        return per_node @ inverses[trajectory] @ per_node.transpose(0, 2, 1)


def noise_weights(problem: Linearization, sigma: np.ndarray) -> np.ndarray:
    """One over the noise of every measured value, (n_values,)."""
    run = problem.grid.trajectory[problem.node]
    weights: np.ndarray = 1 / sigma[run, problem.channel]
    return weights


def whitener_of_force(problem: Linearization, force: Process) -> Whitener:
    """Of a force, at the middles of the intervals."""
    return Whitener.of(problem.middles, problem.grid.runs, force.time)


def whitener_of_sensor(problem: Linearization, sensor: Process) -> Whitener:
    """Of a sensor's process, at the measured values of its channel."""
    nodes = problem.node[problem.values_of(sensor.place)]
    grid = problem.grid
    return Whitener.of(grid.t[nodes], grid.trajectory[nodes], sensor.time)


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


# Numbers that are held at once while the linearised problem is solved: 240 MB.
MOST_SOLVED = 3e7


@dataclass(frozen=True, eq=False)
class ForcePosterior:
    """The forces given the measurements and the parameters.

    Attributes:
        likelihood: of the linearised record; no parameter moves in it.
        disturbances: with their sizes, forces among them.
    """

    likelihood: MarginalLikelihood
    disturbances: Disturbances

    @cached_property
    def _eliminated(self) -> Eliminated:
        return self.likelihood.eliminated(self.disturbances)

    @property
    def n_unknowns(self) -> int:
        """Number of states, forces and multipliers, which are solved for."""
        return len(self._eliminated.right)

    @property
    def log_evidence(self) -> float:
        """Logarithm of the marginal likelihood, up to a constant."""
        return self.likelihood.at(self.disturbances).log_evidence

    @property
    def mean(self) -> np.ndarray:
        """Of the forces, (n_intervals, n_forced)."""
        solved = self._eliminated.solved[:, -1]
        return np.array([solved[places] for places in self._places]).T

    @cached_property
    def deviation(self) -> np.ndarray:
        """Standard deviation of the forces, (n_intervals, n_forced).

        It changes slowly, is solved for at 16 to 400 intervals, as many as fit in
        memory, and interpolated between.
        """
        that_fit = MOST_SOLVED / self.n_unknowns
        most = int(np.clip(that_fit, 16, 400))
        n_intervals = self.likelihood.problem.grid.n_intervals
        evenly = np.linspace(0, n_intervals - 1, min(most, n_intervals))
        chosen = np.unique(evenly.astype(int))
        columns = np.arange(len(chosen))
        deviations = []
        for places in self._places:
            units = np.zeros((self.n_unknowns, len(chosen)), order="F")
            units[places[chosen], columns] = 1.0
            variance = self._eliminated.factors.solve(units)[places[chosen], columns]
            exact = np.sqrt(np.maximum(variance, 0.0))
            deviations.append(np.interp(np.arange(n_intervals), chosen, exact))
        return np.array(deviations).T

    @property
    def times_noise(self) -> np.ndarray:
        """Size of the forces over their typical (median) deviation, (n_forced,)."""
        size = np.sqrt(np.mean(self.mean**2, axis=0))
        typical = np.median(self.deviation, axis=0)
        return np.asarray(size / np.maximum(typical, TINY))

    def error_draws(self, n_draws: int = 24, seed: int = 0) -> np.ndarray:
        """Random errors of the forces, (n_intervals, n_forced, n_draws).

        Solutions for random noise and random innovations, whose covariance is that of
        the forces given the measurements.
        """
        rng = np.random.default_rng(seed)
        likelihood = self.likelihood
        weights = np.sqrt(self._eliminated.weights)
        noise = rng.normal(size=(len(weights), n_draws))
        right = np.zeros((self.n_unknowns, n_draws), order="F")
        of_noise = likelihood.shown_transposed @ (weights[:, None] * noise)
        right[: likelihood.n_unknowns] = of_noise
        for force, places, whitener in self._forces():
            innovations = rng.normal(size=(len(places), n_draws))
            right[places] += whitener.transposed(innovations) / force.size
        errors = self._eliminated.factors.solve(right)
        return np.stack([errors[places] for places in self._places], axis=1)

    def shown(self, number: int, forces: np.ndarray) -> np.ndarray:
        """What the mean would show of forces in one equation, (n_intervals, k).

        It is less than they are by what noise and prior hide::

            w_shown = w - C P^-1 w

        with the forces' covariance P before and C after the measurements.

        Args:
            number: of the equation among those with a force.
            forces: (n_intervals, k).
        """
        force, places, whitener = self._forces()[number]
        n_forces = forces.shape[1]
        n_parts = 1 + int(self.n_unknowns * n_forces / MOST_SOLVED)
        shown = np.empty_like(forces)
        for part in np.array_split(np.arange(n_forces), n_parts):
            right = np.zeros((self.n_unknowns, len(part)), order="F")
            pulled = whitener.transposed(whitener.whitened(forces[:, part]))
            right[places] = pulled / force.size**2
            hidden = self._eliminated.factors.solve(right)[places]
            shown[:, part] = forces[:, part] - hidden
        return shown

    @property
    def _places(self) -> list[np.ndarray]:
        """Places of every force's values among all that is solved for."""
        n_forced = len(self.disturbances.forces)
        places = self.likelihood.places_of_processes()[:n_forced]
        return [first + np.arange(n) for first, n in places]

    def _forces(self) -> list[tuple[Process, np.ndarray, Whitener]]:
        """Every force with its places and the whitener of its prior."""
        whiteners = self._eliminated.whiteners
        forces = self.disturbances.forces
        return list(zip(forces, self._places, whiteners, strict=False))
