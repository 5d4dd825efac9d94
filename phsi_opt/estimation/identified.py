"""What every method of identification returns: a model with the values it found.

Its table, equations, exports and simulation are the same whichever method found the
values; what only one method knows (covariance, history) is added by its own result.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from phsi_opt.data.checks import Hold
from phsi_opt.model.model import Model
from phsi_opt.model.slots import Entry
from phsi_opt.model.symbolic import Expressions
from phsi_opt.presentation.summary import printed_table
from phsi_opt.simulation.simulate import rates, simulate

if TYPE_CHECKING:
    import pandas as pd
    import sympy as sp

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
DIGITS = 6  # of printed numbers: more than most data tell
MOST_TERMS = 2_000  # that a right-hand side is multiplied out to: some seconds


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
        bounds that the solver kept), ``unit``, ``fixed``. A parameter that every
        trajectory has of its own has a row per trajectory. Limits of confidence are
        those of `Fit.intervals`.
        """
        rows = []
        for entry in self.model.entries.values():
            for name, value in self._values_of(entry).items():
                rows.append(self._row(name, entry, value))
        return printed_table(rows, columns=PARAMETER_COLUMNS)

    def _values_of(self, entry: Entry) -> dict[str, float]:
        """Values of one parameter of the model by name."""
        return {entry.name: self.values[entry.name]}

    def _row(self, name: str, entry: Entry, value: float) -> dict[str, Any]:
        parameter = entry.parameter
        return {
            "name": name,
            "slot": entry.slot,
            "equation": entry.equation,
            "value": value,
            "std_error": self.std_errors[name],
            "lower": parameter.lower,
            "upper": parameter.upper,
            "unit": self.parameter_units[entry.name],
            "fixed": parameter.fixed,
        }

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """Simulate the fitted model from given starting states, by SciPy.

        Inputs are held between samples as the measurements declared it.

        Args:
            t: (n_samples,) times, increasing; the simulation starts at ``t[0]``.
            x0: (n_states,) states at ``t[0]``.
            u: (n_samples, n_inputs) inputs at the times, or a function of the time;
                None: the model has none.

        Returns:
            (n_samples, n_states) states at the times.

        Raises:
            DataError: An argument has the wrong shape.
            SolveError: The simulation broke off before the last time.
        """
        return simulate(self.model, t, x0, u, hold=self.hold)

    def sympy(self) -> "dict[str, sp.Expr]":
        """The fitted model as SymPy expressions.

        Returns:
            ``H``, and for every state ``R_<state>``, ``F_<state>`` and the right-hand
            side ``d<state>/dt``, in the names of states, inputs and ``t``; right-hand
            sides are multiplied out where that gives no more than `MOST_TERMS` terms.
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
        parts = Expressions(model, x, u, t, values, SYMPY)
        expressions = {"H": sp.sympify(parts.energy)}
        by_state = (model.states, parts.loss, parts.force, parts.rates)
        for state, loss, force, rate in zip(*by_state, strict=True):
            expressions[f"R_{state}"] = sp.sympify(loss)
            expressions[f"F_{state}"] = sp.sympify(force)
            is_short = n_expanded(rate) <= MOST_TERMS
            expressions[f"d{state}/dt"] = sp.expand(rate) if is_short else rate
        plain = {symbol: sp.Symbol(symbol.name) for symbol in (*x, *u, t)}
        return {name: e.xreplace(plain) for name, e in expressions.items()}

    def casadi(self) -> ca.Function:
        """The fitted model as a CasADi function (x, u, t) -> dx, with dx = dx/dt.

        x is (n_states,), u (n_inputs,), t a number; the fitted numbers stand in it.
        """
        return rates(self.model)

    def equations(self) -> list[str]:
        """The right-hand sides with the fitted numbers, one text per state.

        Numbers have 6 digits; no term is left out, however small.
        """
        import sympy as sp

        return [f"d{s}/dt = {sp.sstr(e)}" for s, e in self._rounded().items()]

    def latex(self) -> str:
        """The right-hand sides as an aligned LaTeX block, numbers with 6 digits."""
        import sympy as sp

        rows = []
        for state, expression in self._rounded().items():
            symbol = sp.latex(sp.Symbol(state))
            rows.append(rf"\dot{{{symbol}}} &= {sp.latex(expression)}")
        body = " \\\\\n".join(rows)
        return f"\\begin{{aligned}}\n{body}\n\\end{{aligned}}"

    def _rounded(self) -> "dict[str, sp.Expr]":
        """The right-hand side of every state, numbers with `DIGITS` digits."""
        exact = self.sympy()
        return {s: exact[f"d{s}/dt"].n(DIGITS) for s in self.model.states}
