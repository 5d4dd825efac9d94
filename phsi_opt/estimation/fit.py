"""The result of `identify`: the record with its forms, as text, file and picture.

The numbers and tables are those of `FitRecord`. A file leaves the estimated states out:
they are as long as the record, and a fit is used without them.
"""

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.arguments import require_known, typed
from phsi_opt.data.checks import checked_hold
from phsi_opt.errors import DataError
from phsi_opt.estimation.fit_file import (
    Content,
    check_keys,
    decoded,
    encoded,
    read_json,
)
from phsi_opt.estimation.fit_record import DIGITS, FitRecord
from phsi_opt.later import Later
from phsi_opt.model.laws import parameter_words
from phsi_opt.model.symbolic import dictionary_rows, structure_rows
from phsi_opt.model.terms import Term
from phsi_opt.presentation.numbers import estimate_text
from phsi_opt.presentation.sentences import lines
from phsi_opt.presentation.summary import Part, Summarised, Summary, filled
from phsi_opt.presentation.units import scale_of, spaced
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.writing import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FORMAT = "phsi_opt fit 2"
PLOTTED_LEVEL = 0.95  # of confidence: the convention of most tables and pictures
# Ratio of two standard errors beyond which the report gives both.
DIFFERENT_STD_ERRORS = 4 / 3
IDENTIFIER = re.compile(r"[A-Za-z_]\w*")
LONG_NUMBER = re.compile(r"(?<![\w.])\d+\.\d{7,}(?:e[+-]?\d+)?")


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(FitRecord, Summarised):
    """A fitted model: values, standard errors, solver's outcome and provenance.

    ``print(fit)`` shows the equations with standard errors, the outcome and warnings.

    - Numbers: ``parameters`` (a table), ``estimates``, ``std_errors``,
      ``intervals(level)``, ``correlations``, ``noise``, ``bic``.
    - Equations: ``equations()`` and ``latex()`` in the names of the parameters;
      ``sympy()`` and ``casadi()`` with the fitted numbers.
    - Simulation: ``simulate(t, x0, u)``; ``model`` is the fitted model,
      ``model_of(trajectory)`` that of one trajectory.
    - Forms: ``print(fit)``, ``plot()``, ``save(path)`` and ``Fit.load(path)``.
    - Reliability: ``outcome`` says how the solver ended; read ``warnings`` before you
      use the numbers.

    The attributes are those of `FitRecord`. A fit is never changed in place.
    """

    def save(self, path: str | Path) -> None:
        """Write the fit as a JSON file that `load` reads.

        The file contains numbers and formulas as text: model, values, covariance,
        outcome and provenance, with all digits, but not the estimated states.

        Args:
            path: Of the file, such as "fit.json". An existing file is overwritten.

        Raises:
            DataError: The file cannot be written.
        """
        write_whole(path, json.dumps(self.content(), indent=1) + "\n")

    @classmethod
    @partial(typed, error=DataError)
    def load(cls, path: str | Path) -> "Fit":
        """Read a fit that `save` wrote.

        No code from the file is executed: formulas are parsed with a list of allowed
            functions.

        Args:
            path: Of the file.

        Returns:
            The fit that was saved, except for ``states``, which is empty.

        Raises:
            DataError: The file cannot be read, has another format, is damaged, or
                contains an invalid formula.
        """
        return read_json(path, FORMAT, "a fit", cls.from_content)

    def content(self) -> Content:
        """The fit as numbers, text, lists and mappings: what `save` writes."""
        return {"format": FORMAT, **encoded(replace(self, states=()))}

    @classmethod
    def from_content(cls, content: Content) -> "Fit":
        """The fit from the numbers and text that `content` returned.

        Raises:
            DataError: A part of the content has a value that no fit can have.
            ModelError: The model in the content is not valid.
            LookupError, TypeError, ValueError, AttributeError: The content is damaged.
        """
        known = dict(content)
        del known["format"]
        fit = decoded(cls, known)
        model = fit.model
        unknown = Theta.of(model, tuple(fit.by_trajectory) or ("",))
        check_keys(dict.fromkeys(fit.names), unknown.names)
        for values in fit.by_trajectory.values():
            check_keys(values, model.free)
        _check_names(fit.noise, model.states)
        _check_names(fit.units, (*model.states, *model.inputs, "t"))
        hold = checked_hold(fit.hold, model.inputs)
        n = len(fit.names)
        covariance = fit.covariance.reshape(n, n)
        freedom = fit.degrees_of_freedom
        if freedom.shape != (n,):
            raise DataError(f"{freedom.size} degrees of freedom for {n} estimates")
        for what, numbers in {
            "the variances of the estimates": np.diag(covariance).tolist(),
            "noise": list(fit.noise.values()),
            "degrees of freedom": freedom.tolist(),
            "n_values": [fit.n_values],
        }.items():
            if np.any(np.array(numbers) < 0):
                raise DataError(f"{what}: {numbers}; none can be negative")
        by_source = fit.covariances.items()
        uncertainty = replace(
            fit.uncertainty.value,
            covariance=covariance,
            covariances={source: one.reshape(n, n) for source, one in by_source},
        )
        return replace(fit, hold=hold, uncertainty=Later.known(uncertainty))

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Draw every estimate with its 95 % interval.

        Intervals are drawn in percent of the estimate's absolute value; the labels give
        the numbers with their units. Orange intervals reach beyond zero. A square marks
        a parameter that ended at a bound, an open circle one without a standard error
        (``warnings`` says why).

        Args:
            ax: Axes to draw on; None: a new figure.

        Returns:
            The axes; ``fit.plot().figure.savefig("fit.png")`` stores the picture.
        """
        from phsi_opt.presentation.pictures import plot_estimates

        table = self.parameters.set_index("name").loc[list(self.names)]
        table["half_width"] = self._std_errors_within(PLOTTED_LEVEL)
        table["half_width"] *= table["std_error"]
        table["at_bound"] = table.index.isin(self.outcome.at_bounds)
        return plot_estimates(table.reset_index(), PLOTTED_LEVEL, ax)

    def _summary(self) -> Summary:
        """For notebooks and rich: as the text, the parameters in a table."""
        shown = self.parameters[["name", "value", "std_error", "unit"]]
        equations = Part(code="\n".join(equation_lines(self)))
        remarks = Part(text="\n".join(_remarks(self)))
        return Summary(_title(self), (equations, Part(table=shown), remarks))

    def __str__(self) -> str:
        equations = (f"  {row}" for row in equation_lines(self))
        remarks = filled("\n".join(_remarks(self)), "  ")
        return "\n".join([filled(_title(self)), *equations, remarks])

    __repr__ = __str__


def _check_names(names: Iterable[str], known: Sequence[str]) -> None:
    for name in names:
        require_known(name, known, f"{name!r} is not in the model", DataError)


# ---- text ----------------------------------------------------------------------------


def _title(fit: FitRecord) -> str:
    states = ", ".join(fit.model.states)
    title = f"Fit of {type(fit.model).__name__} by {fit.loss}: {states}"
    return f"{fit.caution}\n{title}".lstrip()


def equation_lines(fit: FitRecord) -> list[str]:
    """Structure, terms, and the parameters of formulas by name; a line each.

    Coefficients and inner parameters of a dictionary's terms stand in the terms.
    """
    rows = structure_rows(fit.model)
    rows += dictionary_rows(fit.model, partial(_term, fit))
    own = fit.model.names_in_formulas
    for name, entry in fit.model.entries.items():
        fixed = " (fixed)" if entry.parameter.fixed else ""
        if fixed or name in own:
            told = name if name in own else parameter_words(fit.model, name)
            rows.append(f"{told} = {_estimate(fit, name)}{fixed}")
    rounded = partial(LONG_NUMBER.sub, lambda found: f"{float(found[0]):.{DIGITS}g}")
    return list(map(rounded, rows))


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
    """A formula as it is; a term with every parameter replaced by its estimate."""
    if term.is_formula:
        return term.body

    def estimate_of(match: re.Match[str]) -> str:
        name = match[0]
        if name not in term.inner:
            return name
        return f"({_estimate(fit, term.parameter_name(place, name))})"

    # In one pass: a unit that was put in may have the name of another parameter.
    coefficient = f"({_estimate(fit, term.parameter_name(place))})"
    return term.product(coefficient, IDENTIFIER.sub(estimate_of, term.body))


def _estimate(fit: FitRecord, name: str) -> str:
    """Value +- standard error and unit; of a parameter per trajectory only the mean."""
    parameter = fit.model.entries[name].parameter
    scale = scale_of(fit.parameter_units[name])
    unit = spaced(scale.unit)
    value = scale.shown(fit.values[name])
    if parameter.fixed:
        digits = DIGITS if parameter.guess is None else 3  # a rough rule gave it
        return f"{value:.{digits}g}{unit}"
    if parameter.per_trajectory and fit.by_trajectory:
        return f"{value:.6g}{unit}, mean over trajectories"
    if name in fit.outcome.at_bounds:
        bound = parameter.nearest_bound(fit.values[name])
        return f"{scale.shown(bound):.6g}{unit}, at its bound"
    return f"{estimate_text(value, fit.std_errors[name] / scale.size)}{unit}"
