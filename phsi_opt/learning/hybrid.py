"""The hybrid: a dictionary for H and R, a neural network for a force without a formula.

    dx/dt = (S - R) grad H(x) + F(x, t, u),    F_k = network in the forced equations k

The dictionary is identified by the solver and the network is trained in torch, in
turns, each with the other's latest estimate, on one and the same loss: the defects of
an integrator. A turn is

1. the program for H and R, with the force of the network as an input at the stages of
   every step;
2. the network on the rest of the forced equations at these stages (AdamW);
3. its last layer once more, exactly, by least squares together with every coefficient
   of H and R: what the dictionary can explain is shared out as the joint loss wants it,
   whichever of the two was fitted first.

The network and its training are in `hybrid_network`.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.data.checks import checked_hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.noise import LEAST_SIZE
from phsi_opt.estimation.estimate import Pruning, Task
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_file import decoded, encoded, read_json
from phsi_opt.estimation.identified import Identified
from phsi_opt.estimation.identify import fit_of_task
from phsi_opt.force_analysis.cross_validation import N_FOLDS
from phsi_opt.force_analysis.force_record import Points
from phsi_opt.interrupts import interruptible
from phsi_opt.learning.hybrid_network import (
    NeuralForce,
    TrainedForce,
    TrainingSet,
    cross_validated_ridge,
    train,
)
from phsi_opt.model.model import Model
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.simulation.simulate import simulate_forced
from phsi_opt.statistics import rms
from phsi_opt.transcription import integrators
from phsi_opt.transcription.defects import ParameterSlopes, parameter_slopes
from phsi_opt.transcription.grid import AlignedData, Grid, aligned_once, grid_of
from phsi_opt.transcription.integrators import Integrator
from phsi_opt.transcription.losses import PHSILoss, complete_intervals, l1_weights
from phsi_opt.writing import write_whole

__all__ = ["Hybrid", "NeuralForce", "TrainedForce", "hybrid"]

FORMAT = "phsi_opt hybrid 3"
SIGNAL = "network_signal_"  # the inputs that stand for the force begin so
STEP_SHARE = f"{SIGNAL}share"  # of the step


@interruptible
def hybrid(
    model: Model,
    data: Measurements,
    force: NeuralForce,
    l1: dict[str, float] | float | None = None,
    pruning: Pruning | None = None,
    *,
    integrator: str = "srk4",
    seed: int = 0,
    max_turns: int = 20,
) -> "Hybrid":
    """Identify a dictionary and train a neural force beside it, in turns.

    The turns end when the coefficients move by less than a thousandth and the force by
    less than a hundredth, or after ``max_turns``.

    Args:
        model: what is known or to be found by name; the force of the network is added
            in ``force.equations``.
        data: every state measured.
        force: where the force acts, what it depends on, how it is trained.
        l1: weights of ``|coefficient|``, as for `identify`.
        pruning: of terms, from the third turn on, when the network has taken its part.
        integrator: the scheme of the defects, as that of `PHSILoss`.
        seed: of the network's first weights and of the order of the batches.
        max_turns: limit of the turns.

    Raises:
        DataError: if data and model do not match.
        ModelError: for unknown names or integrators, or without torch.
        SolveError: if the solver fails.
    """
    began = time.perf_counter()
    record = aligned_once(model, data)
    trained = TrainedForce.of(model, force.equations, force.variables)
    grid = complete_intervals(model, grid_of(record))
    rule = integrators.integrator(integrator)
    problem = _Problem(grid, trained.equations, trained.rows, rule)
    at_stages = np.zeros((grid.n_intervals, len(rule.shares), len(trained.rows)))
    fit: Fit | None = None
    turns = []
    converged = False
    for turn in range(max_turns):
        before = (model, at_stages)
        # By the third turn the network has taken its part, and what is small is small
        # beside it.
        prune = pruning if turn > 1 else None
        forced, inputs = problem.forced(*before)
        aligned = AlignedData(record, inputs)
        task = Task(forced, aligned, l1_weights(l1), prune, SolverSettings())
        fit = fit_of_task(PHSILoss(integrator), task, fit)
        model = without_signals(fit.model)
        stages = problem.training_set(model, at_stages)
        in_turn = replace(
            force,
            epochs=max(force.epochs // 4, 1) if turn > 0 else force.epochs,
            learning_rate=force.learning_rate * 0.8**turn,
        )
        trained = train(in_turn, trained, stages, seed)
        trained = problem.with_best_output(trained, model, stages)
        at_stages = trained.at(stages.stages)
        row = problem.changes(*before, model, at_stages)
        turns.append({"turn": turn + 1, **row})
        converged = row["coefficient_change"] < 1e-3 and row["force_change"] < 1e-2
        if converged and turn > (2 if pruning else 0):
            break
    assert fit is not None
    return Hybrid(
        model=model,
        hold=checked_hold(record.hold, record.inputs),
        seconds=time.perf_counter() - began,
        removed=fit.removed,
        fit=fit,
        force=trained,
        convergence=pd.DataFrame(turns),
        converged=converged,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Hybrid(Identified):
    """Result of `hybrid`: dx/dt = dictionary model + force of the network.

    Attributes:
        fit: the dictionary part, identified beside the force.
        force: the trained network.
        convergence: a row per turn with turn, loss (mean squared defect),
            coefficient_change (largest change of a coefficient, relative to the largest
            of its slot), force_change (root mean square, relative to the force) and
            n_terms.
        converged: whether neither moved any more in the last turn.
    """

    fit: Fit
    force: TrainedForce
    convergence: pd.DataFrame
    converged: bool

    @property
    def loss_value(self) -> float:
        """Mean squared defect with the force."""
        return float(self.convergence["loss"].iloc[-1])

    @property
    def std_errors(self) -> dict[str, float]:
        """Standard error by name at the trained force, whose own error is not in it."""
        return {name: self.fit.std_errors[name] for name in self.model.entries}

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) with the force of the network, by SciPy.

        Args:
            t: increasing times (n_samples,).
            x0: states (n_states,) at t[0].
            u: inputs (n_samples, n_inputs) at t; None for a model without inputs.
        """
        return simulate_forced(self.model, t, x0, u, self._added, hold=self.hold)

    def _added(self, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """What the network adds to dx/dt, (n_states,)."""
        total = np.zeros(self.model.n_states)
        inputs = u[: len(self.model.inputs)]  # without delayed ones
        total[self.force.rows] = self.force.at(np.r_[x, inputs, t][None])[0]
        return total

    def without_force(self) -> Fit:
        """The dictionary alone: the system with the outside force switched off."""
        return replace(self.fit, model=self.model)

    def equations(self) -> list[str]:
        """The right-hand sides; the network appears by its name."""
        inside = ", ".join(self.force.variables)
        lines = super().equations()
        for row in self.force.rows:
            lines[row] += f" + network_{self.model.states[row]}({inside})"
        return lines

    def save(self, path: str | Path) -> None:
        """Write dictionary, network and table of turns as JSON.

        The file holds numbers and formulas, no code.
        """
        content = {
            "format": FORMAT,
            "fit": self.fit.content(),
            "force": encoded(self.force),
            "convergence": self.convergence.to_dict("list"),
            "converged": self.converged,
            "seconds": self.seconds,
        }
        write_whole(path, json.dumps(content) + "\n")

    @staticmethod
    def load(path: str | Path) -> "Hybrid":
        """Read what `save` wrote; never runs code from the file.

        Raises:
            DataError: for anything else.
        """
        return read_json(path, FORMAT, "a hybrid", _from_content)

    def __str__(self) -> str:
        last = self.convergence.iloc[-1]
        ended = "stopped at the limit of alternations, not converged"
        if self.converged:
            ended = "converged"
        turns = (
            f"  {len(self.convergence)} alternations with the network, "
            f"{self.seconds:.1f} s: {ended} (last change of a coefficient "
            f"{last['coefficient_change']:.1e}, of the force "
            f"{last['force_change']:.1e})"
        )
        return "\n".join([str(self.fit), *self.equations(), turns])

    __repr__ = __str__


def _from_content(content: dict[str, Any]) -> Hybrid:
    fit = Fit.from_content(content["fit"])
    model = without_signals(fit.model)
    stored = decoded(TrainedForce, content["force"])
    stored.network.check_sizes(len(stored.variables), len(stored.equations))
    known = (stored.equations, stored.variables, stored.network)
    return Hybrid(
        model=model,
        hold=fit.hold,
        seconds=float(content["seconds"]),
        removed=fit.removed,
        fit=fit,
        force=TrainedForce.of(model, *known),
        convergence=pd.DataFrame(content["convergence"]),
        converged=bool(content["converged"]),
    )


# ---- one turn ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Problem:
    """What stays the same in all turns: the grid without the force, where it acts."""

    # The defects are linear in the output weights of the network, and nearly linear in
    # the coefficients of the dictionary. Forces are (n_intervals, n_stages,
    # n_equations).

    grid: Grid
    equations: tuple[str, ...]
    rows: list[int]
    rule: Integrator

    def forced(self, model: Model, force: np.ndarray) -> tuple[Model, Grid]:
        """The dictionary and the grid with a force as inputs."""
        forced = with_signals(model, self.equations, self.rule)
        return forced, with_force(self.grid, force, self.rule)

    def defects(self, model: Model, force: np.ndarray) -> ParameterSlopes:
        """Of a dictionary beside a force, with their slopes in its coefficients."""
        forced, grid = self.forced(model, force)
        return parameter_slopes(forced, grid, self.rule.name, forced.theta)

    def training_set(self, model: Model, force: np.ndarray) -> TrainingSet:
        """The stages of the integrator, and the mean force that is missing there."""
        forced, grid = self.forced(model, force)
        grid = grid.driven(forced, forced.theta)
        theta = np.repeat(forced.theta[:, None], grid.n_intervals, axis=1)

        def rates(x: np.ndarray, share: float) -> np.ndarray:
            points = Points(x.T, *_inputs_and_times(grid, share), theta)
            return points.values(forced.rhs()).T

        ends = (grid.y[grid.begin].T, grid.y[grid.begin + 1].T)
        states = self.rule.states(rates, *ends, grid.h[None, :])
        stages = []
        for x, share in zip(states, self.rule.shares, strict=True):
            u, t = _inputs_and_times(self.grid, share)
            stages.append(np.column_stack([x.T, u, t]))
        trajectory = self.grid.runs
        folds = trajectory % N_FOLDS
        if trajectory[-1] + 1 < N_FOLDS:  # blocks of few trajectories
            folds = np.arange(len(trajectory)) * N_FOLDS // len(trajectory)
        weights = np.array(self.rule.weights) / sum(self.rule.weights)
        target = self.defects(model, force).d[:, self.rows]
        target = target + np.tensordot(force, weights, axes=(1, 0))
        return TrainingSet(np.stack(stages, axis=1), weights, target, folds)

    def with_best_output(
        self, trained: TrainedForce, model: Model, data: TrainingSet
    ) -> TrainedForce:
        """Output weights by ridge regression over all defects."""
        # Every coefficient of H and R may take a step with them.
        known = self.defects(model, trained.at(data.stages))
        d = known.d.copy()
        d[:, self.rows] = data.target  # without the force
        units = data.mean(trained.network.features(trained.values_in(data.stages)))
        features = np.hstack([units, np.ones((len(d), 1))])
        n_forces = len(self.rows)
        of_outputs = np.zeros((*d.shape, n_forces, features.shape[1]))
        of_outputs[:, self.rows, np.arange(n_forces)] = -features[:, None]
        of_theta = known.slopes.reshape(*d.shape, -1)
        n_theta = of_theta.shape[2]
        columns = np.concatenate([of_theta, of_outputs.reshape(*d.shape, -1)], axis=2)
        ridged = np.arange(columns.shape[2]) >= n_theta
        step = cross_validated_ridge(columns, d, data.folds, ridged)
        output = step[n_theta:].reshape(n_forces, -1)
        layers = (*trained.network.layers[:-1], (output[:, :-1], output[:, -1]))
        return replace(trained, network=replace(trained.network, layers=layers))

    def changes(
        self,
        before: Model,
        old_force: np.ndarray,
        after: Model,
        new_force: np.ndarray,
    ) -> dict[str, float]:
        """A row of the table of convergence; see `Hybrid.convergence`."""
        d = self.defects(after, new_force).d
        size = max(rms(new_force), LEAST_SIZE)
        return {
            "loss": float(np.mean(np.sum(d**2, axis=1))),
            "coefficient_change": _coefficient_change(before, after),
            "force_change": rms(new_force - old_force) / size,
            "n_terms": len(after.free),
        }


def _inputs_and_times(grid: Grid, share: float) -> tuple[np.ndarray, np.ndarray]:
    """At a share of the steps, (n_intervals, n_inputs) and (n_intervals,)."""
    u = grid.u0 + share * (grid.u1 - grid.u0)
    return u, grid.t[grid.begin] + share * grid.h


def _coefficient_change(before: Model, after: Model) -> float:
    """Largest change of a coefficient, relative to the largest of its slot."""
    old = pd.Series(before.values)
    new = pd.Series(after.values).reindex(old.index, fill_value=0.0)
    slots = [entry.slot for entry in before.entries.values()]
    sizes = new.abs().groupby(slots).transform("max").clip(lower=LEAST_SIZE)
    changes = (new - old).abs() / sizes
    return float(changes.to_numpy().max(initial=0.0))


# ---- the force as inputs -------------------------------------------------------------
#
# The solver sees the network's force as it sees measured inputs. Over each step it is
# the polynomial in the share of the step that passes through it at the nodes of the
# integrator: its coefficients are inputs that stay, and the share is one that rises
# from 0 to 1.


def with_signals(model: Model, equations: Sequence[str], rule: Integrator) -> Model:
    """The model with the force's inputs, each added to its equation."""
    powers = range(len(rule.nodes))
    F = dict(model.F)
    for equation in equations:
        added = [Term(f"{SIGNAL}{equation}_{k}*{STEP_SHARE}**{k}") for k in powers]
        F[equation] = Dictionary((*model.F.get(equation, ()), *added))
    names = [f"{SIGNAL}{equation}_{k}" for k in powers for equation in equations]
    return replace(model, inputs=(*model.inputs, *names, STEP_SHARE), F=F)


def without_signals(model: Model) -> Model:
    """The inverse of `with_signals`, with the values that the model has now."""
    inputs = tuple(name for name in model.inputs if not name.startswith(SIGNAL))
    F = {}
    for equation, terms in model.F.items():
        kept = tuple(term for term in terms if SIGNAL not in term.body)
        if kept:
            F[equation] = Dictionary(kept)
    return replace(model, inputs=inputs, F=F)


def with_force(grid: Grid, force: np.ndarray, rule: Integrator) -> Grid:
    """The grid with the force (n_intervals, n_stages, n_equations) as inputs.

    Where two stages are at one node (RK4's middle), it passes through the mean of both.
    """
    shares = np.array(rule.shares)
    at_nodes = np.stack([force[:, shares == c].mean(axis=1) for c in rule.nodes])
    powers = np.vander(rule.nodes, increasing=True)
    held = np.hstack([*np.tensordot(np.linalg.inv(powers), at_nodes, axes=1)])
    share = np.zeros((grid.n_intervals, 1))
    at_begin = np.hstack([held, share])
    u = np.zeros((grid.n_nodes, at_begin.shape[1]))
    u[grid.begin] = at_begin
    return replace(
        grid,
        u0=np.hstack([grid.u0, at_begin]),
        u1=np.hstack([grid.u1, held, share + 1]),
        u=np.hstack([grid.u, u]),
    )
