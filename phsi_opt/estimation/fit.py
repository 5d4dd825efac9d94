"""The result of `identify`: a frozen record with its tables, equations, exports and
file format.

A file holds numbers and formulas as text; loading one reads the text through the
whitelist of `expressions`.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from scipy.stats import t as student_t

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, PhsiOptError
from phsi_opt.estimation.result import PARAMETER_COLUMNS, Identified
from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter, Scan, Share, Tried
from phsi_opt.model.slots import BY_EQUATION, place_of
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.optimization.outcome import Outcome
from phsi_opt.simulation.simulate import simulate

FORMAT = "phsi_opt fit 1"


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Identified):
    """A fitted model.

    Attributes (beside those of `Identified`):
        loss: name of the loss; loss_value: its value at the solution, without the L1
            terms.
        names: of the free parameters; one that every trajectory has of its own appears
            as ``m[run 1]``, ``m[run 2]`` and stands in ``values`` and in the model with
            its mean. Default: those of the model.
        by_trajectory: values of the free parameters per trajectory (empty where all are
            shared).
        covariance: of the free parameters, in the order of ``names``; NaN where it is
            not known.
        noise: standard deviation of the measurement noise per state (empty for
            `PHSILoss`).
        bic: Bayesian information criterion (NaN for `PHSILoss`, whose residuals are not
            independent).
        warnings: what to know before the numbers are used.
        states: estimated states per trajectory, (n_samples, n_states) at the samples;
            empty for a loaded fit.
        steps: intervals that were used in each gap between samples, per trajectory.
        huber: limit beyond which residuals counted linearly (see `MaximumLikelihood`);
            None: all counted squared.
    """

    names: tuple[str, ...] = ()
    by_trajectory: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    loss: str
    loss_value: float
    covariance: np.ndarray
    noise: Mapping[str, float]
    outcome: Outcome
    n_values: int
    bic: float = np.nan
    units: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    states: tuple[np.ndarray, ...] = ()
    steps: tuple[np.ndarray, ...] = ()
    huber: float | None = None

    def __post_init__(self) -> None:
        if not self.names:
            object.__setattr__(self, "names", self.model.free)

    @cached_property
    def estimates(self) -> dict[str, float]:
        """Value of every free parameter by `names`."""
        own = {
            f"{n}[{run}]": v
            for run, values in self.by_trajectory.items()
            for n, v in values.items()
        }
        return {
            name: own[name] if name in own else self.values[name] for name in self.names
        }

    @cached_property
    def std_errors(self) -> dict[str, float]:
        """Standard error by name, of `names` and of the model's; NaN where fixed, at a
        bound, or not known.
        """
        known = dict(
            zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True)
        )
        return {
            **{name: known.get(name, np.nan) for name in self.model.entries},
            **known,
        }

    @property
    def correlations(self) -> pd.DataFrame:
        """Correlations of the estimates."""
        errors = np.sqrt(np.diag(self.covariance))
        return pd.DataFrame(
            self.covariance / np.outer(errors, errors),
            index=self.names,
            columns=self.names,
        )

    def intervals(self, level: float = 0.95) -> pd.DataFrame:
        """Confidence intervals from the curvature of the likelihood: value, lower,
        upper by name.

        Student's t counts the degrees of freedom that are left for the noise, which was
        estimated from the same data. Where the curvature misleads, `profile` gives
        better ones. NaN for a parameter at its bound.
        """
        if not 0 < level < 1:
            raise DataError(f"level={level!r} must lie between 0 and 1, such as 0.95.")
        reach = student_t.isf((1 - level) / 2, max(self.n_values - len(self.names), 1))
        rows = [
            (v, v - reach * self.std_errors[n], v + reach * self.std_errors[n])
            for n, v in self.estimates.items()
        ]
        return pd.DataFrame(
            rows, index=list(self.estimates), columns=["value", "lower", "upper"]
        )

    def model_of(self, run: str) -> Model:
        """The model with the parameters of one trajectory (the shared ones and means
        for a trajectory not fitted).
        """
        return self.model.with_values(self.by_trajectory.get(run, {}))

    @property
    def parameters(self) -> pd.DataFrame:
        """Table: name, slot, equation, value, std_error, lower, upper, unit, fixed; a
        row per value.
        """
        rows = []
        for name, e in self.model.entries.items():
            own = (
                [f"{name}[{run}]" for run in self.by_trajectory]
                if e.parameter.per_trajectory
                else []
            )
            for each in own or [name]:
                rows.append(
                    self._row(
                        each, e, self.estimates[each] if own else self.values[name]
                    )
                )
        return pd.DataFrame(rows, columns=PARAMETER_COLUMNS)

    def simulate(
        self, t: Any, x0: Any, u: Any = None, trajectory: str | None = None
    ) -> np.ndarray:
        """States (n_samples, n_states) from x0 at t[0], by SciPy; inputs u are held as
        the measurements declared.

        ``trajectory``: name of the one whose own parameters are meant; None: the means
        over the trajectories.
        """
        if trajectory is not None and trajectory not in self.by_trajectory:
            known = ", ".join(self.by_trajectory) or "none: all parameters are shared"
            raise DataError(
                f"trajectory {trajectory!r} has no parameters of its own in this fit; known are {known}."
            )
        model = self.model if trajectory is None else self.model_of(trajectory)
        return simulate(model, t, x0, u, hold=self.hold)

    def save(self, path: str | Path) -> None:
        """Write the fit as JSON: model, values, covariance, outcome, provenance (not
        the estimated states).
        """
        text = json.dumps(to_json(self), indent=1, allow_nan=True)
        Path(path).write_text(text + "\n", encoding="utf-8")

    @staticmethod
    def load(path: str | Path) -> "Fit":
        """Read a fit that `save` wrote; raises `DataError` for anything else. Never
        runs code from the file.
        """
        return read_json(path, FORMAT, "a fit", from_json)

    def __str__(self) -> str:
        return report(self)

    __repr__ = __str__


Made = TypeVar("Made")


def read_json(
    path: str | Path, expected: str, what: str, make: Callable[[dict[str, Any]], Made]
) -> Made:
    """Read a JSON file of the ``expected`` format and make an object of it; `DataError`
    for anything else.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path} cannot be read as {what}: {error}.") from None
    if not isinstance(content, dict) or content.get("format") != expected:
        raise DataError(
            f"{path} is not a file of the format {expected!r}; write one with save(path)."
        )
    try:
        return make(content)
    except PhsiOptError as error:
        raise DataError(f"{path} holds a model that is not valid: {error}") from None
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(
            f"{path} is damaged: {type(error).__name__} {error}. Write it again with save."
        ) from None


