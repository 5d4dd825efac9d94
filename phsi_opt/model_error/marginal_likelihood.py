"""How likely measurements are under disturbances, whatever they and the states were.

At a solution the measurements are taken as linear in states, parameters and
disturbances. All of them are then Gaussian, and what is not known can be integrated out
in closed form: the parameters and starting states as well, with flat priors, so that the
sizes of the disturbances are not taken too small because the parameters followed them
(restricted maximum likelihood; Patterson and Thompson, Biometrika 58, 1971). In the
order of time the matrix is banded; parameters and functions of states are its border.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, hstack

from phsi_opt.model_error.disturbances import Disturbances, Structure
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.processes import Process, Whitener
from phsi_opt.optimization.banded import Banded, BandLayout
from phsi_opt.transcription.elimination import RIDGE


@dataclass(frozen=True, eq=False)
class Marginal:
    """What measurements say under given disturbances.

    Attributes:
        log_evidence: logarithm of the marginal likelihood, up to a constant of the
            linearisation.
        theta: (n_theta,) step of the scaled parameters to their estimate.
        covariance: (n_theta, n_theta) of the scaled parameters.
    """

    log_evidence: float
    theta: np.ndarray
    covariance: np.ndarray


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
        owner: (n - n_theta,) number of the function that a coefficient belongs to.
    """

    information: np.ndarray
    gradient: np.ndarray
    constant: float
    log_evidence: float
    n_theta: int
    owner: np.ndarray

    def marginal(self, sizes: np.ndarray) -> Marginal:
        """With functions of these sizes, (n_functions,)."""
        precision = np.full(len(self.gradient), RIDGE)
        precision[self.n_theta :] = 1 / sizes[self.owner] ** 2
        information = self.information + np.diag(precision)
        found = np.linalg.solve(information, self.gradient)
        misfit = self.constant - self.gradient @ found
        log_det = np.linalg.slogdet(information)[1]
        log_prior = -np.sum(np.log(sizes[self.owner]))
        covariance = np.linalg.inv(information)
        n = self.n_theta
        return Marginal(
            log_evidence=float(self.log_evidence - (misfit + log_det) / 2 + log_prior),
            theta=found[:n],
            covariance=covariance[:n, :n],
        )


