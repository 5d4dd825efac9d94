"""The result of `hybrid`: a dictionary model and a trained force, and their file."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from phsi_opt.errors import DataError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identified import Identified
from phsi_opt.estimation.json_file import read_json
from phsi_opt.learning.force_signals import without_signals
from phsi_opt.learning.hybrid_network import UNTRAINED, TrainedForce
from phsi_opt.learning.network import Network, numbers
from phsi_opt.simulation.simulate import simulate_forced
from phsi_opt.writing import write_whole

FORMAT = "phsi_opt hybrid 1"
SCALES = ("shift", "spread", "seen")  # of a network, in a file


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
        """Standard error by name at the trained force.

        What the force itself leaves uncertain is not in it.
        """
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
        inputs = np.asarray(u)[: self.model.n_inputs]
        total = np.zeros(self.model.n_states)
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
        network = self.force.network
        layers = [[weights.tolist(), bias.tolist()] for weights, bias in network.layers]
        scales = {name: getattr(network, name).tolist() for name in SCALES}
        force = {
            "equations": list(self.force.equations),
            "variables": list(self.force.variables),
            **scales,
            "layers": layers,
        }
        content = {
            "format": FORMAT,
            "fit": self.fit.content(),
            "force": force,
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
        ended = "stopped at the limit of turns, still moving"
        if self.converged:
            ended = "neither moves any more"
        turns = (
            f"  {len(self.convergence)} turns with the network, {self.seconds:.1f} s: "
            f"{ended} (last change of a coefficient {last['coefficient_change']:.1e}, "
            f"of the force {last['force_change']:.1e})"
        )
        return "\n".join([str(self.fit), *self.equations(), turns])

    __repr__ = __str__


def _from_content(content: dict[str, Any]) -> Hybrid:
    fit = Fit.from_content(content["fit"])
    stored = content["force"]
    equations = tuple(map(str, stored["equations"]))
    model = without_signals(fit.model)
    shift, spread, seen = (numbers(stored[name]) for name in SCALES)
    layers = tuple((numbers(w), numbers(b)) for w, b in stored["layers"])
    network = Network(shift, spread, seen, UNTRAINED.activation, layers)
    force = TrainedForce.of(model, equations, stored["variables"], network)
    if not network.is_of(len(force.variables), len(equations)):
        raise DataError(
            "the layers of the network do not fit together "
            "or to its equations and variables."
        )
    return Hybrid(
        model=model,
        hold=fit.hold,
        seconds=float(content["seconds"]),
        removed=fit.removed,
        fit=fit,
        force=force,
        convergence=pd.DataFrame(content["convergence"]),
        converged=bool(content["converged"]),
    )
