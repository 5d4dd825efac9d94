"""PHNN: a pseudo-Hamiltonian model whose energy and force are networks (Eidnes et al.
2023).

dx/dt = (S - R) grad H(x) + F(x, t, u) with S known, a diagonal R to learn, H a network
with tanh and F a network with ReLU or nothing. Trained like the PHSI model, on the same
loss. It predicts; it gives no equations.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from phsi_opt.baselines.descent_settings import (
    DTYPES,
    JointForce,
    check_descent,
    is_count,
    is_size,
    require,
)
from phsi_opt.baselines.network_simulation import input_of, integrated, network_values
from phsi_opt.baselines.torch_dictionary import Network, relu_network
from phsi_opt.baselines.torch_steps import Adam, Progress, Steps, descend
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, ModelError, did_you_mean
from phsi_opt.model.model import Model
from phsi_opt.optimization.torch_threads import one_thread
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.losses import complete_intervals

Layers = tuple[tuple[np.ndarray, np.ndarray], ...]


@dataclass(frozen=True)
class NetworkDescent:
    """How the PHNN is built and how it descends.

    Args:
        learning_rate, weight_decay: of Adam. epochs: passes over the data. batch:
            samples per step.
        hidden: widths of the layers of H, with tanh. force_hidden: widths of the layers
            of F, with ReLU.
        penalty: weight of the mean of |F| over the batch (the thesis: 0.1 for the
            mass-spring).
        integrator: a name in `phsi_opt.integrators`. dtype: "float32" (as the thesis)
            or "float64".
    """

    learning_rate: float = 3e-3
    epochs: int = 150
    batch: int = 32
    hidden: tuple[int, ...] = (100, 100)
    force_hidden: tuple[int, ...] = (100, 100)
    penalty: float = 0.0
    weight_decay: float = 0.0
    integrator: str = "srk4"
    dtype: str = "float32"

    def __post_init__(self) -> None:
        check_descent(self)
        require(
            is_size(self.penalty),
            "penalty",
            self.penalty,
            "a finite number of at least 0",
        )
        for name in ("hidden", "force_hidden"):
            widths = tuple(getattr(self, name))
            require(
                all(is_count(w) for w in widths) and len(widths) > 0,
                name,
                widths,
                "at least one width of 1 or more",
            )
            object.__setattr__(self, name, widths)


@dataclass(frozen=True, eq=False, kw_only=True)
class PHNN:
    """dx/dt = (S - R) grad H(x) + F with trained networks H and F.

    Attributes:
        damping: R_ii by state. energy_layers, force_layers: (weight (n_in, n_out),
            bias) of every layer.
        neural: where the force acts and what it sees; None without force.
        seconds: wall time. loss_value: (1/m) sum |(x1 - x0)/h - Psi|^2 over all data,
            without penalty.
        history: a row per epoch with epoch, loss and n_terms (the number of weights).
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    S: np.ndarray
    damping: dict[str, float]
    energy_layers: Layers
    force_layers: Layers = ()
    neural: JointForce | None = None
    hold: str = "linear"
    seconds: float = float("nan")
    loss_value: float = float("nan")
    history: pd.DataFrame = field(default_factory=pd.DataFrame)
    settings: str = ""
    method: str = "PHNN"

    @property
    def parameters(self) -> pd.DataFrame:
        """Table of the damping, with the columns of `Identified.parameters`; the
        weights are not listed.
        """
        rows = [
            (f"R_{name}", "R", name, value, np.nan, -np.inf, np.inf, "", False)
            for name, value in self.damping.items()
        ]
        return pd.DataFrame(
            rows,
            columns=[
                "name",
                "slot",
                "equation",
                "value",
                "std_error",
                "lower",
                "upper",
                "unit",
                "fixed",
            ],
        )

    def energy(self, x: Any) -> np.ndarray:
        """H(x) - H(0), (n,), at states x (n, n_states): an energy is known up to a
        constant.
        """
        x = self._states(x)
        values = [
            _activations(self.energy_layers, v)[-1] @ self.energy_layers[-1][0]
            for v in (x, np.zeros_like(x[:1]))
        ]
        result: np.ndarray = (values[0] - values[1])[:, 0]
        return result

    def efforts(self, x: Any) -> np.ndarray:
        """grad H, (n, n_states), at states x (n, n_states)."""
        result: np.ndarray = _gradient(
            self.energy_layers, _activations(self.energy_layers, self._states(x))
        )
        return result

    def force(self, x: Any, t: Any = None, u: Any = None) -> np.ndarray:
        """F, (n, n_states), at states x (n, n_states), times t (n,) and inputs u (n,
        n_inputs); zero without force.
        """
        x = self._states(x)
        result = np.zeros((len(x), len(self.states)))
        if self.neural is None:
            return result
        known: dict[str, Any] = dict(zip(self.states, x.T, strict=True))
        known["t"] = t
        known.update(
            zip(
                self.inputs,
                [None] * len(self.inputs) if u is None else np.atleast_2d(u).T,
                strict=True,
            )
        )
        for name in self.neural.variables:
            if known[name] is None:
                raise DataError(
                    f"the force depends on {name!r}; give {'t' if name == 't' else 'u'} beside x."
                )
        v = np.stack(
            [np.broadcast_to(known[name], len(x)) for name in self.neural.variables], 1
        )
        result[:, [self.states.index(name) for name in self.neural.equations]] = (
            network_values(self.force_layers, v)
        )
        return result

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) from x0 at t[0], by SciPy; u is (n_samples,
        n_inputs).
        """
        at = input_of(np.asarray(t, dtype=float), u, len(self.inputs), self.hold)
        exchange = self.S - np.diag(
            [self.damping.get(name, 0.0) for name in self.states]
        )

        def rhs(time: float, x: np.ndarray) -> np.ndarray:
            row = x[None, :]
            dx: np.ndarray = (
                self.efforts(row) @ exchange.T
                + self.force(row, time, at(time)[None, :])
            )[0]
            return dx

        return integrated(rhs, t, x0, self.states)

    def equations(self) -> list[str]:
        """The right-hand sides as text; H and F are networks and have no formula."""
        S, lines = np.asarray(self.S), []
        for i, name in enumerate(self.states):
            parts = [
                f"{S[i, j]:+.6g}*dH_d{other}"
                for j, other in enumerate(self.states)
                if S[i, j]
            ]
            if name in self.damping:
                parts.append(f"{-self.damping[name]:+.6g}*dH_d{name}")
            if self.neural is not None and name in self.neural.equations:
                parts.append(f"+network_{name}({', '.join(self.neural.variables)})")
            lines.append(f"d{name}/dt = {' '.join(parts) or '0'}")
        widths = " x ".join(str(len(bias)) for _, bias in self.energy_layers[:-1])
        return [
            *lines,
            f"H({', '.join(self.states)}) is a network of {widths} units with tanh",
        ]

    def __str__(self) -> str:
        return "\n".join(
            [
                f"{self.method}: loss {self.loss_value:.6g}, {self.seconds:.3g} s",
                *self.equations(),
            ]
        )

    def _states(self, x: Any) -> np.ndarray:
        states = np.atleast_2d(np.asarray(x, dtype=float))
        if states.ndim != 2 or states.shape[1] != len(self.states):
            raise DataError(
                f"x has shape {np.shape(x)}; expected (n, {len(self.states)}), a column per state."
            )
        return states


def phnn(
    data: Measurements,
    S: Any,
    settings: NetworkDescent | None = None,
    damping: Sequence[str] = (),
    force: tuple[Sequence[str], Sequence[str]] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> PHNN:
    """Train H, R and F of dx/dt = (S - R) grad H + F on (1/m) sum |(x1 - x0)/h - Psi|^2
    (Eidnes et al. 2023).

    Args:
        data: every state measured. S: (n_states, n_states), skew-symmetric, in the
            order of the data's states.
        settings: see `NetworkDescent`. damping: states with an entry of R; it starts at
            zero and may change its sign.
        force: (equations, variables) of the force network, such as (["p"], ["t"]); None
            has no force.
        seed: of the weights and of the order of the batches.

    Raises `DataError` for data that do not suit, `ModelError` for unknown names,
    `SolveError` if the loss diverges.
    """
    began = time.perf_counter()
    settings = settings or NetworkDescent()
    model = Model(states=data.states, inputs=data.inputs, S=S)
    neural = (
        None
        if force is None
        else JointForce(tuple(force[0]), tuple(force[1]), settings.force_hidden)
    )
    grid = complete_intervals(model, grid_of(data))
    with one_thread():
        dtype = DTYPES[settings.dtype]
        dynamics = _NetworkDynamics(model, tuple(damping), settings, neural, dtype)
        steps = Steps(grid, settings.integrator, dynamics, dtype)
        generator = torch.Generator().manual_seed(seed)
        adam = Adam(dynamics.start(generator).requires_grad_(), settings.weight_decay)
        history = descend(
            adam,
            lambda flat, tables: steps.loss(flat, tables, settings.penalty),
            steps.arrays,
            steps.n_intervals,
            settings,
            generator,
            progress=progress,
        )
        flat = adam.raw.to(torch.float64)
        exact = _NetworkDynamics(model, tuple(damping), settings, neural, torch.float64)
        final = Steps(grid, settings.integrator, exact, torch.float64)
        value = float(final.loss(flat, final.all_tables()))
        r, energy, outer = exact.parts(flat)
    return PHNN(
        states=data.states,
        inputs=data.inputs,
        S=np.array(model.S),
        neural=neural,
        hold=data.hold,
        damping=dict(zip(damping, r.tolist(), strict=True)),
        energy_layers=_arrays(energy),
        force_layers=_arrays(outer),
        seconds=time.perf_counter() - began,
        loss_value=value,
        history=history,
        settings=str(settings),
    )


class _NetworkDynamics:
    """The right-hand side in torch; the flat vector holds the diagonal of R, the
    weights of H, then those of F.
    """

    def __init__(
        self,
        model: Model,
        damping: tuple[str, ...],
        settings: NetworkDescent,
        neural: JointForce | None,
        dtype: torch.dtype,
    ) -> None:
        n, self.dtype = model.n_states, dtype
        require(
            len(set(damping)) == len(damping),
            "damping",
            damping,
            "each state only once",
        )
        at = [model.index(name, "damping of") for name in damping]
        self.n_damped, self.damped = (
            len(at),
            torch.tensor([i * n + i for i in at], dtype=torch.long),
        )
        self.structure = torch.tensor(np.array(model.S).T.copy(), dtype=dtype)
        self.energy = Network([n, *settings.hidden, 1])
        self.outer: Network | None = None
        self.outside: list[int] = []
        if neural is not None:
            self._place(model, neural)

    def _place(self, model: Model, neural: JointForce) -> None:
        around = (*model.inputs, "t")
        for name in neural.variables:
            if name not in (*model.states, *around):
                known = (*model.states, *around)
                raise ModelError(
                    f"variable {name!r} of the force is unknown; expected names among {', '.join(known)}."
                    f"{did_you_mean(name, known)}"
                )
        self.outside = [i for i, name in enumerate(around) if name in neural.variables]
        variables = (*model.states, *(around[i] for i in self.outside))
        self.seen = torch.tensor([variables.index(name) for name in neural.variables])
        self.rows = torch.tensor(
            [model.index(name, "equation of the force") for name in neural.equations]
        )
        self.outer = Network(
            [len(neural.variables), *neural.hidden, len(neural.equations)]
        )

    def start(self, generator: torch.Generator) -> Tensor:
        """Zero damping, random weights."""
        networks = [self.energy] + ([self.outer] if self.outer else [])
        weights = [network.start(generator, self.dtype) for network in networks]
        return torch.cat([torch.zeros(self.n_damped, dtype=self.dtype), *weights])

    def parts(
        self, flat: Tensor
    ) -> tuple[Tensor, list[tuple[Tensor, Tensor]], list[tuple[Tensor, Tensor]]]:
        """Diagonal of R, layers of H, layers of F."""
        n_energy = len(self.energy.sizes)
        r, *rest = flat.split(
            [
                self.n_damped,
                *self.energy.sizes,
                *(self.outer.sizes if self.outer else ()),
            ]
        )
        return (
            r,
            self.energy.layers(rest[:n_energy]),
            self.outer.layers(rest[n_energy:]) if self.outer else [],
        )

    def features(self, x: Tensor, z: Tensor | None) -> None:
        """Nothing can be computed ahead: all weights move."""

    def at(self, flat: Tensor) -> "_NetworkEvaluation":
        """The right-hand side at the parameters."""
        return _NetworkEvaluation(self, *self.parts(flat))


class _NetworkEvaluation:
    def __init__(
        self, dynamics: _NetworkDynamics, r: Tensor, energy: list[Any], outer: list[Any]
    ) -> None:
        self.d, self.energy, self.outer, self.forces = (
            dynamics,
            energy,
            outer,
            list[Tensor](),
        )
        S = dynamics.structure
        self.structure = (
            S.reshape(-1).index_add(0, dynamics.damped, r, alpha=-1).view_as(S)
            if len(r)
            else S
        )

    def __call__(self, x: Tensor, z: Tensor | None, features: Tensor | None) -> Tensor:
        dx: Tensor = (
            _gradient(self.energy, _activations(self.energy, x)) @ self.structure
        )
        if not self.outer:
            return dx
        seen = (x if z is None else torch.cat((x, z), 1)).index_select(1, self.d.seen)
        self.forces.append(relu_network(self.outer, seen))
        return dx.index_add(1, self.d.rows, self.forces[-1])


def _activations(layers: Sequence[tuple[Any, Any]], v: Any) -> list[Any]:
    """Values of the hidden layers with tanh, of torch or NumPy alike."""
    values = []
    for weight, bias in layers[:-1]:
        v = v @ weight + bias
        v = np.tanh(v) if isinstance(v, np.ndarray) else v.tanh()
        values.append(v)
    return values


def _gradient(layers: Sequence[tuple[Any, Any]], activations: Sequence[Any]) -> Any:
    """Gradient of the network by its inputs, (n_rows, n_inputs), written out so that
    torch derives only once.
    """
    slope = layers[-1][0].T * (1 - activations[-1] ** 2)
    for (weight, _), value in zip(layers[-2:0:-1], activations[-2::-1], strict=True):
        slope = (slope @ weight.T) * (1 - value**2)
    return slope @ layers[0][0].T


def _arrays(layers: list[tuple[Tensor, Tensor]]) -> Layers:
    return tuple(
        (weight.numpy().copy(), bias.numpy().copy()) for weight, bias in layers
    )
