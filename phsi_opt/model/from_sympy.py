"""Models from SymPy: Lagrange's and Kane's equations, and any right-hand side.

The Legendre transform makes of a Lagrangian ``L = v' M(q) v/2 + b(q)' v - V(q)``, with
the momenta ``p = M v + b``, the energy ``H = (p - b)' M^-1 (p - b)/2 + V`` (Goldstein,
Classical Mechanics, section 8.1). What has no energy of that form becomes rates.
"""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import repeat
from typing import TYPE_CHECKING, Any

import numpy as np

from phsi_opt.arguments import typed
from phsi_opt.data.checks import check_unique, checked_names
from phsi_opt.errors import ModelError, shown
from phsi_opt.model.expressions import RESERVED_IN_FORMULAS, names_of
from phsi_opt.model.mechanics import energy_model, require_used
from phsi_opt.model.model import FirstOrder, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import Variables
from phsi_opt.model.terms import Dictionary, parameter_of
from phsi_opt.presentation.numbers import shortened

if TYPE_CHECKING:
    import sympy as sp


@typed
def from_sympy(
    system: Any,
    states: Sequence[Any] | None = None,
    inputs: Sequence[Any] | None = None,
    **parameters: Parameter | float,
) -> PseudoHamiltonian | FirstOrder:
    """The model of equations of motion that SymPy has.

    A ``LagrangesMethod`` becomes a `PseudoHamiltonian`: with the coordinates q, the
    Lagrangian ``L = v' M(q) v/2 + b(q)' v - V(q)`` and the forces Q of its
    ``forcelist``::

        H = (p - b)' M^-1 (p - b)/2 + V,  dq/dt = dH/dp,  dp/dt = -dH/dq + Q

    Its states are the coordinates and, behind them, the momenta: ``p`` of one
    coordinate, ``p_q1`` and so on of several. Terms of Q such as ``-c*v`` become losses
    R, all others stay forces F. What in H depends on an input or the time is a force.

    A ``KanesMethod`` becomes a `FirstOrder` of its coordinates and speeds, and so does
    a list of expressions ``dx/dt`` of the ``states``.

    Args:
        system: a LagrangesMethod without constraints, a KanesMethod whose
            ``kanes_equations`` were formed, or the right-hand sides: a list, a matrix,
            or a mapping of states to expressions.
        states: symbols or names of the states of a list of right-hand sides.
        inputs: symbols or names of the inputs; default: all functions of time that are
            no states, and ``u``, ``u1``, ``u2`` and so on.
        **parameters: values or bounds of parameters by name; a number is a fixed value.
            Symbols that are not given are free parameters.

    Raises:
        ModelError: a symbol's name cannot be used in a formula or is that of a state or
            an input, an expression has a function or a derivative that formulas lack,
            the Lagrangian is not quadratic in the velocities, there are constraints, or
            the masses are singular.

    Examples:
        >>> from sympy import cos, symbols
        >>> from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols
        >>> m, g, l = symbols("m g l")
        >>> phi = dynamicsymbols("phi")
        >>> L = m*l**2*phi.diff()**2/2 + m*g*l*cos(phi)
        >>> pendulum = ph.from_sympy(LagrangesMethod(L, [phi]), g=9.81)
        >>> print("\\n".join(str(pendulum).splitlines()[2:5]))
        dphi/dt = dH_dp
        dp/dt = - dH_dphi
        H = p**2/(2*l**2*m) - g*l*m*cos(phi)
    """
    from sympy.physics.mechanics import KanesMethod, LagrangesMethod

    known = dict(zip(parameters, map(parameter_of, parameters.values()), strict=True))
    is_kane = isinstance(system, KanesMethod)
    is_method = is_kane or isinstance(system, LagrangesMethod)
    if is_method and states is not None:
        raise ModelError(
            f"states={shown(states)} are given, but a {type(system).__name__} has its "
            "own; leave them out."
        )
    if is_method and not is_kane:
        return _of_lagrange(system, inputs, known)
    if is_kane:
        states = [*system.q, *system.u]
        rates = _rates_of_kane(system)
    else:
        states, rates = _listed(system, states)
    rates = list(map(_expression, rates))
    names = _Names.of(states, inputs, rates, known)
    variables = Variables(names.states, names.inputs)
    F: dict[str, Dictionary | str] = {}
    for x, rate in zip(names.states, rates, strict=True):
        text = _text(names.plain(rate, f"d{x}/dt"), f"d{x}/dt")
        F[x] = variables.formula(text, "F", x, known)
    model = FirstOrder(names.states, F, inputs=names.inputs)
    require_used(known, model)
    return model


