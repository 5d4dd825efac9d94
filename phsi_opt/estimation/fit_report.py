"""A fit as text: its equations with standard errors, and what to know about them.

Exact equations, without errors and in one line each, are `Identified.equations`.
"""

import re
from functools import partial

from phsi_opt.estimation.fit_record import FitRecord
from phsi_opt.estimation.identified import DIGITS
from phsi_opt.model.symbolic import dictionary_rows, structure_rows
from phsi_opt.model.terms import Term
from phsi_opt.presentation.numbers import estimate_text
from phsi_opt.presentation.sentences import lines
from phsi_opt.presentation.summary import Part, Summary

# Ratio of two standard errors beyond which both are told.
DIFFERENT_STD_ERRORS = 4 / 3

SHOWN_PARAMETERS = ("name", "value", "std_error", "unit")
IDENTIFIER = re.compile(r"[A-Za-z_]\w*")

LONG_NUMBER = re.compile(r"(?<![\w.])\d+\.\d{7,}(?:e[+-]?\d+)?")


def report(fit: FitRecord) -> str:
    """The fit as text, for a terminal.

    Returns:
        The structure of the model, every term with its estimates as value +- standard
        error and unit, fixed parameters, noise and removed terms, the solver's outcome
        in words, and the warnings; a line each.
    """
    rows = [*equation_lines(fit), *_remarks(fit)]
    return "\n".join([_title(fit), *(f"  {row}" for row in rows)])


def fit_summary(fit: FitRecord) -> Summary:
    """The fit for notebooks and rich: as in `report`, its parameters in a table."""
    return Summary(
        _title(fit),
        (
            Part(code="\n".join(equation_lines(fit))),
            Part(table=fit.parameters[list(SHOWN_PARAMETERS)]),
            Part(text="\n".join(_remarks(fit))),
        ),
    )


def _title(fit: FitRecord) -> str:
    states = ", ".join(fit.model.states)
    return f"Fit of {type(fit.model).__name__} by {fit.loss}: {states}"


def equation_lines(fit: FitRecord) -> list[str]:
    """Structure, terms with their estimates, and fixed parameters; a line each."""
    rows = [
        *structure_rows(fit.model),
        *dictionary_rows(fit.model, partial(_term, fit)),
        *_fixed(fit),
    ]
    return [LONG_NUMBER.sub(_few_digits, row) for row in rows]


def _few_digits(found: re.Match[str]) -> str:
    return f"{float(found[0]):.{DIGITS}g}"


def _remarks(fit: FitRecord) -> list[str]:
    """What ``answers.jinja`` says: noise, standard errors, solver, warnings."""
    # By how much others sources differ, where they do.
    errors = fit.standard_errors.drop(columns="freedom")
    ratios = errors.div(errors.pop("std_error"), axis=0).agg(["min", "max"]).T
    limit = DIFFERENT_STD_ERRORS
    different = ratios[(ratios["max"] >= limit) | (ratios["min"] <= 1 / limit)]
    rows = different.drop(index=str(fit.std_error_source), errors="ignore").itertuples()
    return lines(__package__, "remarks", fit=fit, different=list(rows)).splitlines()


def _term(fit: FitRecord, term: Term, place: str, number: int) -> str:
    """The term with every parameter replaced by its estimate in brackets."""

    def estimate_of(match: re.Match[str]) -> str:
        name = match[0]
        if name not in term.inner:
            return name
        return f"({_estimate(fit, term.inner_name(name, place))})"

    # In one pass: a unit that was put in may have the name of another parameter.
    body = IDENTIFIER.sub(estimate_of, term.body)
    if term.is_formula:
        return body
    coefficient = f"({_estimate(fit, term.coefficient_name(place))})"
    return coefficient if term.body == "1" else f"{coefficient}*{body}"


def _estimate(fit: FitRecord, name: str) -> str:
    """Value +- standard error and unit; of a parameter per trajectory only the mean."""
    parameter = fit.model.entries[name].parameter
    known = fit.parameter_units[name]
    unit = f" {known}" if known else ""
    value = fit.values[name]
    if parameter.per_trajectory and fit.by_trajectory:
        return f"{value:.6g}{unit}, mean over trajectories"
    if name in fit.outcome.at_bounds:
        return f"{parameter.nearest_bound(value):.6g}{unit}, at its bound"
    return f"{estimate_text(value, fit.std_errors[name])}{unit}"


def _fixed(fit: FitRecord) -> list[str]:
    rows = []
    for name, entry in fit.model.entries.items():
        if entry.parameter.fixed:
            value = f"{fit.values[name]:.6g} {fit.parameter_units[name]}".rstrip()
            rows.append(f"{name} = {value} (fixed)")
    return rows