class MarginalLikelihood:
    """The marginal likelihood of a linearised record for disturbances of one structure.

    Args:
        problem: the linearised record.
        structure: which disturbances there are.
        moving: (n_moving,) places of the parameters that are free to move.
    """

    def __init__(
        self, problem: Linearization, structure: Structure, moving: np.ndarray
    ) -> None:
        self.problem = problem
        self.structure = structure
        self.moving = moving
        self._shown = self._shown_in_unknowns()
        self._n_unknowns = self._shown.shape[1]
        self._set_layout()
        self._set_border()

    def _shown_in_unknowns(self) -> csr_matrix:
        """Slope of what is shown in states and processes."""
        problem = self.problem
        n_values = problem.n_values
        n_intervals = problem.grid.n_intervals
        blocks = [problem.shown_in_states]
        for _ in self.structure.forces:
            blocks.append(csr_matrix((n_values, n_intervals)))
        for channel in self.structure.sensors:
            values = problem.values_of(channel)
            column = np.arange(len(values))
            ones = np.ones(len(values))
            shape = (n_values, len(values))
            blocks.append(csr_matrix((ones, (values, column)), shape=shape))
        return csr_matrix(hstack(blocks))

    def _dynamics_in_unknowns(self) -> coo_matrix:
        problem = self.problem
        n_dynamics = problem.dynamics_in_states.shape[0]
        blocks = [problem.dynamics_in_states]
        for equation in self.structure.forces:
            rows = problem.places_of_force(equation)
            effect = -problem.effect_of_force(equation)
            columns = np.arange(len(rows))
            shape = (n_dynamics, len(rows))
            blocks.append(coo_matrix((effect, (rows, columns)), shape=shape))
        for channel in self.structure.sensors:
            n_values = len(problem.values_of(channel))
            blocks.append(coo_matrix((n_dynamics, n_values)))
        return hstack(blocks).tocoo()

    def _set_layout(self) -> None:
        """Places of all entries: dynamics, products of slopes, priors of processes."""
        dynamics = self._dynamics_in_unknowns()
        self._n_dynamics = dynamics.shape[0]
        below = dynamics.row + self._n_unknowns
        rows = [below, dynamics.col]
        columns = [dynamics.col, below]
        self._dynamics_entries = np.concatenate([dynamics.data, dynamics.data])
        self._products = _products_of_rows(self._shown)
        rows.append(self._products.row)
        columns.append(self._products.column)
        for first, n in self._places_of_processes():
            on_diagonal = first + np.arange(n)
            rows += [on_diagonal, on_diagonal[1:], on_diagonal[:-1]]
            columns += [on_diagonal, on_diagonal[:-1], on_diagonal[1:]]
        order = np.argsort(self._times_of_unknowns(), kind="stable")
        self._layout = BandLayout(np.concatenate(rows), np.concatenate(columns), order)

    def _places_of_processes(self) -> list[tuple[int, int]]:
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

    def _times_of_unknowns(self) -> np.ndarray:
        """Position of every unknown and multiplier along the nodes."""
        problem = self.problem
        grid = problem.grid
        at_middles = grid.begin + 0.5
        positions = [np.repeat(np.arange(grid.n_nodes), problem.n_states)]
        positions += [at_middles] * len(self.structure.forces)
        for channel in self.structure.sensors:
            positions.append(problem.node[problem.values_of(channel)])
        positions.append(np.repeat(at_middles, problem.n_states))
        return np.concatenate(positions)

    def _set_border(self) -> None:
        problem = self.problem
        in_dynamics = [problem.dynamics_in_theta[:, self.moving]]
        owner = []
        for number, (equation, state) in enumerate(self.structure.functions):
            columns = problem.dynamics_of_function(equation, state)
            in_dynamics.append(columns)
            owner += [number] * columns.shape[1]
        self._border_in_dynamics = np.hstack(in_dynamics)
        self._owner = np.array(owner, dtype=int)
        in_shown = np.zeros((problem.n_values, self._border_in_dynamics.shape[1]))
        in_shown[:, : len(self.moving)] = problem.shown_in_theta[:, self.moving]
        self._border_in_shown = in_shown

    def whiteners(self, disturbances: Disturbances) -> list[Whitener]:
        """Of every process, forces first, of size one."""
        problem = self.problem
        whiteners = []
        for force in disturbances.forces:
            whiteners.append(whitener_of_force(problem, force))
        for sensor in disturbances.sensors:
            whiteners.append(whitener_of_sensor(problem, sensor))
        return whiteners

    def border(self, disturbances: Disturbances) -> Border:
        """What is left when states and processes are integrated out.

        Raises:
            SolveError: the states do not follow from the data.
        """
        problem = self.problem
        weight = noise_weights(problem, disturbances.sigma)
        squared = weight**2
        processes = [*disturbances.forces, *disturbances.sensors]
        whiteners = self.whiteners(disturbances)
        entries = [self._dynamics_entries, self._products.entries(squared)]
        log_prior = 0.0
        for process, whitener in zip(processes, whiteners, strict=True):
            entries.append(whitener.precision_diagonal / process.size**2)
            below = whitener.precision_below / process.size**2
            entries += [below, below]
            n = len(whitener.diagonal)
            log_prior += whitener.log_det - n * np.log(process.size)
        factors = Banded.of(self._layout, np.concatenate(entries))

        weighted_border = squared[:, None] * self._border_in_shown
        coupling = np.vstack(
            [self._shown.T @ weighted_border, self._border_in_dynamics]
        )
        no_dynamics = np.zeros(self._n_dynamics)
        in_unknowns = self._shown.T @ (squared * problem.residual)
        gradient = np.concatenate([in_unknowns, no_dynamics])
        both = np.column_stack([coupling, gradient])
        solved = factors.solve(both)
        products = both.T @ solved
        n = self._border_in_shown.shape[1]
        information = self._border_in_shown.T @ weighted_border - products[:n, :n]
        of_border = weighted_border.T @ problem.residual - products[:n, n]
        squares = float(np.sum(squared * problem.residual**2))
        log_noise = float(np.sum(np.log(weight)))
        return Border(
            information=(information + information.T) / 2,
            gradient=of_border,
            constant=squares - float(products[n, n]),
            log_evidence=log_noise + log_prior - factors.log_abs_det / 2,
            n_theta=len(self.moving),
            owner=self._owner,
        )

    def at(self, disturbances: Disturbances) -> Marginal:
        """The marginal likelihood and the estimate under these disturbances.

        Raises:
            SolveError: the states do not follow from the data.
        """
        sizes = np.array([function.size for function in disturbances.functions])
        return self.border(disturbances).marginal(sizes)


@dataclass(frozen=True, eq=False)
class _Products:
    """Entries of C' W C as a function of the weights W of the values.

    Attributes:
        row: (n_entries,).
        column: (n_entries,).
        value: (n_entries,) number of the measured value that an entry comes from.
        factor: (n_entries,) product of two slopes.
    """

    row: np.ndarray
    column: np.ndarray
    value: np.ndarray
    factor: np.ndarray

    def entries(self, weights: np.ndarray) -> np.ndarray:
        """With these weights, (n_entries,)."""
        entries: np.ndarray = self.factor * weights[self.value]
        return entries


def _products_of_rows(slopes: csr_matrix) -> _Products:
    """All products of two entries of one row."""
    n_in_row = np.diff(slopes.indptr)
    value = np.repeat(np.arange(slopes.shape[0]), n_in_row)
    n_partners = n_in_row[value]
    one = np.repeat(np.arange(len(value)), n_partners)
    number = np.arange(len(one)) - np.repeat(
        np.cumsum(n_partners) - n_partners, n_partners
    )
    other = slopes.indptr[value[one]] + number
    return _Products(
        row=slopes.indices[one],
        column=slopes.indices[other],
        value=value[one],
        factor=slopes.data[one] * slopes.data[other],
    )


def noise_weights(problem: Linearization, sigma: np.ndarray) -> np.ndarray:
    """One over the noise of every measured value, (n_values,)."""
    run = problem.grid.trajectory[problem.node]
    weights: np.ndarray = 1 / sigma[run, problem.channel]
    return weights


def whitener_of_force(problem: Linearization, force: Process) -> Whitener:
    """Of a force, at the middles of the intervals."""
    return Whitener.of(problem.middles, problem.runs, force.time)


def whitener_of_sensor(problem: Linearization, sensor: Process) -> Whitener:
    """Of a sensor's process, at the measured values of its channel."""
    nodes = problem.node[problem.values_of(sensor.place)]
    grid = problem.grid
    return Whitener.of(grid.t[nodes], grid.trajectory[nodes], sensor.time)
