"""Fully connected networks in torch, and a force by one in a right-hand side.

What a trained network is worth without torch is in `joint_force`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt

import torch
from torch import Tensor

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.model import Model
from problems.peers.joint_force import JointForce, Layers

TorchLayers = list[tuple[Tensor, Tensor]]  # (weight (n_in, n_out), bias) of every layer


def random_layers(
    widths: Sequence[int], generator: torch.Generator, dtype: torch.dtype
) -> TorchLayers:
    """Uniform within +-1/sqrt(number of inputs), biases alike, as torch does."""

    def drawn(bound: float, *shape: int) -> Tensor:
        draw = torch.rand(shape, generator=generator, dtype=torch.float64)
        return ((2 * draw - 1) * bound).to(dtype).requires_grad_()

    layers = []
    for n_in, n_out in pairwise(widths):
        bound = 1 / sqrt(n_in)
        weight = drawn(bound, n_in, n_out)
        layers.append((weight, drawn(bound, n_out)))
    return layers


def parameters_of(layers: TorchLayers) -> list[Tensor]:
    """All weights and biases, to be trained."""
    return [parameter for layer in layers for parameter in layer]


def as_type(layers: TorchLayers, dtype: torch.dtype) -> TorchLayers:
    """The layers in another precision."""
    return [(weight.to(dtype), bias.to(dtype)) for weight, bias in layers]


def arrays_of(layers: TorchLayers) -> Layers:
    """The layers as NumPy arrays of their own, in double precision."""
    arrays = []
    for weight, bias in layers:
        pair = (weight.detach().double().numpy(), bias.detach().double().numpy())
        arrays.append((pair[0].copy(), pair[1].copy()))
    return tuple(arrays)


def relu_network(layers: TorchLayers, v: Tensor, first: str = "relu") -> Tensor:
    """Value (n_rows, n_outputs) of a network with ReLU between its layers."""
    for i, (weight, bias) in enumerate(layers[:-1]):
        v = torch.addmm(bias, v, weight)
        v = v.tanh() if i == 0 and first == "tanh" else v.relu()
    weight, bias = layers[-1]
    return torch.addmm(bias, v, weight)


@dataclass(frozen=True)
class PlacedForce:
    """A force by a network in a right-hand side.

    Attributes:
        columns: of (states, inputs, t) that it depends on.
        rows: equations in which it acts.
        widths: of its network's layers, inputs and outputs among them.
        first: function of its first hidden layer.
    """

    columns: Tensor
    rows: Tensor
    widths: tuple[int, ...]
    first: str

    @classmethod
    def of(cls, force: JointForce, model: Model) -> "PlacedForce":
        """The force's place beside a model."""
        known = (*model.states, *model.inputs, "t")
        for name in force.variables:
            if name not in known:
                raise ModelError(
                    f"variable {name!r} of the neural force is unknown; "
                    f"expected names among {', '.join(known)}."
                    f"{did_you_mean(name, known)}"
                )
        columns = [known.index(name) for name in force.variables]
        what = "equation of the neural force"
        rows = [model.index(name, what) for name in force.equations]
        widths = (len(columns), *force.hidden, len(rows))
        return cls(torch.tensor(columns), torch.tensor(rows), widths, force.first)

    def value(self, layers: TorchLayers, x: Tensor, z: Tensor) -> Tensor:
        """The force (n_rows, n_equations) at states x and z; see `torch_steps`."""
        variables = torch.cat((x, z), 1).index_select(1, self.columns)
        return relu_network(layers, variables, self.first)
