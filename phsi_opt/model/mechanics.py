"""m a = F, written as a pseudo-Hamiltonian model.

Positions x_i have momenta p_i = m_i v_i. The forces are multiplied out, and each term
goes where its physics belongs: what depends on positions alone and has a potential into
H, what brakes into R, and the rest into F. SymPy integrates and differentiates.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from phsi_opt.arguments import typed
from phsi_opt.data.checks import check_unique, checked_names
from phsi_opt.errors import ModelError
from phsi_opt.model.base import BaseModel
from phsi_opt.model.expressions import RESERVED_IN_FORMULAS, evaluate, names_of, parse
from phsi_opt.model.model import PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import Variables
from phsi_opt.model.structure import canonical
from phsi_opt.model.terms import Dictionary, parameter_of
from phsi_opt.presentation.numbers import number_of

if TYPE_CHECKING:
    import sympy as sp


@typed
def mechanical(
    coordinates: Sequence[str],
    mass: str | float | Parameter | Sequence[str | float | Parameter],
    forces: str | Sequence[str],
    *,
    inputs: Sequence[str] | None = None,
    **parameters: Parameter | float,
) -> PseudoHamiltonian:
    """The model m a = F of one or several masses, as a `PseudoHamiltonian`.

    Its equations are ``m_i x_i'' = F_i(x, v, t, u)``. The states of the model are the
    positions and, behind them, the momenta: ``p`` of one coordinate, ``p_x1`` and so on
    of several. Momenta need not be in the measurements.

    Every force is a sum. Terms of positions alone that have a potential become part of
    the energy H, terms such as ``-c*v`` or ``-d*v*abs(v)`` become losses R, and all
    others stay forces F, where a velocity is the effort ``dH_dp``; ``print(model)``
    shows them.

    Args:
        coordinates: names of the positions, such as ``["x"]``.
        mass: for all coordinates or for each of them: a number, a name, or a formula of
            parameters such as ``"m1 + m2"``; an inertia where a position is an angle. A
            number is called ``m``, or ``m_x1`` and so on.
        forces: a formula for each coordinate, in positions, velocities (``v`` of one
            coordinate, ``v_x1`` and so on of several), the time ``t``, inputs and
            parameters. Names that are not given are free parameters.
        inputs: names of the measured inputs; default: ``u``, ``u1``, ``u2`` and so on,
            where they are in the forces.
        **parameters: values or bounds of parameters by name; a number is a fixed value.

    Raises:
        ModelError: a formula cannot be read, or has an unknown velocity; a mass is not
            above zero or depends on the motion; there is not one force for each
            coordinate; a parameter is in no formula.

    Examples:
        >>> stiffness = ph.Parameter(50, lower=0, unit="N/m")
        >>> cart = ph.mechanical(["x"], mass=2.5, forces="-k*x - c*v + u", k=stiffness)
        >>> print(cart)
        PseudoHamiltonian: states x, p; inputs u
        <BLANKLINE>
        dx/dt = dH_dp
        dp/dt = - dH_dx - R_p*dH_dp + F_p
        H = p**2/(2*m) + k*x**2/2
        R_p = c
        F_p = u
        <BLANKLINE>
        parameters
        name  value  known  lower  upper  unit
        m       2.5  yes     -inf    inf
        k        50  no         0    inf  N/m
        c         0  no         0    inf
    """
    positions = checked_names(
        coordinates, "coordinates", RESERVED_IN_FORMULAS, ModelError
    )
    endings = [f"_{name}" if len(positions) > 1 else "" for name in positions]
    velocities = [f"v{ending}" for ending in endings]
    momenta = [f"p{ending}" for ending in endings]
    laws = _one_each(forces, "forces", positions)
    names = frozenset().union(*map(names_of, laws))
    known = {name: parameter_of(one) for name, one in parameters.items()}
    if inputs is None:
        inputs = sorted(filter(re.compile(r"u\d*").fullmatch, names - known.keys()))
    variables = Variables((*positions, *momenta), tuple(inputs))
    moving = {*variables.of_slot("R"), *velocities}
    check_unique((*variables.states, *velocities, *inputs), "name", ModelError)
    for name in sorted(names - {*positions, *velocities, *inputs, *known}):
        if name in momenta or re.match(r"v$|v_|dH_d|dF_d", name):
            raise ModelError(
                f"{name!r} in forces={forces!r} is unknown; velocities are called "
                f"{', '.join(velocities)}. If it is a parameter, give it: "
                f"{name}=Parameter(...)."
            )
    masses = []
    for one, ending in zip(_one_each(mass, "mass", positions), endings, strict=True):
        if not isinstance(one, str):
            known[f"m{ending}"] = parameter_of(one)
            one = f"m{ending}"
        _check_mass(one, moving, known)
        if one.isidentifier():
            known.setdefault(one, Parameter(1.0, lower=0.0))
        masses.append(one if one.isidentifier() else f"({one})")
    kinetic = list(map("{}**2/(2*{})".format, momenta, masses))
    return energy_model(variables, velocities, kinetic, laws, known)


def energy_model(
    variables: Variables,
    velocities: Sequence[str],
    energies: Sequence[str],
    laws: Sequence[str],
    known: dict[str, Parameter],
) -> PseudoHamiltonian:
    """The model of an energy and of forces, each term where its physics belongs.

    Args:
        variables: states, which are positions and then their momenta, and inputs.
        velocities: names of dH/dp in the forces, one of each position.
        energies: terms of H as formulas.
        laws: a force on each momentum, as formulas.
        known: parameters by name; those that it lacks are free.

    Raises:
        ModelError: a formula cannot be read, or a parameter is in none of them.
    """
    n = len(velocities)
    positions = variables.states[:n]
    momenta = variables.states[n:]
    efforts = dict(zip(velocities, variables.efforts[n:], strict=True))
    others = (*variables.inputs, "t")
    losses, potentials, forces_left = _sums_of(laws, positions, efforts, others)

    def by_momentum(slot: str, sums: "list[sp.Expr]") -> dict[str, Dictionary]:
        found = {}
        for momentum, one in zip(momenta, sums, strict=True):
            if one:
                found[momentum] = variables.formula(_text(one), slot, momentum, known)
        return found

    R = by_momentum("R", losses)
    H = Dictionary()
    for energy in (*energies, *map(_text, filter(None, potentials))):
        H += variables.formula(energy, "H", "", known)
    F = by_momentum("F", forces_left)
    inputs = variables.inputs
    model = PseudoHamiltonian(
        states=variables.states, inputs=inputs, S=canonical(n), H=H, R=R, F=F
    )
    require_used(known, model)
    return model


def require_used(names: Iterable[str], model: BaseModel) -> None:
    """Check that the parameters that were given are in a formula of the model.

    Raises:
        ModelError: one is in none of them.
    """
    for name in sorted(set(names) - model.entries.keys()):
        raise ModelError(
            f"parameter {name!r} is in none of the formulas; they have "
            f"{', '.join(model.entries) or 'none'}. Correct the name, or remove it."
        )


def _one_each(given: Any, what: str, positions: Sequence[str]) -> list[Any]:
    """What is given of each coordinate; a single mass is that of all of them."""
    is_list = np.iterable(given) and not isinstance(given, str)
    each = list(given) if is_list else [given]
    if what == "mass" and not is_list:
        each *= len(positions)
    if len(each) != len(positions):
        raise ModelError(
            f"{what}={given!r} is {number_of(len(each), 'value')} for the "
            f"{len(positions)} coordinates {', '.join(positions)}; give a list with "
            "one for each."
        )
    return each


def _check_mass(text: str, moving: set[str], known: Mapping[str, Parameter]) -> None:
    """Refuse a mass that is not above zero, or that changes during the motion."""
    names = names_of(text)
    if names & moving:
        raise ModelError(
            f"mass {text!r} depends on {min(names & moving)!r}; expected a constant. "
            "Write the energy of a changing mass with PseudoHamiltonian."
        )
    values = {name: known[name].value for name in names & known.keys()}
    if len(values) < len(names) or None in values.values():
        return
    value = float(evaluate(text, values))
    if not value > 0:
        raise ModelError(f"mass {text!r} is {value:g}; expected a number above zero.")


# ---- where each term of a force belongs ----------------------------------------------


def _sums_of(
    laws: Sequence[str],
    positions: Sequence[str],
    efforts: Mapping[str, str],
    others: Sequence[str],
) -> "tuple[list[sp.Expr], list[sp.Expr], list[sp.Expr]]":
    """Losses by coordinate, potentials by parameters, forces by coordinate.

    Velocities are written as the efforts that they are.
    """
    import sympy as sp

    from phsi_opt.model.sympy_backend import SYMPY, n_expanded

    variables = (*positions, *efforts, *others)
    symbols = {}
    for name in sorted(frozenset(variables).union(*map(names_of, laws))):
        # A parameter that may be zero would need cases in an integral.
        is_parameter = name not in variables or None
        written = efforts.get(name, name)
        symbols[name] = sp.Symbol(written, real=True, nonzero=is_parameter)
    positive = {}
    for name in symbols.keys() - variables:
        positive[symbols[name]] = sp.Dummy(positive=True)
    velocities = list(map(symbols.__getitem__, efforts))
    outside = {*velocities, *map(symbols.__getitem__, others)}
    x = list(map(symbols.__getitem__, positions))
    losses = [sp.Integer(0)] * len(x)
    forces = list(losses)
    fields: dict[frozenset[sp.Symbol], list[sp.Expr]] = {}  # by their parameters
    for k, text in enumerate(laws):
        law = sp.sympify(evaluate(text, symbols, SYMPY))
        if n_expanded(law) <= 200:  # else it is left as it is
            law = law.expand(power_exp=False, power_base=False, log=False)
        for term in sp.Add.make_args(law):
            loss = -term / velocities[k]
            if term.free_symbols.isdisjoint(outside):
                own = frozenset(term.free_symbols & positive.keys())
                fields.setdefault(own, [sp.Integer(0)] * len(x))[k] += term
            elif loss.xreplace(positive).is_nonnegative:
                losses[k] += loss
            else:
                forces[k] += term
    potentials = []
    for field in fields.values():
        potential = _potential(field, x)
        if potential is None:  # only of those that depend on their own position
            potential = sp.Integer(0)
            for k, position in enumerate(x):
                for term in sp.Add.make_args(field[k]):
                    energy = None
                    if term.free_symbols.isdisjoint({*x} - {position}):
                        energy = integral(term, position)
                    potential -= energy or 0
                    forces[k] += term if energy is None else 0
        forms = (potential, sp.expand(potential), sp.factor(potential))
        potentials.append(min(forms, key=lambda form: len(str(form))))
    return losses, potentials, forces


def integral(term: "sp.Expr", x: "sp.Symbol") -> "sp.Expr | None":
    """The integral over a position; None where no formula can hold it."""
    import sympy as sp
    from sympy.integrals.manualintegrate import manualintegrate

    energy = manualintegrate(term, x).replace(sp.log, lambda g: sp.log(sp.Abs(g)))
    try:
        parse(_text(energy))
    except ModelError:
        return None
    return energy


def _potential(field: "list[sp.Expr]", x: "list[sp.Symbol]") -> "sp.Expr | None":
    """The V of forces F_i = -dV/dx_i; None where these have none."""
    import sympy as sp

    V = sp.Integer(0)
    for force, position in zip(field, x, strict=True):
        energy = integral(sp.expand(force + V.diff(position)), position)
        if energy is None:
            return None
        V -= energy
    for force, position in zip(field, x, strict=True):
        if sp.simplify(force + V.diff(position)) != 0:
            return None
    return V


def _text(expression: "sp.Expr") -> str:
    from phsi_opt.model.sympy_backend import formula_text

    return formula_text(expression)
