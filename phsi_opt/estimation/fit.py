"""The result of `identify`: the record with its forms, as text, file and picture.

The numbers and tables are those of `FitRecord`; each form is made in a file of its own,
and this one joins them.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.fit_content import FORMAT, fit_content, fit_parts
from phsi_opt.estimation.fit_record import FitRecord
from phsi_opt.estimation.fit_report import fit_summary, report
from phsi_opt.estimation.json_file import read_json
from phsi_opt.presentation.summary import Summarised, Summary
from phsi_opt.writing import write_whole

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

PLOTTED_LEVEL = 0.95  # of confidence: the convention of most tables and pictures


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(FitRecord, Summarised):
    """A fitted model: values, standard errors, solver's outcome and provenance.

    ``print(fit)`` shows the equations with standard errors and what to know about them.

    - Numbers: ``parameters`` (a table), ``estimates``, ``std_errors``,
      ``intervals(level)``, ``correlations``, ``noise``, ``bic``.
    - Equations: ``equations()``, ``latex()``, ``sympy()``, ``casadi()``, all with the
      fitted numbers.
    - Motion: ``simulate(t, x0, u)``; the fitted model itself is ``model``, that of one
      trajectory ``model_of(trajectory)``.
    - Forms: ``print(fit)``, ``plot()``, ``plot_states(data)``, ``save(path)`` and
      ``Fit.load(path)``.
    - Trust: ``outcome`` says how the solver ended, ``warnings`` what to know before the
      numbers are used.

    The attributes are those of `FitRecord`. A fit is never changed in place.
    """

    def save(self, path: str | Path) -> None:
        """Write the fit as a JSON file that `load` reads.

        The file holds numbers and formulas as text: model, values, covariance, outcome
        and provenance, with every digit; not the estimated states.

        Args:
            path: Of the file, such as "fit.json". A file that is there is overwritten.

        Raises:
            DataError: The file cannot be written.
        """
        text = json.dumps(self.content(), indent=1, allow_nan=True)
        write_whole(path, text + "\n")

    @classmethod
    def load(cls, path: str | Path) -> "Fit":
        """Read a fit that `save` wrote.

        No code from the file is ever run: formulas are read through a whitelist.

        Args:
            path: Of the file.

        Returns:
            The fit, equal to the one that was saved but for ``states``, which is empty.

        Raises:
            DataError: The file cannot be read, is of another format, is damaged, or
                holds a formula that is not one.
        """
        return read_json(path, FORMAT, "a fit", cls.from_content)

    def content(self) -> dict[str, Any]:
        """The fit as numbers, text, lists and mappings: what `save` writes."""
        return fit_content(self)

    @classmethod
    def from_content(cls, content: dict[str, Any]) -> "Fit":
        """The fit of a content that `content` made.

        Raises:
            DataError: A part of the content has a value that no fit can have.
            ModelError: The model in the content is not valid.
            LookupError, TypeError, ValueError, AttributeError: The content is damaged.
        """
        return cls(**fit_parts(content))

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Draw how well every parameter is known: each estimate with its 95 % interval.

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

        return plot_estimates(self._estimates_table(PLOTTED_LEVEL), PLOTTED_LEVEL, ax)

    def plot_states(
        self,
        data: Measurements,
        trajectory: str | int = 0,
        ax: "Axes | None" = None,
        state: str | None = None,
    ) -> "Axes":
        """Draw measured and estimated states of one trajectory, a panel each.

        The estimated states obey the model and the measurements alike; those of a free
        run alone are in ``compare(fit, data).plot()``.

        Args:
            data: The measurements of the fit.
            trajectory: Name of the trajectory, or its number, counted from 0.
            ax: Axes to draw one state on; None: a new figure with all of them.
            state: The state to draw on ``ax``; default: the first one measured.

        Returns:
            The axes given, or the uppermost of the new figure.

        Raises:
            DataError: The data are not those of the fit, the fit was loaded from a
                file, which has no states, or a name is unknown.
        """
        from phsi_opt.estimation.state_pictures import states_picture

        return states_picture(self, data, trajectory, ax, state)

    def _estimates_table(self, level: float) -> "pd.DataFrame":
        """What a picture shows: a row per estimate with limits, unit, ``at_bound``."""
        parameters = self.parameters.set_index("name")
        table = self.intervals(level)
        table["unit"] = parameters["unit"].reindex(table.index)
        table["at_bound"] = table.index.isin(self.outcome.at_bounds)
        return table.rename_axis("name").reset_index()

    def _summary(self) -> Summary:
        return fit_summary(self)

    def __str__(self) -> str:
        return report(self)

    __repr__ = __str__