def report(fit: Fit) -> str:
    """The fit as text: equations with +- standard errors, what to know, and the
    solver's outcome in words.
    """
    lines = [
        f"Fit of {type(fit.model).__name__} by {fit.loss}: {', '.join(fit.model.states)}"
    ]
    lines += [f"  {row}" for row in _structure_rows(fit.model)]
    for slot, equation in _places(fit.model):
        terms = fit.model.H if slot == "H" else getattr(fit.model, slot)[equation]
        lines.append(
            f"  {place_of(slot, equation)} = "
            + " + ".join(_term(fit, term, slot, equation) for term in terms)
        )
    lines += [
        f"  {name} = {fit.values[name]:.6g} {e.parameter.unit}".rstrip() + " (fixed)"
        for name, e in fit.model.entries.items()
        if e.parameter.fixed
    ]
    if fit.noise:
        lines.append(
            "  noise: "
            + ", ".join(
                f"{n} {s:.3g} {fit.units.get(n, '')}".rstrip()
                for n, s in fit.noise.items()
            )
        )
    if fit.removed:
        lines.append(f"  removed: {', '.join(fit.removed)}")
    lines.append(
        f"  loss {fit.loss_value:.6g} over {fit.n_values} values; solver: {fit.outcome}"
    )
    return "\n".join(lines + [f"  note: {warning}" for warning in fit.warnings])