# ---- Kane's method and lists ---------------------------------------------------------


def _rates_of_kane(method: Any) -> list[Any]:
    try:
        return list(method.rhs())
    except (AttributeError, ValueError):  # of what is not formed yet
        raise ModelError(
            "the KanesMethod has no equations yet; call its method "
            "kanes_equations(bodies, loads) first."
        ) from None


def _listed(system: Any, states: Sequence[Any] | None) -> tuple[list[Any], list[Any]]:
    """The states and the right-hand sides, one of each."""
    if isinstance(system, Mapping) and states is None:
        return list(system), list(system.values())
    is_list = np.iterable(system) and not isinstance(system, str | Mapping)
    rates = list(system) if is_list else []
    if not rates or states is None or len(states) != len(rates):
        raise ModelError(
            f"system={shown(system)} with states={shown(states)}; expected a "
            "LagrangesMethod, a KanesMethod, or one right-hand side for each state: "
            "from_sympy([v, -k*x/m], states=[x, v])."
        )
    return list(states), rates


# ---- Lagrange's method ---------------------------------------------------------------


def _of_lagrange(
    method: Any, inputs: Sequence[Any] | None, known: dict[str, Parameter]
) -> PseudoHamiltonian:
    import sympy as sp
    from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

    if method.coneqs:
        raise ModelError(
            f"the LagrangesMethod has a constraint on {method.coneqs[0]}; choose "
            "independent coordinates, or use KanesMethod."
        )
    q = list(method.q)
    unforced = LagrangesMethod(0, q, forcelist=method.forcelist, frame=method.inertial)
    forces = list(-unforced.form_lagranges_equations())
    # SymPy has no public name for the Lagrangian.
    names = _Names.of(q, inputs, [method._L[0], *forces], known)
    endings = [f"_{name}" if len(q) > 1 else "" for name in names.states]
    v = list(sp.symbols(list(map("v{}".format, endings)), real=True))
    p = list(sp.symbols(list(map("p{}".format, endings)), real=True))
    own = list(map(str, (*p, *v)))
    check_unique((*names.states, *own, *names.inputs), "name", ModelError)
    names.of_time.update(own)
    for coordinate, velocity in zip(q, v, strict=True):
        names.velocities[coordinate.diff(dynamicsymbols._t)] = velocity
    energies, outside = _hamiltonian(
        names.plain(method._L[0], "the Lagrangian"), v, p, names
    )
    laws = []
    for x, force in zip(names.states, forces, strict=True):
        what = f"the force on {x}"
        law = names.plain(force, what) - outside.diff(sp.Symbol(x, real=True))
        laws.append(_text(law, what))
    variables = Variables((*names.states, *map(str, p)), names.inputs)
    texts = list(map(_text, energies, repeat("the energy")))
    return energy_model(variables, list(map(str, v)), texts, laws, known)


def _hamiltonian(
    L: "sp.Expr", v: "list[sp.Symbol]", p: "list[sp.Symbol]", names: "_Names"
) -> "tuple[list[sp.Expr], sp.Expr]":
    """The terms of H, and the part of the energy that has an input or the time."""
    import sympy as sp

    at_rest = dict.fromkeys(v, 0)
    M = sp.hessian(L, v).applyfunc(sp.simplify)
    if M.free_symbols & {*v}:
        raise ModelError(
            f"the Lagrangian {shortened(str(L), 60)} is not quadratic in the "
            "velocities; expected v' M(q) v/2 + b(q)' v - V(q). Give the right-hand "
            "sides."
        )
    determinant = sp.simplify(M.det(method="berkowitz"))
    if determinant == 0:
        raise ModelError(
            f"the mass matrix {shortened(str(M.tolist()), 60)} is singular: not every "
            f"one of the coordinates {', '.join(names.states)} has an inertia of its "
            "own. Leave one out, or give it a mass."
        )
    w = sp.Matrix(p) - sp.Matrix([L]).jacobian(v).subs(at_rest).T
    kinetic = []
    if M.is_diagonal():
        for k, one in enumerate(w):
            kinetic.append(one**2 / (2 * M[k, k]))
    else:
        kinetic.append((w.T * M.adjugate() * w)[0] / (2 * determinant))
    changing = set(sp.symbols([*names.inputs, "t"], real=True))
    energies = []
    outside = sp.Integer(0)
    for term in (*kinetic, *sp.Add.make_args(sp.expand(-L.subs(at_rest)))):
        if not term.free_symbols & changing:
            energies += [term] if term else []
        elif not term.free_symbols & {*p}:
            outside += term
        else:
            raise ModelError(
                f"the kinetic energy {shortened(str(term), 60)} has an input or the "
                "time; choose coordinates relative to what moves, or use KanesMethod."
            )
    return energies, outside


