"""What every method of identification returns: a model with values, its tables,
equations, exports and simulation.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
import sympy as sp

from phsi_opt.model.backends import SYMPY
from phsi_opt.model.model import Model
from phsi_opt.model.slots import Entry
from phsi_opt.simulation.simulate import simulate

PARAMETER_COLUMNS = [
    "name",
    "slot",
    "equation",
    "value",
    "std_error",
    "lower",
    "upper",
    "unit",
    "fixed",
]


@dataclass(frozen=True, eq=False, kw_only=True)
class Identified:
    """What every method of identification returns: a model with the values it found,
    and what can be done with them.

    Attributes:
        model: with the found values as values of its parameters.
        hold: of the inputs between samples, as the measurements declared it.
        seconds: wall time of the whole identification, starting values included.
        removed: terms that were pruned, in order.
    """

    model: Model
    hold: str = "linear"
    seconds: float = np.nan
    removed: tuple[str, ...] = ()

    @property
    def values(self) -> dict[str, float]:
        """Value of every parameter by name."""
        return self.model.values

    @property
    def std_errors(self) -> Mapping[str, float]:
        """Standard error by name; NaN where it is not known."""
        return dict.fromkeys(self.model.entries, np.nan)

    @property
    def parameters(self) -> pd.DataFrame:
        """Table: name, slot, equation, value, std_error, lower, upper, unit, fixed."""
        rows = [
            self._row(name, e, self.values[name])
            for name, e in self.model.entries.items()
        ]
        return pd.DataFrame(rows, columns=PARAMETER_COLUMNS)

    def _row(self, name: str, e: Entry, value: float) -> tuple[Any, ...]:
        p = e.parameter
        return (
            name,
            e.slot,
            e.equation,
            value,
            self.std_errors[name],
            p.lower,
            p.upper,
            p.unit,
            p.fixed,
        )

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) from x0 at t[0], by SciPy; inputs u are held as
        the measurements declared.
        """
        return simulate(self.model, t, x0, u, hold=self.hold)

    def sympy(self) -> dict[str, sp.Expr]:
        """SymPy expressions with the fitted numbers: 'H', 'R_<state>', 'F_<state>' and
        'd<state>/dt'.
        """
        # Real while it differentiates, or |q| has no simple derivative; plain names in
        # the result.
        x, u = (
            sp.symbols(names, real=True)
            for names in (self.model.states, self.model.inputs)
        )
        t = sp.Symbol("t", real=True)
        values = {name: sp.Float(value) for name, value in self.values.items()}
        e = self.model.expressions(x, u, t, values, SYMPY)
        result = {"H": sp.sympify(e.energy)}
        for i, name in enumerate(self.model.states):
            exchange = sum(
                (
                    sp.Float(s) * e.efforts[j]
                    for j, s in enumerate(self.model.S[i])
                    if s
                ),
                start=sp.Integer(0),
            )
            result[f"R_{name}"], result[f"F_{name}"] = (
                sp.sympify(e.loss[i]),
                sp.sympify(e.force[i]),
            )
            result[f"d{name}/dt"] = sp.expand(
                exchange - e.loss[i] * e.efforts[i] + e.force[i]
            )
        plain = {symbol: sp.Symbol(symbol.name) for symbol in (*x, *u, t)}
        return {name: expression.xreplace(plain) for name, expression in result.items()}

    def casadi(self) -> ca.Function:
        """CasADi function (x, u, t) -> dx/dt with the fitted numbers."""
        x, u, t = (
            ca.SX.sym("x", self.model.n_states),
            ca.SX.sym("u", self.model.n_inputs),
            ca.SX.sym("t"),
        )
        theta = [self.values[name] for name in self.model.free]
        return ca.Function(
            "fitted",
            [x, u, t],
            [self.model.rhs()(x, u, t, theta)],
            ["x", "u", "t"],
            ["dx"],
        )

    def equations(self) -> list[str]:
        """The right-hand sides with every fitted number (6 digits), one text per state;
        no term is left out.
        """
        exact = self.sympy()
        return [
            f"d{name}/dt = {sp.sstr(exact[f'd{name}/dt'].n(6))}"
            for name in self.model.states
        ]

    def latex(self) -> str:
        """The right-hand sides as an aligned LaTeX block."""
        exact = self.sympy()
        rows = [
            rf"\dot{{{sp.latex(sp.Symbol(n))}}} &= {sp.latex(exact[f'd{n}/dt'].n(6))}"
            for n in self.model.states
        ]
        return "\\begin{aligned}\n" + " \\\\\n".join(rows) + "\n\\end{aligned}"