def _structure_rows(model: Model) -> list[str]:
    rows = []
    for i, name in enumerate(model.states):
        parts = [
            f"{'+' if s > 0 else '-'} {'' if abs(s) == 1 else f'{abs(s):g}*'}dH_d{model.states[j]}"
            for j, s in enumerate(model.S[i])
            if s
        ]
        if name in model.R:
            parts.append(f"- R_{name}*" + (f"dH_d{name}" if model.H.terms else name))
        if name in model.F:
            parts.append(f"+ F_{name}")
        text = " ".join(parts) or "0"
        rows.append(f"d{name}/dt = {text[2:] if text.startswith('+ ') else text}")
    return rows


def _places(model: Model) -> list[tuple[str, str]]:
    return list(dict.fromkeys((slot, equation) for slot, equation, _ in model.placed()))


def _term(fit: Fit, term: Term, slot: str, equation: str) -> str:
    place = place_of(slot, equation)
    names = {name: term.inner_name(name, place) for name in term.inner}

    def number(match: re.Match[str]) -> str:
        return (
            f"({_with_error(fit, names[match[0]])})" if match[0] in names else match[0]
        )

    body = re.sub(r"[A-Za-z_]\w*", number, term.body)
    if term.is_formula:
        return body
    coefficient = f"({_with_error(fit, term.coefficient_name(place))})"
    return coefficient if body == "1" else f"{coefficient}*{body}"


def _with_error(fit: Fit, name: str) -> str:
    entry, error = fit.model.entries[name], fit.std_errors[name]
    text = f"{fit.values[name]:.6g}"
    if entry.parameter.per_trajectory and fit.by_trajectory:
        return f"{text} {entry.parameter.unit}".rstrip() + ", mean over trajectories"
    if np.isfinite(error):
        text += f" +- {error:.2g}"
    return text + (f" {entry.parameter.unit}" if entry.parameter.unit else "")


def to_json(fit: Fit) -> dict[str, Any]:
    """The fit as numbers, text, lists and dictionaries."""
    model = fit.model
    return {
        "format": FORMAT,
        "model": {
            "kind": type(model).__name__,
            "states": list(model.states),
            "inputs": list(model.inputs),
            "memory": list(model.memory),
            "S": [list(row) for row in model.S],
            "H": [_term_json(term) for term in model.H],
            "R": {
                name: [_term_json(term) for term in terms]
                for name, terms in model.R.items()
            },
            "F": {
                name: [_term_json(term) for term in terms]
                for name, terms in model.F.items()
            },
            "sensor": {
                name: [_term_json(term) for term in terms]
                for name, terms in model.sensor.items()
            },
        },
        "names": list(fit.names),
        "by_trajectory": {
            run: dict(values) for run, values in fit.by_trajectory.items()
        },
        "loss": fit.loss,
        "loss_value": fit.loss_value,
        "covariance": fit.covariance.tolist(),
        "noise": dict(fit.noise),
        "outcome": {**vars(fit.outcome), "at_bounds": list(fit.outcome.at_bounds)},
        "n_values": fit.n_values,
        "bic": fit.bic,
        "hold": fit.hold,
        "huber": fit.huber,
        "steps": [
            int(n[0]) if len(n) and np.all(n == n[0]) else n.tolist() for n in fit.steps
        ],
        "n_gaps": [len(n) for n in fit.steps],
        "seconds": fit.seconds,
        "units": dict(fit.units),
        "removed": list(fit.removed),
        "warnings": list(fit.warnings),
        "provenance": dict(fit.provenance),
    }


def _term_json(term: Term) -> dict[str, Any]:
    return {
        "body": term.body,
        "coefficient": None
        if term.coefficient is None
        else _parameter_json(term.coefficient),
        "inner": {
            name: _parameter_json(parameter) for name, parameter in term.inner.items()
        },
        "name": term.name,
    }


def _parameter_json(p: Parameter) -> dict[str, Any]:
    guess = (
        None if p.guess is None else [type(p.guess).__name__, *vars(p.guess).values()]
    )
    return {
        "value": p.value,
        "lower": p.lower,
        "upper": p.upper,
        "unit": p.unit,
        "fixed": p.fixed,
        "guess": guess,
        "per_trajectory": p.per_trajectory,
    }


