"""Fully connected networks in torch, their weights in one flat vector.

What a trained network is worth without torch is in `joint_force`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np
import torch
from torch import Tensor

from phsi_opt.baselines.joint_force import JointForce, Layers
from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.model import Model

DTYPE_OF = {"float32": torch.float32, "float64": torch.float64}


class Network:
    """Where the weights of a fully connected network stand in a flat vector.

    Args:
        widths: number of inputs, of the units of each hidden layer, of outputs.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        self.shapes: list[tuple[int, ...]] = []
        for n_in, n_out in pairwise(widths):
            self.shapes += [(n_in, n_out), (n_out,)]
        self.sizes = [int(np.prod(shape)) for shape in self.shapes]

    def start(self, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
        """Random weights: uniform within +-1/sqrt(number of inputs), biases alike.

        This is torch's own start of a linear layer.
        """
        parts = []
        for i, size in enumerate(self.sizes):
            weight_shape = self.shapes[i - i % 2]
            bound = 1 / sqrt(weight_shape[0])
            draw = torch.rand(size, generator=generator, dtype=torch.float64)
            parts.append((2 * draw - 1) * bound)
        return torch.cat(parts).to(dtype)

    def layers(self, parts: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
        """(weight (n_in, n_out), bias) per layer from the pieces of the flat vector."""
        shaped = []
        for part, shape in zip(parts, self.shapes, strict=True):
            shaped.append(part.view(shape))
        return list(zip(shaped[::2], shaped[1::2], strict=True))


def relu_network(
    layers: Sequence[tuple[Any, Any]], v: Tensor, first: str = "relu"
) -> Tensor:
    """Value (n_rows, n_outputs) of a network with ReLU between its layers.

    Args:
        layers: (weight (n_in, n_out), bias) of every layer.
        v: inputs (n_rows, n_inputs).
        first: function after the first layer, "relu" or "tanh".
    """
    for i, (weight, bias) in enumerate(layers[:-1]):
        v = torch.addmm(bias, v, weight)
        v = v.tanh() if i == 0 and first == "tanh" else v.relu()
    weight, bias = layers[-1]
    return torch.addmm(bias, v, weight)


def joined(x: Tensor, z: Tensor | None) -> Tensor:
    """States and the columns of (inputs, t), if there are any, side by side."""
    return x if z is None else torch.cat((x, z), 1)


def arrays_of(layers: Sequence[tuple[Tensor, Tensor]]) -> Layers:
    """The layers as NumPy arrays of their own."""
    return tuple(
        (weight.numpy().copy(), bias.numpy().copy()) for weight, bias in layers
    )


@dataclass(frozen=True)
class PlacedForce:
    """A force by a network in a right-hand side.

    Attributes:
        columns: of (states, z) that it depends on.
        rows: equations in which it acts.
        network: its weights' places.
        first: function of its first hidden layer.
    """

    columns: Tensor
    rows: Tensor
    network: Network
    first: str

    @classmethod
    def of(
        cls, force: JointForce, model: Model, variables: Sequence[str]
    ) -> "PlacedForce":
        """The force's place beside a model.

        Args:
            force: by names.
            model: whose equations it acts in.
            variables: names of the columns (states, z) that the right-hand side sees.

        Raises:
            ModelError: if it names an unknown variable or equation.
        """
        known = (*model.states, *model.inputs, "t")
        for name in force.variables:
            if name not in known:
                raise ModelError(
                    f"variable {name!r} of the neural force is unknown; "
                    f"expected names among {', '.join(known)}."
                    f"{did_you_mean(name, known)}"
                )
        columns = [variables.index(name) for name in force.variables]
        what = "equation of the neural force"
        rows = [model.index(name, what) for name in force.equations]
        network = Network([len(columns), *force.hidden, len(rows)])
        return cls(torch.tensor(columns), torch.tensor(rows), network, force.first)

    def value(
        self, layers: Sequence[tuple[Any, Any]], x: Tensor, z: Tensor | None
    ) -> Tensor:
        """The force (n_rows, n_equations) at states x and columns z."""
        variables = joined(x, z).index_select(1, self.columns)
        return relu_network(layers, variables, self.first)
