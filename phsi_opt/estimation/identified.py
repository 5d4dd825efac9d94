"""A model with the values that were found: its tables, equations and simulations."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from phsi_opt.data.checks import Hold
from phsi_opt.model.model import Model
from phsi_opt.model.slots import Entry, place_of
from phsi_opt.model.symbolic import Expressions, argument_symbols
from phsi_opt.presentation.summary import printed_table
from phsi_opt.presentation.units import scale_of
from phsi_opt.simulation.simulate import rates, simulate

if TYPE_CHECKING:
    import pandas as pd
    import sympy as sp

COLUMNS = "name slot equation value std_error lower upper unit fixed"  # of parameters
DIGITS = 6  # of printed numbers: more than most data tell


@dataclass(frozen=True, eq=False, kw_only=True)
class Identified:
    """A model with the values that were found, and what can be done with it.

    Attributes:
        model: The model; the found values are the values of its parameters.
        hold: How inputs are held between samples, "linear", "zero" or "cubic", or by
            input, as the measurements declared it.
        seconds: Wall time of the whole identification, starting values included.
        removed: Names of the terms that were pruned, in order.
    """

    model: Model
    hold: Hold = "linear"
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
    def parameter_units(self) -> Mapping[str, str]:
        """Unit of every parameter by name; "" where it is not known."""
        return {name: one.parameter.unit for name, one in self.model.entries.items()}

    @property
    def parameters(self) -> "pd.DataFrame":
        """Table of the parameters, a row each, fixed ones included.

        Columns: ``name``, ``slot`` (H, R, F or sensor), ``equation`` (empty for H),
        ``value``, ``std_error`` (NaN where not known), ``lower`` and ``upper`` (the
        bounds that the solver kept), ``unit`` (of these numbers), ``fixed``. A
        parameter that every trajectory has of its own has a row per trajectory. Limits
        of confidence are those of `Fit.intervals`.
        """
        rows = []
        for entry in self.model.entries.values():
            parameter = entry.parameter
            scale = scale_of(self.parameter_units[entry.name])
            bounds = map(scale.shown, (parameter.lower, parameter.upper))
            after = (*bounds, scale.unit, parameter.fixed)
            for name, value in self._values_of(entry).items():
                known = (scale.shown(value), self.std_errors[name] / scale.size)
                rows.append((name, entry.slot, entry.equation, *known, *after))
        return printed_table(rows, columns=COLUMNS.split())

    def _values_of(self, entry: Entry) -> dict[str, float]:
        """Values of one parameter of the model by name."""
        return {entry.name: self.values[entry.name]}

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) by SciPy; arguments as in `Fit.simulate`."""
        return simulate(self.model, t, x0, u, hold=self.hold)

    def sympy(self, named: bool = False) -> "dict[str, sp.Expr]":
        """The fitted model as SymPy expressions.

        Args:
            named: whether the parameters of formulas keep their names; coefficients of
                a dictionary's terms are numbers in any case.

        Returns:
            ``H``, and for every state ``R_<state>``, ``F_<state>`` (with what acts
            along directions) and the right-hand side ``d<state>/dt``; for a direction
            of R, such as "p1 - p2", ``R_p1_p2``. They are in the names of states,
            inputs and ``t``; right-hand sides are multiplied out where that gives no
            more than 2000 terms, which takes some seconds.
        """
        import sympy as sp

        from phsi_opt.model.sympy_backend import SYMPY, n_expanded

        model = self.model
        # Real while it differentiates, or |q| has no simple derivative; plain names in
        # the result.
        x = sp.symbols(model.states, real=True)
        u = sp.symbols(model.inputs, real=True)
        t = sp.Symbol("t", real=True)
        values = {name: sp.Float(value) for name, value in self.values.items()}
        names = model.names_in_formulas if named else ()
        own = sp.symbols(names, real=True)
        values |= zip(names, own, strict=True)
        parts = Expressions(model, x, u, t, values, SYMPY)
        expressions = {"H": sp.sympify(parts.energy)}
        for equation in dict.fromkeys((*model.states, *model.R)):
            loss = sp.sympify(parts.total("R", equation))
            expressions[place_of("R", equation)] = loss
        by_state = (model.states, parts.force, parts.rates)
        for state, force, rate in zip(*by_state, strict=True):
            expressions[f"F_{state}"] = sp.sympify(force)
            is_short = n_expanded(rate) <= 2_000
            expressions[f"d{state}/dt"] = sp.expand(rate) if is_short else rate
        plain = {symbol: sp.Symbol(symbol.name) for symbol in (*x, *u, t, *own)}
        return {name: e.xreplace(plain) for name, e in expressions.items()}

    def casadi(self) -> ca.Function:
        """The fitted model as a CasADi function (x, u, t) -> dx, with dx = dx/dt.

        x is (n_states,), u (n_inputs,), t a number; the fitted numbers stand in it. An
        input ``delayed(u, tau)`` is one more of u, behind the others.
        """
        function = rates(self.model.rhs(), self.model.theta)
        x, u, t = argument_symbols(function)
        n_late = len(self.model.delays)  # the slopes in them do not count
        u = u[: u.numel() - n_late]
        dx = function(x, ca.vertcat(u, *[0.0] * n_late), t)
        return ca.Function("rates", [x, u, t], [dx], ["x", "u", "t"], ["dx"])

    def equations(self) -> list[str]:
        """The right-hand sides, one text per state: ``dp/dt = -c*p/m - k*q``.

        Parameters of formulas have their names, whose values are in ``parameters``;
        coefficients of a dictionary's terms are numbers with 6 digits. No term is left
        out, however small.
        """
        from phsi_opt.model.sympy_backend import formula_text

        return [f"d{s}/dt = {e}" for s, e in self._rounded(formula_text).items()]

    def latex(self) -> str:
        """The right-hand sides as an aligned LaTeX block, as in `equations`."""
        import sympy as sp

        rows = self._rounded(sp.latex).items()
        body = " \\\\\n".join(rf"\dot{{{symbol}}} &= {e}" for symbol, e in rows)
        return f"\\begin{{aligned}}\n{body}\n\\end{{aligned}}"

    def _rounded(self, text_of: "Callable[[sp.Expr], str]") -> dict[str, str]:
        """The right-hand side of every state as text."""
        import sympy as sp

        from phsi_opt.model.sympy_backend import without_steps

        exact = self.sympy(named=True)
        found = {}
        for state in self.model.states:
            rounded = without_steps(exact[f"d{state}/dt"]).n(DIGITS)
            whole = [one for one in rounded.atoms(sp.Float) if float(one).is_integer()]
            rounded = rounded.xreplace({one: sp.Integer(one) for one in whole})
            found[text_of(sp.Symbol(state))] = text_of(rounded)
        return found
