"""Models of the package in torch: dx/dt = (S - R) grad H + F from one flat vector.

Monomials are one matrix product: the gradient of a polynomial energy is B(x) W(xi) with
B the monomials of lower degree and W linear in the coefficients. Other terms are
evaluated from their text.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from phsi_opt.baselines.joint_force import JointForce
from phsi_opt.baselines.torch_monomials import (
    Basis,
    Exponents,
    combination,
    lowered,
    monomial,
)
from phsi_opt.baselines.torch_networks import Network, PlacedForce, joined
from phsi_opt.model.backends import Backend
from phsi_opt.model.expressions import evaluate, names_of
from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
from phsi_opt.model.slots import place_of
from phsi_opt.model.terms import Term


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


TORCH = Backend(
    {
        "sin": _tensors(torch.sin),
        "cos": _tensors(torch.cos),
        "tan": _tensors(torch.tan),
        "atan": _tensors(torch.atan),
        "exp": _tensors(torch.exp),
        "log": _tensors(torch.log),
        "sqrt": _tensors(torch.sqrt),
        "tanh": _tensors(torch.tanh),
        "abs": _tensors(torch.abs),
        "sign": _tensors(torch.sign),
        "min": _tensors(torch.minimum),
        "max": _tensors(torch.maximum),
    }
)


@dataclass(frozen=True)
class _Cell:
    """A coefficient in a matrix: of which monomial, in which column, times what."""

    exponents: Exponents
    column: int
    parameter: int
    factor: float


@dataclass(frozen=True)
class _TextTerm:
    """A term that is evaluated from its text."""

    slot: str
    equation: str
    term: Term

    @property
    def place(self) -> str:
        """Name of the slot of the equation, such as 'F_p'."""
        return place_of(self.slot, self.equation)

    def reads(self, names: Iterable[str]) -> bool:
        """Whether its formula holds one of the names."""
        return not names_of(self.term.body).isdisjoint(names)


@dataclass(frozen=True)
class _Diagonal:
    """A constant damping: its state and its parameter."""

    state: int
    parameter: int


@dataclass(frozen=True)
class _SortedTerms:
    """Where the terms go: into two matrices, onto a diagonal, or to their text."""

    energy: list[_Cell] = field(default_factory=list)
    force: list[_Cell] = field(default_factory=list)
    diagonal: list[_Diagonal] = field(default_factory=list)
    text: list[_TextTerm] = field(default_factory=list)

    @classmethod
    def of(cls, model: Model, variables: tuple[str, ...]) -> "_SortedTerms":
        """The terms of the model, with monomials in the variables."""
        terms = cls()
        index = {name: i for i, name in enumerate(model.entries)}
        for slot, equation, term in model.placed():
            exponents = _exponents(term, variables)
            if exponents is None or (slot == "R" and any(exponents)):
                terms.text.append(_TextTerm(slot, equation, term))
                continue
            parameter = index[term.coefficient_name(place_of(slot, equation))]
            if slot == "H":
                terms.energy.extend(_gradient(exponents, model.n_states, parameter))
            elif slot == "F":
                row = model.index(equation)
                terms.force.append(_Cell(exponents, row, parameter, 1.0))
            else:
                terms.diagonal.append(_Diagonal(model.index(equation), parameter))
        return terms


def _exponents(term: Term, variables: tuple[str, ...]) -> Exponents | None:
    if term.is_formula or term.inner:
        return None
    return monomial(term.body, variables)


def _gradient(exponents: Exponents, n_states: int, parameter: int) -> list[_Cell]:
    """Cells of the derivatives of a monomial of the energy by the states."""
    cells = []
    for k in range(n_states):
        power = exponents[k]
        if power:
            slope = lowered(exponents, k)
            cells.append(_Cell(slope, k, parameter, float(power)))
    return cells


class DictionaryDynamics:
    """A model of the package in torch, all parameters in one flat vector.

    dx/dt = (S - R) grad H + F. The vector holds every parameter of ``model.entries`` in
    their order, then the weights of the force network.

    Args:
        model: with any dictionaries.
        dtype: of the parameters and the matrices.
        force: a force network beside them, or None.

    Raises:
        ModelError: if the force names an unknown variable or equation.
    """

    def __init__(
        self, model: Model, dtype: torch.dtype, force: JointForce | None = None
    ) -> None:
        self.model = model
        self.dtype = dtype
        self.names = list(model.entries)
        around = (*model.inputs, "t")
        used = _names_used(model, force)
        self.outside = [i for i, name in enumerate(around) if name in used]
        self.variables = (*model.states, *(around[i] for i in self.outside))
        terms = _SortedTerms.of(model, self.variables)
        self._list_text_terms(terms.text)
        self.has_energy = (
            isinstance(model, PseudoHamiltonian)
            or bool(terms.diagonal)
            or self.needs_efforts
        )
        self._place_matrices(terms)
        self.force: PlacedForce | None = None
        if force is not None:
            self.force = PlacedForce.of(force, model, self.variables)

    @property
    def network(self) -> Network | None:
        """The network of the force; None without force."""
        return self.force.network if self.force else None

    def _list_text_terms(self, terms: list[_TextTerm]) -> None:
        """What the terms that are evaluated from their text need to know."""
        self.text_energy = [text for text in terms if text.slot == "H"]
        self.text_rates = [text for text in terms if text.slot != "H"]
        self.needs_efforts = False
        for text in terms:
            reads = text.slot == "R" or text.reads(self.model.efforts)
            self.needs_efforts = self.needs_efforts or reads
        self.reads_states = False
        for text in self.text_rates:
            reads = text.slot == "R" or text.reads(self.model.states)
            self.reads_states = self.reads_states or reads
        self.read = _parameters_of(terms)
        places = [self.names.index(name) for name in self.read]
        self.read_at = torch.tensor(places, dtype=torch.long)

    def _place_matrices(self, terms: _SortedTerms) -> None:
        n = self.model.n_states
        cells = terms.energy + terms.force
        # The efforts of a first-order model are its states: a gradient of ones.
        units: list[Exponents] = []
        if isinstance(self.model, FirstOrder) and self.has_energy:
            units = [_unit(k, len(self.variables)) for k in range(n)]
        exponents = [cell.exponents for cell in cells] + units
        self.basis = Basis(exponents, len(self.variables), n, self.dtype)
        position = self.basis.position
        size = len(self.basis) * n
        self.fixed = torch.zeros(2 * size, dtype=self.dtype)
        for k, unit in enumerate(units):
            self.fixed[position[unit] * n + k] = 1.0
        places = [position[cell.exponents] * n + cell.column for cell in cells]
        for i in range(len(terms.energy), len(cells)):
            places[i] += size
        self.cells = torch.tensor(places, dtype=torch.long)
        self.sources = torch.tensor([c.parameter for c in cells], dtype=torch.long)
        self.factors = torch.tensor([c.factor for c in cells], dtype=self.dtype)
        self.structure = torch.tensor(np.array(self.model.S).T.copy(), dtype=self.dtype)
        on_diagonal = [row.state * n + row.state for row in terms.diagonal]
        self.damped = torch.tensor(on_diagonal, dtype=torch.long)
        damping = [row.parameter for row in terms.diagonal]
        self.damping = torch.tensor(damping, dtype=torch.long)

    def features(self, x: Tensor, z: Tensor | None) -> Tensor:
        """The monomials, (n_rows, n_monomials)."""
        return self.basis.features(joined(x, z))

    def at(self, flat: Tensor) -> "DictionaryEvaluation":
        """The right-hand side at the parameters."""
        if self.network is None:
            return DictionaryEvaluation(self, flat, [])
        theta, *weights = flat.split([len(self.names), *self.network.sizes])
        return DictionaryEvaluation(self, theta, self.network.layers(weights))


def _names_used(model: Model, force: JointForce | None) -> set[str]:
    """Names that the terms and the force read."""
    used: set[str] = set()
    for _, _, term in model.placed():
        used |= names_of(term.body)
    if force is not None:
        used |= set(force.variables)
    return used


def _parameters_of(terms: list[_TextTerm]) -> list[str]:
    """Parameters of the terms, inner ones first, each once."""
    names = []
    for text in terms:
        names += [text.term.inner_name(name, text.place) for name in text.term.inner]
    for text in terms:
        if not text.term.is_formula:
            names.append(text.term.coefficient_name(text.place))
    return list(dict.fromkeys(names))


def _unit(k: int, n_variables: int) -> Exponents:
    """Exponents of the variable k itself."""
    exponents = [0] * n_variables
    exponents[k] = 1
    return tuple(exponents)


class DictionaryEvaluation:
    """`DictionaryDynamics` at given parameters.

    The matrices are made once per step of training.

    Args:
        dynamics: the model in torch.
        theta: its parameters, (n_parameters,).
        layers: of the force network; [] without force.
    """

    def __init__(
        self,
        dynamics: DictionaryDynamics,
        theta: Tensor,
        layers: list[tuple[Tensor, Tensor]],
    ) -> None:
        self.dynamics = dynamics
        self.layers = layers
        self.forces: list[Tensor] = []
        self.structure = self._structure_minus_damping(theta)
        self.C = self._matrix(theta)
        self.values: dict[str, Tensor] = {}
        if dynamics.read:
            read = theta.index_select(0, dynamics.read_at).unbind(0)
            self.values = dict(zip(dynamics.read, read, strict=True))

    def _structure_minus_damping(self, theta: Tensor) -> Tensor:
        """(S - R)' with the constant damping."""
        d = self.dynamics
        if not len(d.damped):
            return d.structure
        diagonal = theta.index_select(0, d.damping)
        flat = d.structure.reshape(-1).index_add(0, d.damped, diagonal, alpha=-1)
        return flat.view_as(d.structure)

    def _matrix(self, theta: Tensor) -> Tensor:
        """C of dx/dt = B(x) C; beside it, if needed, that of the efforts grad H."""
        d = self.dynamics
        entries = theta.index_select(0, d.sources) * d.factors
        filled = d.fixed.index_add(0, d.cells, entries)
        gradient, force = filled.view(2, -1, d.model.n_states).unbind(0)
        C = force
        if d.has_energy:
            C = torch.addmm(force, gradient, self.structure)
        return torch.cat((C, gradient), 1) if d.needs_efforts else C

    def __call__(self, x: Tensor, z: Tensor | None, features: Tensor | None) -> Tensor:
        """dx/dt, (n_rows, n_states); see `torch_defects.Evaluation`."""
        d = self.dynamics
        if features is None:
            dx = combination(x, z, self.C, d.basis)
        else:
            dx = features @ self.C
        efforts = None
        if d.needs_efforts:
            dx, efforts = dx.split(d.model.n_states, 1)
        if d.text_energy:
            extra = self._other_efforts(x)
            dx = dx + extra @ self.structure
            efforts = None if efforts is None else efforts + extra
        if d.text_rates:
            dx = self._with_rates(dx, x, self._known(x, z, efforts))
        if d.force is not None:
            self.forces.append(d.force.value(self.layers, x, z))
            dx = dx.index_add(1, d.force.rows, self.forces[-1])
        return dx

    def _known(
        self, x: Tensor, z: Tensor | None, efforts: Tensor | None
    ) -> dict[str, Tensor]:
        """Columns by the names that formulas may hold."""
        d = self.dynamics
        outside = () if z is None else z.unbind(1)
        known = dict(zip(d.variables[d.model.n_states :], outside, strict=True))
        if d.reads_states:
            known.update(zip(d.model.states, x.unbind(1), strict=True))
        if efforts is not None:
            known.update(zip(d.model.efforts, efforts.unbind(1), strict=True))
        return known

    def _with_rates(self, dx: Tensor, x: Tensor, known: Mapping[str, Tensor]) -> Tensor:
        """dx/dt with the terms of R and F that are evaluated from their text."""
        model = self.dynamics.model
        rates: dict[int, Any] = {}
        for text in self.dynamics.text_rates:
            i = model.index(text.equation)
            rate = self._value(text, known)
            if text.slot == "R":
                rate = -rate * known[model.efforts[i]]
            rates[i] = rates[i] + rate if i in rates else rate
        columns = [torch.as_tensor(rate).expand(len(x)) for rate in rates.values()]
        added = torch.stack(columns, 1)
        return dx.index_add(1, torch.tensor(list(rates)), added.to(dx.dtype))

    def _other_efforts(self, x: Tensor) -> Tensor:
        """Gradient of the terms of the energy that are not monomials, by torch."""
        with torch.enable_grad():
            if not x.requires_grad:
                x = x.detach().requires_grad_()
            known = dict(zip(self.dynamics.model.states, x.unbind(1), strict=True))
            energy = 0.0 * x[:, 0]
            for text in self.dynamics.text_energy:
                energy = energy + self._value(text, known)
            (gradient,) = torch.autograd.grad(energy.sum(), x, create_graph=True)
        return gradient

    def _value(self, text: _TextTerm, known: Mapping[str, Tensor]) -> Any:
        term = text.term
        names: dict[str, Any] = dict(known)
        for name in term.inner:
            names[name] = self.values[term.inner_name(name, text.place)]
        body = evaluate(term.body, names, TORCH)
        if term.is_formula:
            return body
        return self.values[term.coefficient_name(text.place)] * body
