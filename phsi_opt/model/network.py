"""From blocks to equations: the algebra of a network is eliminated exactly.

The unknowns are what the ports at each node share, a speed, voltage, pressure or
temperature e. Gears, motors and sources tie some of them to others. The difference of e
at a storage is its effort dH/dP. Where efforts follow from others, e_k = c_k' s, the
storages I_k are joined rigidly and have one state for each s,

    M = sum I_k c_k c_k',  P = M s,  H = P' M^-1 P/2

so that two inertias at a gear are one. The power balance of each motion that is left,
of a storage or of a node without one, gives dP/dt or an equation without a state. Coils
in series are joined in the same way, by their currents. A loss g v^2 with v = d' grad H
is g d d' in R (van der Schaft and Jeltsema, Port-Hamiltonian Systems Theory, 2014,
sections 2 and 12).
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import filterfalse
from operator import attrgetter
from typing import NamedTuple

import sympy as sp
from sympy.polys.fields import sfield

from phsi_opt.arguments import require_known
from phsi_opt.errors import ModelError
from phsi_opt.model.block_kinds import FIELDS, GROUND, KINDS, Block
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

    def named(self, expression: sp.Expr) -> sp.Expr:
        """An expression in the names that efforts and inputs have in formulas."""
        symbols = {}
        for name, effort in self.efforts.items():
            symbols[effort] = real(f"dH_d{name}")
        for name, one in self.inputs.items():
            symbols[one] = real(name)
        return expression.xreplace(symbols)


def real(name: str) -> sp.Symbol:
    """A state, an effort or an input in a formula."""
    return sp.Symbol(name, real=True)


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
    network.join()
    stored = network.store()
    rates = dict(network.place(positions))
    drawn = network.balance()
    network.solve_nodes(drawn)
    for name, effort in network.efforts.items():
        rates[name] = -drawn[effort]
    coils = {}
    for block in network.of_role("flux"):
        coils[block] = network.seen(network.currents[block.state])
    for name, current in network.currents.items():
        rates[name] = sp.Integer(0)
        for block, value in coils.items():
            rates[name] += value.diff(current) * network.difference(block)
    efforts = network.forces | network.efforts | network.currents
    for name in list(efforts):
        rates[name] = network.seen(rates[name])
        if efforts[name] in network.known:  # that of a coil or a spring in series
            del efforts[name], rates[name], network.kinds[name]
    if not rates:
        raise ModelError(
            "no block stores energy, so there is no state; expected a mass, an "
            "inertia, a spring, a coil, a capacitor, a tank or a thermal storage."
        )
    for node in network.free_nodes():  # those that nothing ties must not matter
        if sp.Tuple(*rates.values()).has(node):
            network.refuse(node)
    energies = [*network.merged(stored), *network.merged(coils), *network.potentials]
    losses = network.differences("loss")
    return Equations(network.kinds, efforts, rates, energies, losses, network.inputs)


class _Network:
    """What the nodes share and what is tied so far; the states as they are found."""

    def __init__(self, blocks: Sequence[Block]) -> None:
        self.blocks = blocks
        self.known: dict[sp.Symbol, sp.Expr] = {}
        self.nodes: dict[str, sp.Symbol] = {}
        self.inputs: dict[str, sp.Symbol] = {}
        self.kinds: dict[str, str] = {}  # by state
        self.efforts: dict[str, sp.Symbol] = {}  # of storages, by state
        self.currents: dict[str, sp.Symbol] = {}  # of coils, by state
        self.forces: dict[str, sp.Symbol] = {}  # dH/dq, by position
        self.names: dict[sp.Symbol, str] = {}  # of positions, by their speeds
        self.potentials: list[sp.Expr] = []
        for block in blocks:
            for node, field in zip(block.ports, KINDS[block.kind].fields, strict=True):
                if node != GROUND and node not in self.nodes:
                    self.nodes[node] = sp.Dummy(node, real=True)
                    if FIELDS[field] == MECHANICAL:
                        self.names[self.nodes[node]] = node
            if block.role in ("across", "through"):
                self.inputs[block.name] = sp.Dummy(block.name, real=True)

    def of_role(self, *roles: str) -> list[Block]:
        return list(filter(lambda block: block.role in roles, self.blocks))

    # ---- what is tied ----------------------------------------------------------------

    def seen(self, expression: sp.Expr) -> sp.Expr:
        """An expression by what is not tied."""
        return tidy(expression.xreplace(self.known))

    def at(self, node: str) -> sp.Expr:
        """What the ports at a node share."""
        return self.seen(self.nodes[node]) if node != GROUND else sp.Integer(0)

    def difference(self, block: Block) -> sp.Expr:
        """Between the first two ports of a block, or of its port to the ground."""
        second = (*block.ports, GROUND)[1]
        return tidy(self.at(block.ports[0]) - self.at(second))

    def differences(self, role: str) -> dict[Block, sp.Expr]:
        blocks = self.of_role(role)
        return dict(zip(blocks, map(self.difference, blocks), strict=True))

    def free_nodes(self) -> list[sp.Symbol]:
        """Nodes that are not tied, the last first; those with a position are last."""
        left = filterfalse(self.known.__contains__, reversed(self.nodes.values()))
        return sorted(left, key=self.names.__contains__)

    def tie(self, zero: sp.Expr, unknown: Iterable[sp.Symbol]) -> bool:
        """Solve 0 = zero for the first unknown that is in it; False: none is."""
        zero = self.seen(zero)
        for one in unknown:
            factor = tidy(zero.diff(one))
            if factor != 0:
                value = tidy(one - zero / factor)
                for name, other in self.known.items():
                    self.known[name] = tidy(other.subs(one, value))
                self.known[one] = value
                return True
        return False

    def effort(self, state: str, kind: str) -> sp.Symbol:
        """The effort of a new state."""
        if state in self.kinds:
            raise ModelError(
                f"two states are called {state!r}; rename a node or block."
            )
        self.kinds[state] = kind
        return sp.Dummy(state, real=True)

    def conflict(self, said: str) -> ModelError:
        return ModelError(
            f"{said}: a conflict of causality. Remove it, or put a spring, a damper, a "
            "resistor or the like in between."
        )

    def join(self) -> None:
        """What gears and the like, and sources, tie."""
        for block in self.of_role("joint", "across"):
            if block.role == "joint":
                ports = dict(zip("abcd", map(self.at, block.ports), strict=False))
                zero = law_of(block, **ports)
            else:
                zero = self.difference(block) - self.inputs[block.name]
            if not self.tie(zero, self.free_nodes()):
                nodes = ", ".join(block.ports)
                raise self.conflict(
                    f"{block} ties {nodes}, which other joints and sources tie already"
                )

    def store(self) -> dict[Block, sp.Expr]:
        """Each storage with its effort, in those of the states."""
        for block in self.of_role("storage"):
            if not self.difference(block).has(*self.free_nodes()):
                continue
            kind = FIELDS[KINDS[block.kind].fields[0]]
            effort = self.effort(block.state, kind)
            self.tie(self.difference(block) - effort, self.free_nodes())
            self.efforts[block.state] = effort
            if kind == MECHANICAL:
                self.names[effort] = block.ports[0]
        stored = self.differences("storage")
        for block, value in stored.items():
            driven = next(filter(value.has, self.inputs.values()), None)
            if driven or value == 0:
                to = driven.name if driven else GROUND
                raise self.conflict(
                    f"{block} has no state, as it is joined rigidly to {to!r}"
                )
        return stored

    # ---- energies --------------------------------------------------------------------

    def merged(self, stored: Mapping[Block, sp.Expr]) -> list[sp.Expr]:
        """The terms of P' M^-1 P/2, of storages with their efforts or currents."""
        free = (*self.efforts.values(), *self.currents.values())
        own = list(filter(sp.Tuple(*stored.values()).has, free))
        M = sp.zeros(len(own))
        for block, effort in stored.items():
            row = sp.Matrix(list(map(effort.diff, own)))
            M += parameter(block.name) * row * row.T
        P = sp.Matrix(list(map(real, map(attrgetter("name"), own))))
        terms = []
        for group in M.connected_components():
            part = M.extract(group, group)
            chosen = P.extract(group, [0])
            energy = (chosen.T * part.adjugate() * chosen)[0] / (2 * part.det())
            terms.append(energy if len(group) == 1 else sp.factor(energy))
        return terms

    def place(self, positions: Sequence[str]) -> dict[str, sp.Symbol]:
        """The speeds of the positions that are states: those of springs, and given."""
        speeds: dict[str, sp.Symbol] = {}
        for block in self.of_role("across"):
            if block.kind in ("velocity", "speed"):
                self.names[self.inputs[block.name]] = f"q_{block.name}"

        def position(speed: sp.Symbol) -> sp.Symbol:
            name = self.names[speed]
            if name not in speeds:
                self.forces[name] = self.effort(name, MECHANICAL)
                speeds[name] = speed
            return real(name)

        free = list(filterfalse(self.known.__contains__, self.names))
        names = list(map(self.names.__getitem__, free))
        for node in positions:
            require_known(node, names, f"positions: {node!r} is no free position")
            position(free[names.index(node)])
        for block in self.of_role("spring"):
            extension = sp.Integer(0)
            v = self.difference(block)
            for speed in sorted(v.atoms(sp.Dummy) - {*self.names}, key=str):
                raise self.conflict(
                    f"the ends of {block} follow from {speed.name!r}, which is no "
                    "position"
                )
            for speed in filter(v.has, self.names):
                extension += v.diff(speed) * position(speed)
            x = sp.Dummy("x", real=True)
            energy = integral(law_of(block, x=x), x)
            if energy is None:
                raise ModelError(
                    f"{block}: the force {block.law!r} has no energy that a formula "
                    "can hold; write a polynomial in x, or simple functions of it."
                )
            self.potentials.append(energy.subs(x, extension))
        return speeds

    # ---- motion ----------------------------------------------------------------------

    def balance(self) -> dict[sp.Symbol, sp.Expr]:
        """What each motion gives to all but storages, in virtual displacements."""
        drawn = dict.fromkeys([*self.efforts.values(), *self.free_nodes()], sp.S.Zero)

        def draw(across: sp.Expr, flow: sp.Expr) -> None:
            for motion in drawn:
                drawn[motion] += across.diff(motion) * flow

        for speed, name in self.names.items():
            if name in self.forces and speed in drawn:
                drawn[speed] += self.forces[name]
        for block in self.of_role("flux"):
            kind = FIELDS[KINDS[block.kind].fields[0]]
            self.currents[block.state] = self.effort(block.state, kind)
            draw(self.difference(block), self.currents[block.state])
        for block in self.of_role("through"):
            draw(self.difference(block), -self.inputs[block.name])
        for block in self.of_role("gyrator"):
            draw(self.difference(block), law_of(block) * self.at(block.ports[2]))
            draw(self.at(block.ports[2]), -law_of(block) * self.difference(block))
        nodes = self.free_nodes()
        for block in self.of_role("loss"):
            v = self.difference(block)
            if is_linear(block):
                draw(v, law_of(block, v=v))
                continue
            draw(v, sp.Dummy(block.name, real=True))
            if v.has(*nodes):
                raise ModelError(
                    f"{block} is not linear, and one of its nodes "
                    f"({', '.join(block.ports)}) has no storage, so that its flow "
                    "cannot be solved for; put a storage there."
                )
        return drawn

    def solve_nodes(self, drawn: Mapping[sp.Symbol, sp.Expr]) -> None:
        """Solve the balances of nodes without a storage."""
        nodes = self.free_nodes()
        currents = list(reversed(self.currents.values()))
        for node in reversed(nodes):
            zero = self.seen(drawn[node])
            name = self.names.get(node, "")
            is_given = zero.has(*self.inputs.values())
            if zero == 0 or self.tie(zero, nodes):
                continue
            if name in self.forces and zero == self.forces[name]:
                self._rest(name, node)
            elif is_given or zero.atoms(sp.Dummy) - {*currents}:
                self.refuse(node)
            else:
                self.tie(zero, currents)

    def _rest(self, name: str, node: sp.Symbol) -> None:
        """A node between springs alone: its position is where their forces cancel."""
        q = real(name)
        others, total = sp.Add(*self.potentials).as_independent(q, as_Add=True)
        stiffness = total.diff(q, 2)
        if stiffness.has(q):
            self.refuse(node)
        joined = total.subs(q, tidy(q - total.diff(q) / stiffness))
        self.potentials = [*filter(None, sp.Add.make_args(others)), sp.factor(joined)]
        self.known[self.forces[name]] = sp.Integer(0)

    def refuse(self, node: sp.Symbol) -> None:
        those = filter(lambda block: node.name in block.ports, self.blocks)
        raise self.conflict(
            f"at node {node.name!r}, which has no storage and no loss, the flows of "
            f"{', '.join(map(str, those))} cannot all be given"
        )
