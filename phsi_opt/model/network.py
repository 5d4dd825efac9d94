"""From blocks to equations: the algebra of a network is eliminated exactly.

The unknowns are what the ports at each node share, a speed, voltage, pressure or
temperature. Gauss-Jordan elimination solves the laws of gears, motors and sources, and
those of storages, e = dH/dP, for them and then for e. The power balance of each motion
that is left, of a storage or of a node without one, gives dP/dt = f or an equation
without a state. Where efforts and currents follow from others, e = C s, the storages
I_k are joined rigidly and have one state for each s,

    M = C' diag(I) C,  P = M s,  H = P' M^-1 P/2,  dP/dt = C' f

so that two inertias at a gear are one, and two coils in series. A loss g v^2 with
v = d' grad H is g d d' in R (van der Schaft and Jeltsema, Port-Hamiltonian Systems
Theory, 2014, sections 2 and 12).
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import filterfalse
from typing import NamedTuple

import sympy as sp
from sympy.polys.fields import sfield
from sympy.polys.matrices import DomainMatrix

from phsi_opt.arguments import require_known
from phsi_opt.data.checks import check_unique
from phsi_opt.errors import ModelError
from phsi_opt.model.block_kinds import FIELDS, GROUND, Block
from phsi_opt.model.expressions import evaluate, names_of
from phsi_opt.model.kinds import MECHANICAL
from phsi_opt.model.mechanics import integral
from phsi_opt.model.sympy_backend import SYMPY


class Equations(NamedTuple):
    """A network as states; rates are linear in efforts, inputs and unknown flows."""

    kinds: Mapping[str, str]  # by state
    efforts: Mapping[str, sp.Symbol]  # dH/dx by state
    rates: Mapping[str, sp.Expr]  # dx/dt by state
    energies: Sequence[sp.Expr]  # the terms of H
    losses: Mapping[Block, sp.Expr]  # the difference v at each, in efforts and inputs
    inputs: Mapping[str, sp.Symbol]  # by source


def real(name: str) -> sp.Symbol:
    """A state, an effort or an input in a formula."""
    return sp.Symbol(name, real=True)


def effort_of(state: str) -> sp.Symbol:
    """The slope dH/dx of a state."""
    return real(f"dH_d{state}")


def parameter(name: str) -> sp.Symbol:
    """A parameter in a formula; one that may be zero needs cases in an integral."""
    return sp.Symbol(name, real=True, nonzero=True)


def tidy(expression: sp.Expr) -> sp.Expr:
    """A sum or a quotient of sums, in which what is zero is 0."""
    return sfield(expression)[1].as_expr() if expression.free_symbols else expression


def law_of(block: Block, **variables: sp.Expr) -> sp.Expr:
    """The law of a block as an expression."""
    names = sorted(names_of(block.law))
    known = dict(zip(names, map(parameter, names), strict=True)) | variables
    return sp.sympify(evaluate(block.law, known, SYMPY))


def is_linear(block: Block) -> bool:
    """Whether what flows at a loss is proportional to the difference."""
    v = sp.Dummy("v", real=True)
    law = law_of(block, v=v)
    return not law.diff(v).has(v) and law.subs(v, 0) == 0


def equations_of(blocks: Sequence[Block], positions: Sequence[str]) -> Equations:
    """The equations of a network; the positions of the given nodes are states.

    Raises:
        ModelError: there are conflicts of causality, or nothing is stored.
    """
    network = _Network(blocks)
    network.tie()
    network.place(positions)
    network.balance()
    return network.equations()


def _solved(
    zeros: Sequence[sp.Expr], unknowns: Sequence[sp.Symbol]
) -> dict[sp.Symbol, sp.Expr]:
    """Solve 0 = zeros for the first unknowns that can be, by those behind them."""
    rows = [[zero.diff(one) for one in unknowns] for zero in zeros]
    table = DomainMatrix.from_list_sympy(len(rows), len(unknowns), rows)
    reduced, pivots = table.to_field().rref()
    sums = reduced.to_Matrix() * sp.Matrix(unknowns)
    return {unknowns[one]: unknowns[one] - sums[row] for row, one in enumerate(pivots)}


def _conflict(said: str) -> ModelError:
    return ModelError(
        f"{said}: a conflict of causality. Remove it, or put a spring, a damper, a "
        "resistor or the like in between."
    )


class _Network:
    """The unknowns of a network, and what is known of them so far."""

    def __init__(self, blocks: Sequence[Block]) -> None:
        self.blocks = blocks
        self.known: dict[sp.Symbol, sp.Expr] = {}
        self.nodes: dict[str, sp.Expr] = {GROUND: sp.S.Zero}
        self.moving: dict[sp.Symbol, str] = {}  # names of positions, by their speeds
        self.speeds: dict[str, sp.Symbol] = {}  # of positions that are states
        self.potentials: list[sp.Expr] = []
        self.drawn: dict[sp.Symbol, sp.Expr] = {}  # by all but storages, at each motion
        for block in blocks:
            for node, field in zip(block.ports, block.fields, strict=True):
                if node not in self.nodes:
                    self.nodes[node] = sp.Dummy(node, real=True)
                    if FIELDS[field] == MECHANICAL:
                        self.moving[self.nodes[node]] = node
        # The last nodes are solved for first, and those with a position last.
        *last_first, _ = reversed(self.nodes.values())
        self.unknown = sorted(last_first, key=self.moving.__contains__)
        self.stores = [*self.of_role("storage"), *self.of_role("flux")]
        self.efforts = {block.state: effort_of(block.state) for block in self.stores}
        sources = self.of_role("across", "through")
        self.inputs = {block.name: real(block.name) for block in sources}
        self.last = [*reversed(self.efforts.values()), *self.inputs.values()]

    def of_role(self, *roles: str) -> list[Block]:
        return list(filter(lambda block: block.role in roles, self.blocks))

    def free(self, unknowns: Iterable[sp.Symbol]) -> list[sp.Symbol]:
        """Those that do not follow from others."""
        return list(filterfalse(self.known.__contains__, unknowns))

    def seen(self, expression: sp.Expr) -> sp.Expr:
        """An expression by what is free."""
        return tidy(expression.xreplace(self.known))

    def difference(self, block: Block) -> sp.Expr:
        """Between the first two ports of a block, or of its port to the ground."""
        first, second, *_ = (*block.ports, GROUND)
        return self.seen(self.nodes[first] - self.nodes[second])

    def tie(self) -> None:
        """Solve the laws of gears and the like, of sources and of storages."""
        laws = []
        for block in self.of_role("joint", "across"):
            if block.role == "joint":
                ports = map(self.nodes.__getitem__, block.ports)
                laws.append(law_of(block, **dict(zip("abcd", ports, strict=False))))
            else:
                laws.append(self.difference(block) - self.inputs[block.name])
            if len(_solved(laws, self.unknown)) < len(laws):
                raise _conflict(
                    f"{block} ties {', '.join(block.ports)}, which other joints and "
                    "sources tie already"
                )
        storages = self.of_role("storage")
        for block in storages:
            laws.append(self.difference(block) - self.efforts[block.state])
        self.known = _solved(laws, [*self.unknown, *self.last])
        for block in storages:
            value = self.difference(block)
            driven = [name for name, one in self.inputs.items() if value.has(one)]
            if driven or value == 0:
                to = (*driven, GROUND)[0]
                raise _conflict(
                    f"{block} has no state, as it is joined rigidly to {to!r}"
                )

    def place(self, positions: Sequence[str]) -> None:
        """The positions that are states: those of springs, and given ones."""
        for block in self.of_role("storage"):
            if FIELDS[block.fields[0]] == MECHANICAL:
                self.moving[self.efforts[block.state]] = block.ports[0]
        for block in self.of_role("across"):
            if FIELDS[block.fields[0]] == MECHANICAL:
                self.moving[self.inputs[block.name]] = f"q_{block.name}"
        free = self.free(self.moving)
        names = [self.moving[speed] for speed in free]
        check_unique([*names, *self.efforts], "state", ModelError)
        speeds = dict(zip(names, free, strict=True))
        places = dict(zip(free, map(real, names), strict=True))
        for node in positions:
            require_known(node, names, f"positions: {node!r} is no free position")
            self.speeds[node] = speeds[node]
        x = sp.Dummy("x", real=True)
        for block in self.of_role("spring"):
            v = self.difference(block)
            for one in filter(v.has, self.last):
                if one not in places:
                    raise _conflict(
                        f"the ends of {block} follow from "
                        f"{one.name.removeprefix('dH_d')!r}, which is no position"
                    )
            self.speeds |= {name: one for name, one in speeds.items() if v.has(one)}
            energy = integral(law_of(block, x=x), x)
            if energy is None:
                raise ModelError(
                    f"{block}: the force {block.law!r} has no energy that a formula "
                    "can hold; write a polynomial in x, or simple functions of it."
                )
            self.potentials.append(energy.subs(x, v.xreplace(places)))

    def balance(self) -> None:
        """Solve the power balances of nodes without a storage."""
        nodes = self.free(self.unknown)
        self.drawn = dict.fromkeys([*self.efforts.values(), *nodes], sp.S.Zero)

        def draw(across: sp.Expr, flow: sp.Expr) -> None:
            for motion in self.drawn:
                self.drawn[motion] += across.diff(motion) * flow

        for name, speed in self.speeds.items():
            draw(speed, effort_of(name))
        for block in self.blocks:
            v = self.difference(block)
            match block.role:
                case "flux":
                    draw(v, self.efforts[block.state])
                    draw(self.efforts[block.state], -v)
                case "through":
                    draw(v, -self.inputs[block.name])
                case "gyrator":
                    third = self.seen(self.nodes[block.ports[2]])
                    draw(v, law_of(block) * third)
                    draw(third, -law_of(block) * v)
                case "loss" if is_linear(block):
                    draw(v, sp.nsimplify(law_of(block, v=v), rational=True))
                case "loss" if v.has(*nodes):
                    raise ModelError(
                        f"{block} is not linear, and one of its nodes "
                        f"({', '.join(block.ports)}) has no storage, so that its flow "
                        "cannot be solved for; put a storage there."
                    )
                case "loss":
                    draw(v, sp.Dummy(block.name, real=True))
        forces = {effort_of(name): name for name in self.speeds}
        zeros = [self.drawn[node] for node in nodes]
        found = _solved(zeros, [*nodes, *forces, *self.last])
        self.known = {one: value.xreplace(found) for one, value in self.known.items()}
        self.known |= found
        inputs = self.inputs.values()
        for one in filterfalse(nodes.__contains__, found):
            if one in forces and found[one] == 0:
                self._rest(forces[one])
            elif one in (*forces, *inputs) or found[one].has(*inputs):
                raise self._refused((one - found[one]).free_symbols)

    def _rest(self, name: str) -> None:
        """A node between springs alone: its position is where their forces cancel."""
        q = real(name)
        others, total = sp.Add(*self.potentials).as_independent(q, as_Add=True)
        stiffness = total.diff(q, 2)
        if stiffness.has(q):
            raise self._refused({effort_of(name)})
        joined = total.subs(q, tidy(q - total.diff(q) / stiffness))
        self.potentials = [*filter(None, sp.Add.make_args(others)), sp.factor(joined)]

    def _refused(self, flows: set[sp.Symbol]) -> ModelError:
        """The conflict of flows, at the node that has most of them."""
        node = max(
            self.free(self.unknown),
            key=lambda node: len(flows & self.drawn[node].free_symbols),
        )
        those = filter(lambda block: node.name in block.ports, self.blocks)
        return _conflict(
            f"at node {node.name!r}, which has no storage and no loss, the flows of "
            f"{', '.join(map(str, those))} cannot all be given"
        )

    def equations(self) -> Equations:
        """What is left, by state."""
        names = {effort_of(name): name for name in (*self.speeds, *self.efforts)}
        efforts = {names[effort]: effort for effort in self.free(names)}
        if not efforts:
            raise ModelError(
                "no block stores energy, so there is no state; expected a mass, an "
                "inertia, a spring, a coil, a capacitor, a tank or a thermal storage."
            )
        stored = list(self.efforts.values())
        own = [name for name in efforts if name in self.efforts]
        shares = [self.seen(one).diff(efforts[name]) for one in stored for name in own]
        C = sp.Matrix(len(stored), len(own), shares)
        f = sp.Matrix([-self.drawn[effort] for effort in stored])
        rates = self.speeds | dict(zip(own, C.T * f, strict=True))
        rates = {name: self.seen(rates[name]) for name in efforts}
        for node in self.free(self.unknown):  # those that nothing ties must not matter
            if sp.Tuple(*rates.values()).has(node):
                raise self._refused({node})
        sizes = dict.fromkeys(self.efforts, sp.S.Zero)
        for block in self.stores:
            sizes[block.state] += parameter(block.name)
        M = C.T * sp.diag(*sizes.values()) * C
        energies = [*_energies(M, own), *self.potentials]
        kinds = {block.state: FIELDS[block.fields[0]] for block in self.stores}
        kinds = {name: kinds.get(name, MECHANICAL) for name in efforts}
        losses = {block: self.difference(block) for block in self.of_role("loss")}
        return Equations(kinds, efforts, rates, energies, losses, self.inputs)


def _energies(M: sp.Matrix, states: Sequence[str]) -> list[sp.Expr]:
    """The terms of P' M^-1 P/2."""
    P = sp.Matrix(list(map(real, states)))
    terms = []
    for group in M.connected_components():
        part = M.extract(group, group)
        chosen = P.extract(group, [0])
        energy = (chosen.T * part.adjugate() * chosen)[0] / (2 * part.det())
        terms.append(energy if len(group) == 1 else sp.factor(energy))
    return terms
