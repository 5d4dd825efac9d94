"""A model as linear regressions of its rates, one per equation.

dx_i/dt = known_i + Theta_i xi_i. What is not linear, has bounds or stands in two
equations is refused here. How the regressions are solved is in `sindy`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from phsi_opt.arguments import require
from phsi_opt.data.checks import hold_of_each
from phsi_opt.data.measurements import Measurements
from phsi_opt.data.trajectory import SmoothInputs
from phsi_opt.errors import DataError, ModelError, did_you_mean
from phsi_opt.model.model import FirstOrder, Model
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import place_of
from phsi_opt.model.terms import Dictionary
from phsi_opt.transcription.grid import aligned_once


@dataclass(frozen=True, eq=False)
class Regression:
    """One equation: rates = columns times the coefficients.

    Attributes:
        equation: the state whose rate it is.
        names: of the coefficients.
        columns: (n_rows, n_terms), the terms at the samples.
        rates: (n_rows,), less the terms whose coefficient is known.
    """

    equation: str
    names: tuple[str, ...]
    columns: np.ndarray
    rates: np.ndarray


def with_fixed(model: FirstOrder, fixed: Mapping[str, float]) -> Model:
    """The model with parameters held at the given values."""
    if not isinstance(model, FirstOrder):
        raise ModelError(
            "SINDy regresses rates on terms, so it needs a FirstOrder model, "
            f"not {type(model).__name__}; write the right-hand sides as dictionaries: "
            "FirstOrder(states, {'q': polynomials(...), ...})."
        )
    for name, value in fixed.items():
        if name not in model.entries:
            raise ModelError(
                f"fixed names {name!r}, which is not in the model."
                f"{did_you_mean(name, model.entries)}"
            )
        fine = isinstance(value, int | float | np.number) and bool(np.isfinite(value))
        require(fine, f"fixed[{name!r}]", value, "a finite number")

    def held(name: str, parameter: Parameter) -> Parameter:
        if name not in fixed:
            return parameter
        return replace(parameter, value=fixed[name], fixed=True)

    def all_held(slot: str, old: Mapping[str, Dictionary]) -> dict[str, Dictionary]:
        new = {}
        for equation, terms in old.items():
            place = place_of(slot, equation)
            changed = [term.with_parameters(place, held) for term in terms]
            new[equation] = Dictionary(tuple(changed))
        return new

    result = replace(model, F=all_held("F", model.F), R=all_held("R", model.R))
    if not result.free:
        raise ModelError(
            "the model has no free coefficient, so there is nothing to regress."
        )
    return result


def regressions(model: Model, data: Measurements) -> tuple[Regression, ...]:
    """The regression of each equation that has unknown coefficients."""
    record = aligned_once(model, data)
    _check_complete(record)
    theta = ca.SX.sym("th", len(model.free))
    x = ca.SX.sym("x", model.n_states)
    u = ca.SX.sym("u", model.n_inputs)
    t = ca.SX.sym("t", 1)
    dx = model.rhs()(x, u, t, theta)
    slopes = ca.jacobian(dx, theta)
    _check_regression(model, slopes, theta)
    x_at, u_at, t_at, rates_at = midpoint_rates(record)
    at_zero = np.zeros((len(model.free), 1))
    problems = []
    for i, equation in enumerate(model.states):
        pattern = slopes.sparsity()
        chosen = [k for k in range(len(model.free)) if pattern.has_nz(i, k)]
        if not chosen:
            continue
        row = ca.densify(ca.horzcat(dx[i], slopes[i, chosen])).T
        at_samples = ca.Function("row", [x, u, t, theta], [row]).map(len(t_at))
        terms = np.array(at_samples(x_at.T, u_at.T, t_at[None, :], at_zero)).T
        names = tuple(model.free[k] for k in chosen)
        _check_columns(equation, names, terms)
        # At zero coefficients dx is what is known already: the terms with fixed
        # coefficients.
        known = terms[:, 0]
        rates = rates_at[:, i] - known
        problems.append(Regression(equation, names, terms[:, 1:], rates))
    return tuple(problems)


def midpoint_rates(data: Measurements) -> tuple[np.ndarray, ...]:
    """States, inputs and times at the middle of every interval, and the rates
    (x1 - x0)/h there, a row per interval of all trajectories.

    PHSI needs none of this: its loss compares steps, not rates.
    """
    hold = hold_of_each(data.hold, data.inputs)
    parts = []
    for run in data.trajectories:
        x, u, t = ((v[1:] + v[:-1]) / 2 for v in (run.x, run.u, run.t))
        u = np.where(hold == "zero", run.u[:-1], u)
        if "cubic" in hold:
            first, last = SmoothInputs(run.t, run.u).lines(run.t[:-1], run.t[1:])
            u = np.where(hold == "cubic", (first + last) / 2, u)
        parts.append((x, u, t, np.diff(run.x, axis=0) / np.diff(run.t)[:, None]))
    return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))


def _check_complete(data: Measurements) -> None:
    for run in data.trajectories:
        missing = np.argwhere(~np.isfinite(run.x))
        if len(missing):
            i, k = missing[0]
            raise DataError(
                f"trajectory {run.name!r}: "
                f"{data.states[k]} at t[{i}]={run.t[i]:g} is missing, "
                "but SINDy needs every state at every sample; leave the sample out, "
                "or use identify with MaximumLikelihood()."
            )


def _check_regression(model: Model, slopes: ca.SX, theta: ca.SX) -> None:
    """Refuse what is not a linear regression of each equation on its own."""
    entries = [model.entries[name] for name in model.free]
    bent = [k for k in range(len(entries)) if ca.depends_on(slopes[:, k], theta)]
    if bent:
        # A wave's amplitude is bent by its frequency; the frequency, bent by itself
        # too, is the one to name.
        own = [not ca.depends_on(slopes[:, k], theta[k]) for k in bent]
        rank = [
            (alone, entries[k].prunable, k) for alone, k in zip(own, bent, strict=True)
        ]
        name = entries[min(rank)[2]].name
        raise ModelError(
            f"parameter {name!r} does not enter linearly, "
            "so a regression such as SINDy cannot learn it; "
            "give a frequency=... (or value) and fix it: "
            f"fixed={{{name!r}: 1.0}}."
        )
    for k, entry in enumerate(entries):
        lower, upper = entry.parameter.lower, entry.parameter.upper
        if np.isfinite(lower) or np.isfinite(upper):
            raise ModelError(
                f"parameter {entry.name!r} has bounds [{lower:g}, {upper:g}], "
                "which a regression does not keep; use Parameter() without bounds "
                "(damping: put the state into the dictionary of F)."
            )
        pattern = slopes.sparsity()
        equations = [x for i, x in enumerate(model.states) if pattern.has_nz(i, k)]
        if len(equations) > 1:
            raise ModelError(
                f"parameter {entry.name!r} stands in the equations of "
                f"{' and '.join(equations)}, "
                "but SINDy regresses each equation on its own; use two names."
            )


def _check_columns(equation: str, names: tuple[str, ...], values: np.ndarray) -> None:
    """Check the known terms, then the columns of the names, (n_rows, 1 + n_names)."""
    unbounded = np.argwhere(~np.isfinite(values))
    if len(unbounded):
        k = int(unbounded[0][1])
        what = f"term {names[k - 1]!r}" if k else "a known term"
        raise DataError(
            f"{what} of d{equation}/dt is not finite over the data; "
            "check the formula's range."
        )
    if len(values) < len(names):
        raise DataError(
            f"d{equation}/dt has {len(names)} terms "
            f"but the data give {len(values)} rates; "
            "measure more or shorten the dictionary."
        )
