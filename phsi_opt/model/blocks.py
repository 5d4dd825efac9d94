"""Machines and circuits as blocks that are joined: the model follows from the diagram.

`block_kinds` reads the diagram, `network` eliminates its algebra, and S, R, H and F are
read here from what is left.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from phsi_opt.arguments import typed
from phsi_opt.errors import ModelError
from phsi_opt.model.block_kinds import Block, read_blocks
from phsi_opt.model.expressions import is_linear, names_of
from phsi_opt.model.mechanics import require_used
from phsi_opt.model.model import PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import Variables
from phsi_opt.model.terms import Dictionary, parameter_of
from phsi_opt.presentation.summary import Summarised, Summary

if TYPE_CHECKING:
    import sympy as sp
    from matplotlib.axes import Axes

    from phsi_opt.model.network import Equations


@dataclass(frozen=True, repr=False)
class BlockDiagram(Summarised):
    """A diagram of blocks and its model; made by `blocks`.

    Attributes:
        blocks: each block by its name, as it was written.
        model: the model that follows from the diagram.
    """

    blocks: Mapping[str, str]
    model: PseudoHamiltonian

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Draw the blocks, each with its name and kind, and the nodes between them.

        Args:
            ax: Axes to draw on; None: a new figure.
        """
        from phsi_opt.model.block_picture import draw_blocks

        return draw_blocks(read_blocks(self.blocks), ax)

    def _summary(self) -> Summary:
        return self.model._summary()


@typed
def blocks(
    diagram: Mapping[str, str],
    positions: Sequence[str] = (),
    **parameters: Parameter | float,
) -> BlockDiagram:
    """The model of masses, springs, coils, tanks and the like that are joined.

    Each block is written as ``"kind: node, node"``. Blocks with the same node are
    joined there; ``ground`` is the frame, the earth, the pressure or temperature 0. The
    name of a block is that of its parameter (a mass, a stiffness, a resistance, a
    ratio), and that of a source is an input. Storages, H and states:

    - ``mass: x``, ``inertia: x``: ``p_x**2/(2*m)``; the position ``x`` is a state, too,
      where a spring needs it; ``spring: x, y``, ``torsion spring: x, y``: k (x - y)^2/2
    - ``capacitor: a, b``: ``q_C**2/(2*C)``; ``coil: a, b``: ``psi_L**2/(2*L)``
    - ``tank: a`` (C = area/(density g)): ``V_a**2/(2*C)``; ``fluid inertia: a, b``
    - ``thermal storage: a``: ``Q_a**2/(2*C)``, whose effort is the temperature; this H
      is in J K, and thermal blocks have a diagram of their own

    Losses are ``damper``, ``torsion damper``, ``resistor``, ``pipe`` and ``thermal
    resistance: a, b``. Ideal joints, with the speeds or voltages of their nodes, are
    ``gear: a, b`` and ``lever: a, b`` (a = n b), ``rack: a, x`` (x = r a), ``motor: a,
    b, shaft`` (a - b = K shaft), ``transformer: a, b, c, d`` (a - b = n (c - d)),
    ``piston: a, b, x`` (force A (a - b) on x) and ``pump: a, b, shaft``. Sources, of
    which the second node is mostly ``ground``, are ``force``, ``velocity``, ``torque``,
    ``speed``, ``voltage``, ``current``, ``flow``, ``pressure``, ``heat flow`` and
    ``temperature``.

    A spring and a loss may have a law, behind a semicolon: the force of the extension x
    as in ``"spring: x, ground; k*x + k3*x**3"``, the flow of the difference v as in
    ``"damper: x, ground; c*v + d*v*abs(v)"``.

    What is joined rigidly is one storage: two inertias J1 and J2 at a gear n become
    J1 + J2/n^2. Nodes without a storage are solved for.

    Args:
        diagram: the blocks by name.
        positions: nodes whose positions or angles are states though no spring needs
            them, such as a measured angle.
        **parameters: values or bounds of parameters by name; a number is a fixed value.
            Those that are not given are free, and not negative where they are one of a
            storage, a spring or a loss. Units are SI.

    Returns:
        The diagram, with its ``model`` and ``plot``.

    Raises:
        ModelError: a kind or a node that there is not, a port that is not connected, a
            node of two fields, or a conflict of causality.

    Examples:
        >>> car = ph.blocks({
        ...     "m": "mass: x",
        ...     "k": "spring: x, road",
        ...     "c": "damper: x, road",
        ...     "u": "velocity: road, ground",
        ... })
        >>> print("\\n".join(str(car).splitlines()[2:9]))
        dx/dt = dH_dp_x
        dq_u/dt = F_q_u
        dp_x/dt = - dH_dx - R_p_x*dH_dp_x + F_p_x
        H = p_x**2/(2*m) + k*(-q_u + x)**2/2
        R_p_x = c
        F_q_u = u
        F_p_x = c*u
    """
    from phsi_opt.model.network import equations_of

    known = dict(zip(parameters, map(parameter_of, parameters.values()), strict=True))
    read = read_blocks(diagram)
    found = equations_of(read, positions)
    S: dict[tuple[str, str], Any] = {}
    places: list[tuple[str, Any, str]] = []
    for energy in found.energies:
        places.append(("H", "", _text(energy)))
    for pair, entry in _matrix(found):
        if entry.is_number:
            S[pair] = float(entry)
        else:
            places.append(("S", pair, _text(entry)))
    places += [*_losses(found), *_forces(found)]
    owned = {block.name: block for block in read if block.has_parameter}
    for name in sorted(owned.keys() & found.rates.keys()):
        raise ModelError(
            f"{owned[name]} has the name of a state, the position of a node; rename it."
        )
    for block in read:
        in_law = names_of(block.law) - {"x"} if block.role == "spring" else set()
        for name in sorted(in_law & found.rates.keys()):
            raise ModelError(
                f"{block}: {name} in its law {block.law!r} is a state, and the force "
                "of a spring is one of its extension x alone; rename the parameter."
            )
    known |= _own_parameters(owned, known, [text for *_, text in places])
    variables = Variables(tuple(found.rates), tuple(found.inputs))
    terms: dict[str, dict[Any, Dictionary]] = {"H": {}, "S": {}, "R": {}, "F": {}}
    for slot, key, text in places:
        direction = "" if slot in "HS" else key
        one = variables.formula(text, "F" if slot == "S" else slot, direction, known)
        terms[slot][key] = terms[slot].get(key, Dictionary()) + one
    model = PseudoHamiltonian(
        states=variables.states,
        inputs=variables.inputs,
        S=S | terms["S"],
        H=terms["H"][""],
        R=terms["R"],
        F=terms["F"],
        kind=found.kinds,
    )
    require_used(parameters, model)
    return BlockDiagram(MappingProxyType(dict(diagram)), model)