def from_json(content: dict[str, Any]) -> Fit:
    """The fit that `to_json` wrote."""
    m = content["model"]
    slots = {
        slot: {n: _dictionary(terms) for n, terms in m.get(slot, {}).items()}
        for slot in BY_EQUATION
    }
    common: dict[str, Any] = {
        "states": m["states"],
        "inputs": m["inputs"],
        "memory": m.get("memory", []),
        **slots,
    }
    energy = (
        {"S": m["S"], "H": _dictionary(m["H"])}
        if m["kind"] == "PseudoHamiltonian"
        else {}
    )
    model: Model = {"PseudoHamiltonian": PseudoHamiltonian, "FirstOrder": FirstOrder}[
        m["kind"]
    ](**common, **energy)
    names = tuple(str(name) for name in content.get("names", model.free))
    covariance = np.array(content["covariance"], dtype=float).reshape(
        len(names), len(names)
    )
    if content["hold"] not in ("linear", "zero"):
        raise DataError(
            f"hold={content['hold']!r} is unknown; expected 'linear' or 'zero'."
        )
    return Fit(
        model=model,
        names=names,
        by_trajectory={
            str(run): {str(name): float(value) for name, value in values.items()}
            for run, values in content.get("by_trajectory", {}).items()
        },
        loss=str(content["loss"]),
        loss_value=float(content["loss_value"]),
        covariance=covariance,
        noise={str(name): float(value) for name, value in content["noise"].items()},
        outcome=_outcome_from(content["outcome"]),
        n_values=int(content["n_values"]),
        bic=float(content["bic"]),
        hold=content["hold"],
        huber=None if content.get("huber") is None else float(content["huber"]),
        steps=tuple(
            np.broadcast_to(np.array(n, dtype=int), gaps).copy()
            for n, gaps in zip(
                content.get("steps", []), content.get("n_gaps", []), strict=True
            )
        ),
        seconds=float(content.get("seconds", np.nan)),
        units={str(name): str(unit) for name, unit in content["units"].items()},
        removed=tuple(str(name) for name in content["removed"]),
        warnings=tuple(str(warning) for warning in content["warnings"]),
        provenance=dict(content["provenance"]),
    )


def _outcome_from(content: dict[str, Any]) -> Outcome:
    return Outcome(
        success=bool(content["success"]),
        status=str(content["status"]),
        sentence=str(content["sentence"]),
        advice=str(content["advice"]),
        iterations=int(content["iterations"]),
        seconds=float(content["seconds"]),
        objective=float(content["objective"]),
        infeasibility=float(content["infeasibility"]),
        at_bounds=tuple(str(name) for name in content["at_bounds"]),
    )


def _dictionary(terms: list[dict[str, Any]]) -> Dictionary:
    return Dictionary(tuple(_term_from(term) for term in terms))


def _term_from(content: dict[str, Any]) -> Term:
    inner = {name: _parameter_from(p) for name, p in content["inner"].items()}
    coefficient = (
        None
        if content["coefficient"] is None
        else _parameter_from(content["coefficient"])
    )
    return Term(content["body"], coefficient, inner, content["name"])


def _parameter_from(content: dict[str, Any]) -> Parameter:
    guesses = {"Scan": Scan, "Share": Share, "Tried": Tried}
    guess = content["guess"]
    made = None if guess is None else guesses[guess[0]](*guess[1:])
    return Parameter(**{**content, "guess": made})


def parameters_of(fit: Fit, data: Measurements) -> dict[str, dict[str, float]]:
    """Values of the free parameters per trajectory; the means of the fit for one that
    it has not seen.
    """
    free = {name: fit.values[name] for name in fit.model.free}
    return {
        run.name: {**free, **fit.by_trajectory.get(run.name, {})}
        for run in data.trajectories
    }


def matrix_of(model: Model, values: Mapping[str, Mapping[str, float]]) -> np.ndarray:
    """Parameters as columns, (n_free, n_trajectories)."""
    return np.array(
        [[of_run[name] for of_run in values.values()] for name in model.free]
    ).reshape(-1, len(values))
