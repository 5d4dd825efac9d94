"""Models of the package in torch: dx/dt = (S - R) grad H + F from a vector of numbers.

Monomials are one matrix product: the gradient of a polynomial energy and the polynomial
forces are B(x, u, t) C with B the monomials and C linear in the coefficients. Other
terms are evaluated from their text.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from phsi_opt.baselines.torch_polynomials import (
    Cell,
    Polynomials,
    gradient_cells,
    monomial,
)
from phsi_opt.model.backends import Backend, functions_of
from phsi_opt.model.expressions import names_of
from phsi_opt.model.model import Model
from phsi_opt.model.slots import PlacedTerm, place_of
from phsi_opt.model.symbolic import Expressions


def _tensors(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """The function for tensors and numbers alike.

    Numbers of a formula are in double precision: they do not change the type of the
    columns they meet.
    """

    def of_tensors(*arguments: Any) -> Tensor:
        columns = []
        for argument in arguments:
            if not isinstance(argument, Tensor):
                argument = torch.tensor(argument, dtype=torch.float64)
            columns.append(argument)
        return function(*columns)

    return of_tensors


IN_TORCH = functions_of(torch, min="minimum", max="maximum")
TORCH = Backend({name: _tensors(function) for name, function in IN_TORCH.items()})


class DictionaryDynamics:
    """A model of the package in torch.

    Args:
        model: with any dictionaries.
        dtype: of its numbers.

    Attributes:
        names: of the parameters in the vector theta: those of ``model.entries``.
    """

    def __init__(self, model: Model, dtype: torch.dtype) -> None:
        self.model = model
        self.names = list(model.entries)
        self.variables = (*model.states, *model.inputs, "t")
        self.structure = torch.tensor(np.array(model.S).T.copy(), dtype=dtype)
        self.cells: list[Cell] = []
        self.text: list[PlacedTerm] = []
        damped: list[tuple[int, int]] = []  # place on the diagonal of R, parameter
        for placed in model.placed():
            body = self._monomial(placed)
            if body is None:
                self.text.append(placed)
                continue
            place = place_of(placed.slot, placed.equation)
            parameter = self.names.index(placed.term.coefficient_name(place))
            if placed.slot == "R" and model.has_energy:
                on_diagonal = model.index(placed.equation) * (model.n_states + 1)
                damped.append((on_diagonal, parameter))
            else:
                self.cells += self._cells(placed, body, parameter)
        pairs = torch.tensor(damped, dtype=torch.long).view(-1, 2)
        self.damped, self.damping = pairs.unbind(1)
        n_columns = model.n_states * (2 if model.has_energy else 1)
        n_variables = len(self.variables)
        self.polynomials = Polynomials(self.cells, n_variables, n_columns, dtype)
        # What the terms that are evaluated from their text read.
        self.text_energy = [placed for placed in self.text if placed.slot == "H"]
        self.text_rates = [placed for placed in self.text if placed.slot != "H"]
        names: list[str] = []
        for placed in self.text:
            names += (entry.name for entry in placed.entries())
        self.read = list(dict.fromkeys(names))
        places = list(map(self.names.index, self.read))
        self.read_at = torch.tensor(places, dtype=torch.long)
        efforts = set(self.model.efforts)
        self.reads_efforts = any(
            placed.slot == "R" or efforts & names_of(placed.term.body)
            for placed in self.text_rates
        )

    def _monomial(self, placed: PlacedTerm) -> tuple[int, ...] | None:
        """The monomial of a term; None for one that is evaluated from its text."""
        term = placed.term
        if term.is_formula or term.inner:
            return None
        body = monomial(term.body, self.variables)
        return None if placed.slot == "R" and body else body

    def _cells(
        self, placed: PlacedTerm, body: tuple[int, ...], parameter: int
    ) -> list[Cell]:
        """A term in the matrix, whose columns are the efforts, then the rates.

        Without an energy the efforts are the states, and have no columns.
        """
        n = self.model.n_states
        if placed.slot == "H":
            return gradient_cells(body, parameter, n)
        i = self.model.index(placed.equation)
        if placed.slot == "R":
            return [Cell((i,), i, parameter, -1.0)]
        return [Cell(body, i + n * self.model.has_energy, parameter)]

    def at(self, theta: Tensor) -> "DictionaryRates":
        """The right-hand side at the parameters, (n_parameters,)."""
        return DictionaryRates(self, theta)


class DictionaryRates:
    """`DictionaryDynamics` at given parameters, as a right-hand side of `torch_steps`.

    The matrices are made once per step of training.

    Args:
        dynamics: the model in torch.
        theta: its parameters, (n_parameters,).
    """

    def __init__(self, dynamics: DictionaryDynamics, theta: Tensor) -> None:
        self.dynamics = dynamics
        self.structure = dynamics.structure
        if len(dynamics.damped):
            damping = theta.index_select(0, dynamics.damping)
            flat = self.structure.reshape(-1)
            damped = flat.index_add(0, dynamics.damped, damping, alpha=-1)
            self.structure = damped.view_as(self.structure)
        self.C = dynamics.polynomials.matrix(theta)
        if dynamics.model.has_energy:
            self.slope, force = self.C.split(dynamics.model.n_states, 1)
            self.C = torch.addmm(force, self.slope, self.structure)
        values: dict[str, Tensor] = {}
        if dynamics.read:
            read = theta.index_select(0, dynamics.read_at).unbind(0)
            values = dict(zip(dynamics.read, read, strict=True))
        # The columns of a batch are told term by term.
        self.term = Expressions(dynamics.model, (), (), None, values, TORCH).term

    def __call__(self, x: Tensor, z: Tensor) -> Tensor:
        """dx/dt, (n_rows, n_states); see `torch_steps.RightHandSide`."""
        d = self.dynamics
        v = torch.cat((x, z), 1)
        features = d.polynomials.features(v)
        dx = features @ self.C
        extra = self._text_efforts(x) if d.text_energy else None
        if extra is not None:
            dx = torch.addmm(dx, extra, self.structure)
        if not d.text_rates:
            return dx
        known = dict(zip(d.variables, v[:, :-1].unbind(1), strict=True))
        if d.reads_efforts:
            efforts = features @ self.slope if d.model.has_energy else x
            efforts = efforts if extra is None else efforts + extra
            known.update(zip(d.model.efforts, efforts.unbind(1), strict=True))
        return self._with_text_rates(dx, known)

    def _with_text_rates(self, dx: Tensor, known: Mapping[str, Tensor]) -> Tensor:
        """dx/dt with the terms of R and F that are evaluated from their text."""
        model = self.dynamics.model
        rates: dict[int, Any] = {}
        for placed in self.dynamics.text_rates:
            i = model.index(placed.equation)
            rate = self.term(placed, known)
            if placed.slot == "R":
                rate = -rate * known[model.efforts[i]]
            rates[i] = rates.get(i, 0.0) + rate
        columns = [torch.as_tensor(rate).expand(len(dx)) for rate in rates.values()]
        added = torch.stack(columns, 1).to(dx.dtype)
        return dx.index_add(1, torch.tensor(list(rates)), added)

    def _text_efforts(self, x: Tensor) -> Tensor:
        """Gradient of the terms of the energy that are not monomials, by torch."""
        with torch.enable_grad():
            if not x.requires_grad:
                x = x.detach().requires_grad_()
            known = dict(zip(self.dynamics.model.states, x.unbind(1), strict=True))
            energy = 0.0 * x[:, 0]
            for placed in self.dynamics.text_energy:
                energy = energy + self.term(placed, known)
            (gradient,) = torch.autograd.grad(energy.sum(), x, create_graph=True)
        return gradient