def _own_parameters(
    owned: Mapping[str, Block], given: Mapping[str, Parameter], texts: Sequence[str]
) -> dict[str, Parameter]:
    """The parameters of the blocks, with their units."""
    found = {}
    linear: set[str] = set()
    for name, block in owned.items():
        one = given.get(name)
        if one is None:
            # As of other formulas, it begins at a value from the data or at 1.
            is_free = True
            for text in texts:
                own = sorted(names_of(text) & {*linear, name})
                is_free &= name not in own or is_linear(text, own)
            linear |= {name} if is_free else set()
            lower = -inf if block.role == "joint" else 0.0
            one = Parameter(None if is_free else 1.0, lower=lower)
        found[name] = one if one.unit else replace(one, unit=block.unit)
    return found


# ---- S, R, H and F -------------------------------------------------------------------


def _matrix(found: "Equations") -> Iterator[tuple[tuple[str, str], "sp.Expr"]]:
    """The entries of S above its diagonal that are not zero."""
    from phsi_opt.model.network import tidy

    for (row, e_row), (column, e_column) in combinations(found.efforts.items(), 2):
        there = found.rates[row].diff(e_column)
        back = found.rates[column].diff(e_row)
        entry = tidy((there - back) / 2)
        if entry != 0:
            yield (row, column), entry


def _losses(found: "Equations") -> Iterator[tuple[str, str, str]]:
    """A loss is g d d' in R, where v = d' grad H; one without such a g is a force."""
    import sympy as sp

    from phsi_opt.model.network import is_linear, law_of

    x = sp.Dummy("x", real=True)
    for block, v in found.losses.items():
        direction, factor = _direction(found, v)
        is_driven = not is_linear(block) and v.has(*found.inputs.values())
        terms = sp.Add.make_args(sp.expand(law_of(block, v=x)))
        for law in terms if direction else ():  # else between sources
            if is_driven or sp.fraction(law / x)[1].has(x):
                slot = "F"
                term = -factor * law
            else:
                slot = "R"
                term = factor**2 * law / x
            yield slot, direction, _text(term.subs(x, v))


def _direction(found: "Equations", v: "sp.Expr") -> tuple[str, "sp.Expr"]:
    """The direction of a difference of efforts, and the factor of its first state."""
    from phsi_opt.model.network import tidy

    text = ""
    first: Any = 0
    for state, effort in found.efforts.items():
        factor = tidy(v.diff(effort))
        if factor == 0:
            continue
        first = first or factor
        ratio = tidy(factor / first)
        sign = "-" if ratio.could_extract_minus_sign() else "+"
        size = -ratio if sign == "-" else ratio
        text += f" {sign} " + (state if size == 1 else f"({_text(size)})*{state}")
    return text.removeprefix(" + "), first


def _forces(found: "Equations") -> Iterator[tuple[str, str, str]]:
    """What the rates have of inputs; flows of losses have places of their own."""
    import sympy as sp

    for state, rate in found.rates.items():
        force = sp.Integer(0)
        for one in found.inputs.values():
            force += sp.factor(rate.diff(one)) * one
        if force != 0:
            yield "F", state, _text(force)


def _text(expression: "sp.Expr") -> str:
    """The shorter of an expression and its factors as a formula."""
    import sympy as sp

    from phsi_opt.model.sympy_backend import formula_text

    return min(formula_text(expression), formula_text(sp.factor(expression)), key=len)