# ---- symbols and formulas ------------------------------------------------------------


@dataclass(frozen=True)
class _Names:
    """Names of the states and inputs, and the symbols of known derivatives.

    ``of_time`` are names of functions of time, which no symbol can have too.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    of_time: set[str]
    velocities: "dict[sp.Expr, sp.Symbol]" = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        states: Sequence[Any],
        inputs: Sequence[Any] | None,
        expressions: "Sequence[sp.Expr]",
        known: Mapping[str, Parameter],
    ) -> "_Names":
        """The inputs are found in the expressions where they are not given."""
        from sympy.core.function import AppliedUndef
        from sympy.physics.mechanics import dynamicsymbols

        time = dynamicsymbols._t
        of_states = list(map(_name, states))
        of_inputs = list(map(_name, inputs or ()))
        functions = set().union(*(one.atoms(AppliedUndef) for one in expressions))
        functions |= {one for one in states if isinstance(one, AppliedUndef)}
        of_time = {_name(one) for one in functions if one.args == (time,)}
        if inputs is None:
            symbols = set().union(*(one.free_symbols for one in expressions))
            words = filter(re.compile(r"u\d*").fullmatch, map(str, symbols))
            of_inputs = sorted({*of_time, *words} - {*of_states, *known})
        checked = (_checked(of_states, "states"), _checked(of_inputs, "inputs"))
        return cls(*checked, of_time)

    def plain(self, expression: "sp.Expr", what: str) -> "sp.Expr":
        """An expression in real symbols by their names.

        Raises:
            ModelError: it has a derivative or a function that is not known, or a symbol
                whose name cannot be used.
        """
        import sympy as sp
        from sympy.core.function import AppliedUndef
        from sympy.physics.mechanics import dynamicsymbols

        done = expression.doit()
        plain = done.xreplace(self.velocities)
        for derivative in sorted(plain.atoms(sp.Derivative), key=str):
            raise ModelError(
                f"{derivative} in {what} is no state, input or parameter; replace it "
                "by a symbol of its own."
            )
        time = dynamicsymbols._t
        symbols = {time: sp.Symbol("t", real=True)}
        for one in sorted(plain.atoms(AppliedUndef), key=str):
            if one.args != (time,) or _name(one) not in (*self.states, *self.inputs):
                raise ModelError(
                    f"{one} in {what} is an unknown function; expected states and "
                    f"inputs ({', '.join((*self.states, *self.inputs))}) as functions "
                    "of time. Write it as an expression."
                )
            symbols[one] = sp.Symbol(_name(one), real=True)
        for one in sorted(done.free_symbols - {time}, key=str):
            _checked([one.name], "symbols")
            if one.name in self.of_time:
                raise ModelError(
                    f"the symbol {one} in {what} has the name of a function of time: "
                    "a coordinate, velocity, momentum or input. Rename it."
                )
            symbols[one] = sp.Symbol(one.name, real=True)
        return plain.xreplace(symbols)


def _checked(names: Sequence[str], what: str) -> tuple[str, ...]:
    return checked_names(names, what, RESERVED_IN_FORMULAS, ModelError)


def _expression(given: Any) -> "sp.Expr":
    """A right-hand side; a text is none, because SymPy would run it as code."""
    import sympy as sp

    with suppress(sp.SympifyError):
        expression = sp.sympify(given, strict=True)
        if isinstance(expression, sp.Expr):
            return expression
    raise ModelError(
        f"{shown(given)} is no right-hand side; expected an expression of SymPy. "
        "Formulas as text are for FirstOrder."
    )


def _name(symbol: Any) -> str:
    """The name of a symbol or a function of time; a text is a name."""
    named = getattr(symbol, "name", symbol)
    if not isinstance(named, str):
        raise ModelError(
            f"{shown(symbol)} is no symbol; expected one, a function of time or a "
            "name. Replace a derivative by a symbol of its own."
        )
    return named


def _text(expression: "sp.Expr", what: str) -> str:
    """An expression as a formula.

    Raises:
        ModelError: it has a function or a number that formulas lack.
    """
    from phsi_opt.model.sympy_backend import formula_text

    text = formula_text(expression)
    unknown = names_of(text) - set(map(str, expression.free_symbols))
    if unknown:
        raise ModelError(f"{min(unknown)} in {what} is not a finite real number.")
    return text
