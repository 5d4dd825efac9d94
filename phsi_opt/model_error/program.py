"""The nonlinear program with disturbances as unknowns.

::

    minimise   (1/N) (|(y - shown - e)/sigma|^2 + |w|^2 + |e|^2 + |a|^2)
    over parameters, states, forces w, errors e of sensors, coefficients a of functions
    subject to dynamics = w + functions of states

each disturbance in the norm of its own prior. Sizes and times are given: inside the
program they would collapse to zero; `disturbance_search` finds them.
"""

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import csc_matrix, diags, hstack

from phsi_opt.model.model import Model
from phsi_opt.model_error.disturbances import Disturbances
from phsi_opt.model_error.linearization import Linearization
from phsi_opt.model_error.marginal_likelihood import (
    Smoothed,
    noise_weights,
    whitener_of_force,
    whitener_of_sensor,
)
from phsi_opt.model_error.processes import Whitener
from phsi_opt.optimization.program import Program
from phsi_opt.optimization.program_builder import Assembly
from phsi_opt.transcription.defect_constraint import DefectConstraint
from phsi_opt.transcription.defects import defects
from phsi_opt.transcription.loss_blocks import ThetaVariable, state_variable
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.transcription.point import Point
from phsi_opt.transcription.sensors import outputs


def disturbed_program(
    model: Model,
    point: Point,
    unknown: Theta,
    integrator: str,
    problem: Linearization,
    disturbances: Disturbances,
    moving: np.ndarray,
    start: Smoothed,
) -> Program:
    """The program in theta, x and the disturbances.

    Args:
        model: the model.
        point: where the solver begins, and the sizes of the unknowns.
        unknown: the parameters.
        integrator: the scheme of the defects.
        problem: the record linearised near by; functions of states are taken along its
            states.
        disturbances: with their sizes and times; one over the noise of every value is
            a setting of the program.
        moving: (n_moving,) places of the parameters along whose directions no force may
            act, where the disturbances are orthogonal.
        start: where the disturbances begin.
    """
    grid = problem.grid
    build = Assembly()
    theta = ThetaVariable.added_to(build, unknown, point)
    x = state_variable(build, grid, point)
    constraint = DefectConstraint(model, grid, integrator, point, unknown)
    n_obeying = len(unknown) + point.x.size
    blocks = _Blocks(build, problem, disturbances, start)
    d = defects(model, grid, integrator, x, theta.by_trajectory)
    scaled = ca.vec(constraint.scaled(d)) - blocks.in_dynamics

    def jacobian(z: ca.MX) -> ca.MX:
        return ca.horzcat(constraint.jacobian(z[:n_obeying]), ca.DM(-blocks.slopes))

    build.constrain(
        "defect",
        ca.reshape(scaled, d.shape[0], d.shape[1]),
        label=grid.interval_label(model.n_states),
        jacobian=jacobian,
    )
    if disturbances.is_orthogonal:
        equations = [force.place for force in disturbances.forces]
        own = problem.own_directions(equations, moving)
        if own.shape[1]:
            forces = ca.vertcat(*blocks.forces)
            build.constrain("orthogonal", ca.mtimes(ca.DM(own.T), forces))
    shown = outputs(model, grid, x, theta.by_trajectory) if model.sensor else x
    measured = np.flatnonzero(grid.measured.ravel()).tolist()
    y = ca.DM(grid.y.ravel()[measured])
    weights = build.setting("weights", noise_weights(problem, disturbances.sigma))
    error = y - ca.vec(shown)[measured] - blocks.in_shown
    # Twice the mean square of the residuals is near one, whatever the record's length.
    per_value = np.sqrt(2 / problem.n_values)
    build.residual(error * weights * per_value)
    for innovations in blocks.innovations:
        build.residual(innovations * per_value)
    return build.finish()


class _Blocks:
    """The variables of the disturbances, and what they do.

    Attributes:
        in_dynamics: (n_intervals * n_states,) symbols, added to the dynamics.
        forces: values of every force over the largest size of one.
        in_shown: (n_values,) symbols, added to what is shown.
        innovations: whitened values of every block.
        slopes: of ``in_dynamics`` in the scaled variables, sparse and constant.
    """

    def __init__(
        self,
        build: Assembly,
        problem: Linearization,
        disturbances: Disturbances,
        start: Smoothed,
    ) -> None:
        n_dynamics = problem.dynamics_in_states.shape[0]
        self._build = build
        self._slopes: list[Any] = []
        self.in_dynamics: Any = ca.DM.zeros(n_dynamics)
        self.in_shown: Any = ca.DM.zeros(problem.n_values)
        self.innovations: list[ca.MX] = []
        self.forces: list[ca.MX] = []
        n_forces = len(disturbances.forces)
        largest = max((force.size for force in disturbances.forces), default=1.0)
        for number, force in enumerate(disturbances.forces):
            first = start.processes[number]
            matrix = problem.dynamics_of_force(force.place)
            values = self._added(f"force_{number}", matrix, force.size, first)
            self.forces.append(values / largest)
            whitener = _matrix(whitener_of_force(problem, force)) / force.size
            self.innovations.append(ca.mtimes(ca.DM(whitener), values))
        for number, function in enumerate(disturbances.functions):
            columns = problem.dynamics_of_function(function.equation, function.state)
            matrix = csc_matrix(-columns)
            first = start.coefficients[number]
            values = self._added(f"function_{number}", matrix, function.size, first)
            self.innovations.append(values / function.size)
        for number, sensor in enumerate(disturbances.sensors):
            places = problem.values_of(sensor.place)
            none = csc_matrix((n_dynamics, len(places)))
            first = start.processes[n_forces + number]
            values = self._added(f"sensor_{number}", none, sensor.size, first)
            to_values = _spread_out(places, np.ones(len(places)), problem.n_values)
            self.in_shown = self.in_shown + ca.mtimes(ca.DM(to_values), values)
            whitener = _matrix(whitener_of_sensor(problem, sensor)) / sensor.size
            self.innovations.append(ca.mtimes(ca.DM(whitener), values))
        self.slopes = _joined(self._slopes, n_dynamics)

    def _added(
        self, name: str, in_dynamics: Any, size: float, first: np.ndarray
    ) -> ca.MX:
        """Add a block of variables that begins at given values."""
        scale = np.full(len(first), size)
        values = self._build.variable(name, first, scale=scale)
        self._slopes.append(in_dynamics * size)
        if in_dynamics.nnz:
            moved = ca.mtimes(ca.DM(in_dynamics), values)
            self.in_dynamics = self.in_dynamics + moved
        return values


def _spread_out(places: np.ndarray, values: np.ndarray, n_rows: int) -> csc_matrix:
    """Matrix with one value per column, at its place."""
    n = len(places)
    return csc_matrix((values, (places, np.arange(n))), shape=(n_rows, n))


def _matrix(whitener: Whitener) -> csc_matrix:
    return diags([whitener.diagonal, whitener.below], [0, -1], format="csc")


def _joined(slopes: Sequence[Any], n_rows: int) -> csc_matrix:
    if not slopes:
        return csc_matrix((n_rows, 0))
    return csc_matrix(hstack(slopes))
