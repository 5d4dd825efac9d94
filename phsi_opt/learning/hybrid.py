"""The hybrid: a dictionary for H and R, and a neural network for a force that has no
simple formula.

    dx/dt = (S - R) grad H(x) + F(x),    F_k(x) = network(x) in the forced equations k

The dictionary is identified by the solver and the network is trained in torch, in
turns, each with the other's latest estimate, on one and the same loss: the defects of
SRK4. A turn is

1. the program for H and R, with the force of the network as an input at the two stages
    of every step;
2. the network on what is left of the forced equations at these stages (Adam);
3. its last layer once more, exactly, by least squares together with every coefficient
   of H and R: what the dictionary can explain is shared out as the joint loss wants it,
   whichever of the two was fitted first.

The network itself, and its training, are in `network`.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, ModelError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify_forced
from phsi_opt.estimation.json_file import read_json
from phsi_opt.estimation.pruning import Pruning
from phsi_opt.estimation.result import Identified
from phsi_opt.learning.network import (
    N_FOLDS,
    NeuralForce,
    TrainedForce,
    cross_validated,
    train,
)
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.simulation.simulate import simulate
from phsi_opt.transcription.alignment import aligned
from phsi_opt.transcription.defects import defect_jacobian, defects
from phsi_opt.transcription.grid import Grid, grid_of
from phsi_opt.transcription.integrators import (
    FIRST_NODE,
    SECOND_NODE,
    srk4_stages,
)
from phsi_opt.transcription.losses import PHSILoss, complete_intervals

__all__ = ["Hybrid", "NeuralForce", "TrainedForce", "hybrid"]
FORMAT = "phsi_opt hybrid 1"


@dataclass(frozen=True, eq=False, kw_only=True)
class Hybrid(Identified):
    """Result of `hybrid`: the dictionary part as a `Fit`, the trained force, and a row
    per turn in ``convergence``.

    The columns of ``convergence``: loss (mean squared defect), coefficient_change
    (largest change of a coefficient, relative to the largest of its slot), force_change
    (root mean square, relative to the force), n_terms.
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
        """Standard error by name at the trained force; what the force itself leaves
        uncertain is not in it.
        """
        return {name: self.fit.std_errors[name] for name in self.model.entries}

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) from x0 at t[0], with the force of the network."""
        return simulate(self.model, t, x0, u, hold=self.hold, force=self._added)

    def without_force(self) -> Fit:
        """The dictionary alone: the system with the outside force switched off."""
        return replace(self.fit, model=self.model)

    def equations(self) -> list[str]:
        """The right-hand sides; the network appears by its name."""
        names = [self.model.states[i] for i in self.force.columns]
        rows = super().equations()
        for row in self.force.rows:
            rows[row] += f" + network_{self.model.states[row]}({', '.join(names)})"
        return rows

    def distilled(self, data: Measurements, knots: int = 12) -> dict[str, Dictionary]:
        """The force as a dictionary of smooth hinges, for a network of one variable:
        then all is one program.

        F(v) = c + a v + sum_k b_k sqrt((v - v_k)^2 + w^2), knots v_k at quantiles of
        the visited values, w half their median distance, coefficients by least squares
        over the data. Raises `ModelError` for more than one variable.
        """
        if len(self.force.columns) != 1:
            raise ModelError(
                f"the network depends on {len(self.force.columns)} variables; only a force of one can be distilled. "
                "Give NeuralForce(variables=...) one state."
            )
        column = self.force.columns[0]
        x = np.concatenate([run.x for run in aligned(self.model, data).trajectories])
        x = x[np.isfinite(x).all(axis=1)]
        visited, name = x[:, column], self.model.states[column]
        at = np.unique(
            np.round(np.quantile(visited, np.linspace(0.0, 1.0, knots + 2)[1:-1]), 6)
        )
        width = round(float(np.median(np.diff(at))) / 2, 6) if len(at) > 1 else 1.0
        bodies = [
            "1",
            name,
            *[f"sqrt(({name} - {v!r})**2 + {width!r}**2)" for v in at.tolist()],
        ]
        grid = np.column_stack(
            [np.ones_like(visited), visited]
            + [np.sqrt((visited - v) ** 2 + width**2) for v in at]
        )
        size = np.sqrt(np.mean(grid**2, axis=0))
        found = (
            np.linalg.lstsq(grid / size, self.force(x), rcond=1e-10)[0] / size[:, None]
        )
        return {
            equation: Dictionary(
                tuple(
                    Term(b, Parameter(float(c)))
                    for b, c in zip(bodies, found[:, k], strict=True)
                )
            )
            for k, equation in enumerate(self.force.equations)
        }

    def save(self, path: str | Path) -> None:
        """Write dictionary, network and table of turns as JSON: numbers and formulas,
        no code.
        """
        force = self.force
        content = {
            "format": FORMAT,
            "fit": self.fit.content(),
            "force": {
                "equations": list(force.equations),
                "variables": [self.model.states[i] for i in force.columns],
                "shift": force.shift.tolist(),
                "spread": force.spread.tolist(),
                "seen": force.seen.tolist(),
                "layers": [
                    [weights.tolist(), bias.tolist()] for weights, bias in force.layers
                ],
            },
            "convergence": self.convergence.to_dict("list"),
            "converged": self.converged,
            "seconds": self.seconds,
        }
        Path(path).write_text(json.dumps(content) + "\n", encoding="utf-8")

    @staticmethod
    def load(path: str | Path) -> "Hybrid":
        """Read what `save` wrote; raises `DataError` for anything else. Never runs code
        from the file.
        """
        return read_json(path, FORMAT, "a hybrid", _from_json)

    def __str__(self) -> str:
        last = self.convergence.iloc[-1]
        ended = (
            "neither moves any more"
            if self.converged
            else "stopped at the limit of turns, still moving"
        )
        lines = [str(self.fit), *self.equations()]
        lines.append(
            f"  {len(self.convergence)} turns with the network, {self.seconds:.1f} s: {ended} (last change of a"
        )
        lines[-1] += (
            f" coefficient {last['coefficient_change']:.1e}, of the force {last['force_change']:.1e})"
        )
        return "\n".join(lines)

    __repr__ = __str__

    def _added(self, t: float, x: np.ndarray) -> np.ndarray:
        total = np.zeros(self.model.n_states)
        total[list(self.force.rows)] = self.force(x)[0]
        return total


def hybrid(
    model: Model,
    data: Measurements,
    force: NeuralForce,
    l1: dict[str, float] | float | None = None,
    pruning: Pruning | None = None,
    *,
    seed: int = 0,
    max_turns: int = 20,
    tolerance: float = 1e-3,
    progress: Callable[[str], None] | None = None,
) -> Hybrid:
    """Identify the dictionary of ``model`` and train a neural force beside it, in turns
    until neither moves.

    ``model`` holds what is known or to be found by name; the force of the network is
    added in ``force.equations``. Terms are pruned from the third turn on, when the
    network has taken its part. Stops when the coefficients move by less than
    ``tolerance`` (relative) and the force by less than ten times that, or after
    ``max_turns``.
    """
    began = time.perf_counter()
    say = progress or (lambda line: None)
    data = aligned(model, data)
    work = _Work.of(model, data, force, seed)
    current, fit, turns, last_force = (
        model,
        None,
        [],
        np.zeros((work.grid.n_intervals, 2, len(work.rows))),
    )
    trained = None
    for turn in range(max_turns):
        prune = pruning if turn >= 2 else None
        fit = identify_forced(
            work.forced(current),
            data,
            PHSILoss(),
            l1,
            prune,
            work.layout(last_force),
            start=fit,
        )
        before, current = current, work.unforced(fit.model)
        stages, target = work.stages(fit, last_force)
        epochs = force.epochs if trained is None else max(force.epochs // 4, 1)
        rate = force.learning_rate * 0.8**turn
        trained = train(
            force,
            work.rows,
            work.columns,
            trained,
            stages,
            target,
            work.folds(),
            epochs,
            rate,
            work.seed,
        )
        trained = work.last_layer(trained, fit, stages, target)
        new_force = np.stack([trained(stages[:, k]) for k in (0, 1)], axis=1)
        row = work.turn(fit, before, current, last_force, new_force)
        turns.append({"turn": turn + 1, **row})
        say(", ".join(f"{key} {value:.4g}" for key, value in turns[-1].items()))
        last_force = new_force
        still = (
            row["coefficient_change"] < tolerance
            and row["force_change"] < 10 * tolerance
        )
        if still and turn > (2 if pruning else 0):
            break
    assert fit is not None and trained is not None
    return Hybrid(
        model=current,
        hold=data.hold,
        seconds=time.perf_counter() - began,
        removed=fit.removed,
        fit=fit,
        force=trained,
        convergence=pd.DataFrame(turns),
        converged=still,
    )


@dataclass(frozen=True, eq=False)
class _Work:
    """What stays the same in all turns."""

    model: Model
    grid: Grid
    settings: NeuralForce
    rows: tuple[int, ...]
    columns: tuple[int, ...]
    seed: int

    @staticmethod
    def of(model: Model, data: Measurements, force: NeuralForce, seed: int) -> "_Work":
        rows = tuple(
            model.index(name, "equation of NeuralForce") for name in force.equations
        )
        variables = model.states if force.variables is None else force.variables
        columns = tuple(
            model.index(name, "variable of NeuralForce") for name in variables
        )
        return _Work(
            model, complete_intervals(model, grid_of(data)), force, rows, columns, seed
        )

    @property
    def signals(self) -> list[str]:
        return [_signal(self.model.states[row]) for row in self.rows]

    def forced(self, model: Model) -> Model:
        """The model with the network's force as an input."""
        added = {
            self.model.states[row]: Dictionary(
                (*model.F.get(self.model.states[row], Dictionary()), Term(signal))
            )
            for row, signal in zip(self.rows, self.signals, strict=True)
        }
        return replace(
            model, inputs=(*model.inputs, *self.signals), F={**model.F, **added}
        )

    def unforced(self, model: Model) -> Model:
        """The inverse of `forced`, with the values found."""
        return _unforced(model, self.signals)

    def with_force(self, force: np.ndarray) -> Grid:
        """The grid with the force as inputs whose straight line passes through its
        values at the two stages.
        """
        slope = (force[:, 1] - force[:, 0]) / (SECOND_NODE - FIRST_NODE)
        begin = force[:, 0] - FIRST_NODE * slope
        at_nodes = np.zeros((self.grid.n_nodes, len(self.rows)))
        at_nodes[self.grid.begin] = begin
        return replace(
            self.grid,
            u0=np.hstack([self.grid.u0, begin]),
            u1=np.hstack([self.grid.u1, begin + slope]),
            u=np.hstack([self.grid.u, at_nodes]),
        )

    def layout(self, force: np.ndarray) -> Callable[[Grid], Grid]:
        """How `identify_forced` lays out the measurements."""
        return lambda grid: self.with_force(force)

    def stages(self, fit: Fit, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Outer stages (n_intervals, 2, n_states) of SRK4 and what the force must add
        there on average.
        """
        grid, model = self.with_force(force), self.forced(self.unforced(fit.model))
        rhs, theta = model.rhs(), [model.values[name] for name in model.free]
        x0, x1, h = grid.y[grid.begin].T, grid.y[grid.begin + 1].T, grid.h[None, :]
        t0 = grid.t[grid.begin][None, :]

        def g(x: np.ndarray, c: float) -> np.ndarray:
            u = (grid.u0 + c * (grid.u1 - grid.u0)).T
            columns = rhs.map(grid.n_intervals)(
                x, u, t0 + c * h, ca.repmat(ca.DM(theta), 1, grid.n_intervals)
            )
            return np.array(columns)

        found = srk4_stages(g, x0, x1, h)
        explained = (g(found.first, FIRST_NODE) + g(found.second, SECOND_NODE)) / 2
        left = ((x1 - x0) / h - explained).T[:, list(self.rows)]
        states = np.stack([found.first.T, found.second.T], axis=1)
        return states, left + force.mean(axis=1)

    def last_layer(
        self, trained: TrainedForce, fit: Fit, stages: np.ndarray, target: np.ndarray
    ) -> TrainedForce:
        """Output weights by least squares over all defects, together with a step of
        every coefficient of H and R.
        """
        n_rows, n_out = self.grid.n_intervals, len(self.rows)
        force = np.stack([trained(stages[:, k]) for k in (0, 1)], axis=1)
        model = self.forced(self.unforced(fit.model))
        grid, theta = (
            self.with_force(force),
            model.theta,
        )
        jacobian = np.array(
            defect_jacobian(model, grid, "srk4")(grid.y.T, theta)
        ).reshape(n_rows, -1, len(theta))
        d = np.array(defects(model, grid, "srk4", grid.y.T, theta)).T
        features = np.mean([trained.features(stages[:, k]) for k in (0, 1)], axis=0)
        features = np.hstack([features, np.ones((n_rows, 1))])
        d[:, list(self.rows)] = target  # without the force
        n_theta, n_features = len(theta), features.shape[1]
        whole = np.zeros((n_rows, d.shape[1], n_theta + n_out * n_features))
        whole[:, :, :n_theta] = jacobian
        for k, row in enumerate(self.rows):
            whole[
                :, row, n_theta + k * n_features : n_theta + (k + 1) * n_features
            ] = -features
        step = cross_validated(
            whole, d, self.folds(), np.arange(whole.shape[2]) >= n_theta
        )
        output = step[n_theta:].reshape(n_out, n_features)
        return replace(
            trained, layers=(*trained.layers[:-1], (output[:, :-1], output[:, -1]))
        )

    def folds(self) -> np.ndarray:
        """Number of the fold of every interval: whole trajectories, or blocks where
        there are fewer than `N_FOLDS`.
        """
        trajectory = self.grid.trajectory[self.grid.begin]
        n = int(trajectory[-1]) + 1
        return (
            trajectory % N_FOLDS
            if n >= N_FOLDS
            else np.arange(len(trajectory)) * N_FOLDS // len(trajectory)
        )

    def turn(
        self,
        fit: Fit,
        before: Model,
        after: Model,
        old_force: np.ndarray,
        new_force: np.ndarray,
    ) -> dict[str, float]:
        """A row of the table of convergence."""
        model, grid = self.forced(after), self.with_force(new_force)
        theta = [model.values[name] for name in model.free]
        d = np.array(defects(model, grid, "srk4", grid.y.T, theta))
        change = 0.0
        for slot in ("H", "R", "F"):
            names = [
                name for name, entry in before.entries.items() if entry.slot == slot
            ]
            now = np.array([after.values.get(name, 0.0) for name in names])
            moved = np.abs(now - np.array([before.values[name] for name in names]))
            change = max(
                change,
                float(
                    np.max(moved, initial=0.0)
                    / max(np.max(np.abs(now), initial=0.0), 1e-12)
                ),
            )
        size = max(float(np.sqrt(np.mean(new_force**2))), 1e-12)
        return {
            "loss": float(np.mean(np.sum(d**2, axis=0))),
            "coefficient_change": change,
            "force_change": float(np.sqrt(np.mean((new_force - old_force) ** 2)))
            / size,
            "n_terms": len(after.free),
        }


def _signal(equation: str) -> str:
    return f"network_{equation}"


def _unforced(model: Model, signals: Sequence[str]) -> Model:
    kept = {
        equation: Dictionary(tuple(term for term in terms if term.body not in signals))
        for equation, terms in model.F.items()
    }
    inputs = tuple(name for name in model.inputs if name not in signals)
    return replace(
        model,
        inputs=inputs,
        F={name: terms for name, terms in kept.items() if len(terms)},
    )


def _from_json(content: dict[str, Any]) -> Hybrid:
    fit, stored = Fit.from_content(content["fit"]), content["force"]
    equations = tuple(str(name) for name in stored["equations"])
    model = _unforced(fit.model, [_signal(name) for name in equations])
    layers = tuple(
        (np.array(w, dtype=float), np.array(b, dtype=float))
        for w, b in stored["layers"]
    )
    columns = tuple(
        model.index(name, "variable of the network") for name in stored["variables"]
    )
    rows = tuple(model.index(name, "equation of the network") for name in equations)
    shift, spread, seen = (
        np.array(stored[name], dtype=float) for name in ("shift", "spread", "seen")
    )
    sizes = [len(columns), *(len(b) for _, b in layers)]
    fitting = [
        w.shape == (n_out, n_in)
        for (w, _), n_in, n_out in zip(layers, sizes, sizes[1:], strict=False)
    ]
    if (
        not all(fitting)
        or sizes[-1] != len(rows)
        or shift.shape != (len(columns),)
        or any(array.shape[-1:] != shift.shape for array in (spread, seen))
    ):
        raise DataError(
            "the layers of the network do not fit together or to its equations and variables."
        )
    return Hybrid(
        model=model,
        hold=fit.hold,
        seconds=float(content["seconds"]),
        removed=fit.removed,
        fit=fit,
        force=TrainedForce(equations, columns, rows, shift, spread, seen, layers),
        convergence=pd.DataFrame(content["convergence"]),
        converged=bool(content["converged"]),
    )
