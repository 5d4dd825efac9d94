"""The likelihood of a task, and how it is maximised from a starting point.

What would make it unsolvable is refused before any time is spent. Then full steps;
where the start is not near, along a missing force that shrinks; where the steps do not
settle, and where the program has slack variables, IPOPT (`likelihood_steps`). Where to
start is the business of `maximum_likelihood`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phsi_opt.errors import DataError
from phsi_opt.estimation.estimate import Task
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_steps import (
    FORCE_SIZES,
    SMALL_FORCES,
    by_ipopt,
    by_steps,
    continued,
)
from phsi_opt.estimation.noise_estimation import NoiseIteration, NoiseLevels
from phsi_opt.estimation.optimum_checks import is_at_scatter
from phsi_opt.initialization.scaling import point_at
from phsi_opt.model.model import Model
from phsi_opt.model_error.joint_estimate import STEPS_OF_A_PROBLEM
from phsi_opt.transcription.augmented_states import memory_start_bounds
from phsi_opt.transcription.defects import between_samples
from phsi_opt.transcription.likelihood_values import LikelihoodValues
from phsi_opt.transcription.losses import (
    MOST_PROGRAMS,
    SAME_DELAY,
    MaximumLikelihood,
)
from phsi_opt.transcription.parameter_vector import Theta


@dataclass(frozen=True, eq=False)
class StartingPoint:
    """Where the maximisation of a likelihood begins."""

    model: Model  # with the guesses of its parameters resolved
    theta: np.ndarray  # (n_theta,) values in the order of `Theta`
    # (n_samples, n_states) per trajectory, at the samples.
    states: tuple[np.ndarray, ...]
    sigma: np.ndarray  # (n_states,) noise
    notes: tuple[str, ...] = ()  # sentences for the warnings of the fit
    # Intervals in every gap between samples, (n_samples - 1,) per trajectory; empty:
    # one, or what the loss says.
    steps: tuple[np.ndarray, ...] = ()
    held: tuple[str, ...] = ()  # parameters that a solve left at their bounds
    # Whether it is one of this very model, with other steps or measurements; then its
    # states need not be found anew.
    is_optimum: bool = False

    @classmethod
    def at(
        cls, estimate: LikelihoodEstimate, steps: Sequence[np.ndarray]
    ) -> "StartingPoint":
        """At an estimate, with ``steps`` of its own."""
        return cls(
            model=estimate.model,
            theta=estimate.theta,
            states=estimate.states,
            sigma=estimate.sigma,
            steps=tuple(steps),
            held=estimate.solution.outcome.at_bounds,
        )


@dataclass(frozen=True, eq=False)
class LikelihoodProblem:
    """The likelihood of a task, ready to be maximised."""

    task: Task  # what was asked for
    loss: MaximumLikelihood  # the likelihood
    noise: NoiseLevels  # what is known of the noise, and guesses of the rest

    @classmethod
    def of(cls, task: Task, loss: MaximumLikelihood) -> "LikelihoodProblem":
        """With the declared noise, and a guess from the data where none is declared.

        Raises:
            DataError: if a sensor's state is not measured, the values are too few, the
                declared noise is none, or nothing moves.
        """
        for name in task.model.sensor:
            if name not in task.data.measured:
                raise DataError(
                    f"the model has a sensor of {name!r}, but {name!r} was never "
                    "measured; leave one of them out."
                )
        n_runs = task.data.n_trajectories
        n_values = len(task.grid.channel)
        n_theta = len(Theta.of(task.model, task.runs))
        n_unknown = n_theta + n_runs * task.model.n_states
        if n_values <= n_unknown:
            raise DataError(
                f"{n_values} measured values are too few for {n_unknown} unknowns "
                f"({n_theta} parameters and the starting states of {n_runs} "
                "trajectories); measure more, or fix parameters."
            )
        return cls(task, loss, NoiseLevels.of(task.data, loss))

    def solve_from(self, start: StartingPoint) -> LikelihoodEstimate:
        """The optimum of the whole record, however far off the start is.

        Where steps from the start lead to an optimum whose residuals are more than the
        scatter of the samples, the likelier of this and of the one along the missing
        force.
        """
        settings = self.task.settings
        if settings.thorough and not start.is_optimum:
            found = []
            if settings.solver == "auto":
                # Few steps are enough where a crude start is near.
                near = self.solve(start, most_steps=12)
                if is_at_scatter(near):
                    return near
                found.append(near)
            there = self.continued(start)
            found.append(self.solve(start if there is None else there))
            return likeliest(found)
        is_near = start.is_optimum and not settings.thorough
        most_steps = STEPS_OF_A_PROBLEM if is_near else None
        near = self.solve(start, most_steps=most_steps)
        if near.is_success:
            return near
        there = self.continued(start, SMALL_FORCES if is_near else FORCE_SIZES)
        return near if there is None else self.solve(there, most_steps=most_steps)

    def continued(
        self, start: StartingPoint, sizes: Sequence[float] = FORCE_SIZES
    ) -> StartingPoint | None:
        """A start that nearly solves the model, along a missing force that shrinks.

        None where it leads nowhere. Outliers count in full on the way, and L1 for
        nothing.
        """
        values = self.values_at(start)
        z = continued(values, start.sigma, sizes)
        if z is None:
            return None
        unscaled = values.point.unscaled(z)
        states = self.task.grid.split(unscaled["x"][values.grid.sample])
        return replace(start, theta=unscaled["theta"], states=states, is_optimum=True)

    def _steps(self, start: StartingPoint) -> tuple[np.ndarray, ...]:
        """Intervals in every gap between samples, fine where a memory fades."""
        # The memory that a trajectory begins with is free; that of a short delay fades
        # within a few samples. With coarse steps there it could take values far off for
        # the sake of the first residuals, and a simulation from them would go astray.
        steps = start.steps
        if not steps:
            n_steps = self.loss.steps or 1
            runs = self.task.data.trajectories
            steps = tuple(np.full(run.n_samples - 1, n_steps) for run in runs)
        if not start.model.memory:
            return steps
        return tuple(np.r_[np.maximum(n[:4], 16), n[4:]] for n in steps)

    def solve(
        self,
        start: StartingPoint,
        *,
        l1: dict[str, float] | None = None,
        most_steps: int | None = None,
    ) -> LikelihoodEstimate:
        """Solve from a starting point that has its steps.

        Noise that is not known is re-estimated until it stays.

        After ``most_steps`` full steps IPOPT is not tried; None: as many as it takes.
        """
        l1 = self.task.l1 if l1 is None else l1
        values = self.values_at(start)
        has_l1 = bool(np.any(values.unknown.weights(l1) > 0))
        noise = NoiseIteration(
            grid=values.grid,
            levels=self.noise,
            n_theta=len(values.unknown),
            huber=self.loss.huber,
            is_penalized=has_l1 or bool(np.any(values.prior)),
        )
        settings = self.task.settings
        optimum = None
        has_slacks = has_l1 or noise.huber is not None
        if settings.solver == "auto" and not has_slacks:
            if most_steps is not None:
                most = min(most_steps, settings.max_iterations)
                settings = replace(settings, max_iterations=most)
            optimum = by_steps(values, settings, noise, start.sigma)
        is_final = most_steps is not None
        if optimum is None or not (is_final or optimum.solution.outcome.success):
            program = self.loss.program(values, l1, start.sigma)
            optimum = by_ipopt(program, settings, noise, start.sigma, optimum)
            for _ in range(MOST_PROGRAMS if values.model.delays else 0):
                found = optimum.solution.values
                if np.allclose(found["theta"], values.point.theta, rtol=SAME_DELAY):
                    break
                x = found["x"].reshape(values.grid.y.shape)[values.grid.sample]
                there = replace(start, theta=found["theta"])
                values = self.values_at(replace(there, states=self.task.grid.split(x)))
                program = self.loss.program(values, l1, start.sigma)
                optimum = by_ipopt(program, settings, noise, start.sigma, None)
        self.task.say(
            f"maximum likelihood, {len(values.unknown)} parameters, "
            f"{values.point.x.size} states: {optimum.solution.outcome}"
        )
        return LikelihoodEstimate(
            task=self.task,
            loss=self.loss,
            model=values.model,
            grid=values.grid,
            unknown=values.unknown,
            point=values.point,
            likelihood=values,
            solution=optimum.solution,
            l1=l1,
            sigma=optimum.sigma,
            levels=self.noise,
        )

    def values_at(self, start: StartingPoint) -> LikelihoodValues:
        """The likelihood laid out, its point at the start."""
        model = start.model
        grid = self.task.aligned.grid_with(self._steps(start))
        unknown = Theta.of(model, self.task.runs)
        parameters = unknown.by_trajectory(start.theta)
        states = np.concatenate(start.states)
        nodes = between_samples(model, grid, states, parameters)
        point = point_at(model, grid, unknown, start.theta, nodes, start.held)
        bounds = memory_start_bounds(model, grid, nodes, parameters)
        point = replace(point, x_bounds=bounds)
        return LikelihoodValues(model, grid, self.loss.integrator, point, unknown)


def likeliest(estimates: Sequence[LikelihoodEstimate]) -> LikelihoodEstimate:
    """The optimum of the smallest deviance; one that is none comes last."""
    return min(estimates, key=lambda e: (not e.is_success, e.deviance))
