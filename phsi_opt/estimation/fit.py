"""The result of `identify`: the record with its forms, as text, file and picture.

The numbers and tables are those of `FitRecord`. A file leaves the estimated states out:
they are as long as the record, and a fit is used without them.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.data.checks import checked_hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, did_you_mean
from phsi_opt.estimation.fit_record import FitRecord, FitUncertainty
from phsi_opt.estimation.fit_report import fit_summary, report
from phsi_opt.estimation.json_file import made_of, read_json
from phsi_opt.estimation.model_content import Content, model_content, model_from
from phsi_opt.estimation.model_error_table import ModelErrorRow
from phsi_opt.later import Later
from phsi_opt.model_error.standard_errors import Source
from phsi_opt.optimization.ipopt import Outcome
from phsi_opt.presentation.summary import Summarised, Summary
from phsi_opt.transcription.grid import aligned_once
from phsi_opt.transcription.parameter_vector import Theta
from phsi_opt.writing import write_whole

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

FORMAT = "phsi_opt fit 1"
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

    def content(self) -> Content:
        """The fit as numbers, text, lists and mappings: what `save` writes."""
        return {
            "format": FORMAT,
            "model": model_content(self.model),
            "names": list(self.names),
            "by_trajectory": {
                run: dict(one) for run, one in self.by_trajectory.items()
            },
            "loss": self.loss,
            "loss_value": self.loss_value,
            "covariance": self.covariance.tolist(),
            "std_error_source": str(self.std_error_source),
            "covariances": {
                str(k): one.tolist() for k, one in self.covariances.items()
            },
            "freedom": None if self.freedom is None else self.freedom.tolist(),
            "model_error": [vars(row) for row in self.model_error_rows],
            "has_model_error": self.has_model_error,
            "noise": dict(self.noise),
            "outcome": {**vars(self.outcome), "at_bounds": [*self.outcome.at_bounds]},
            "n_values": self.n_values,
            "bic": self.bic,
            "log_evidence": self.log_evidence,
            "hold": self.hold,
            "huber": self.huber,
            "steps": [_steps_content(steps) for steps in self.steps],
            "n_gaps": [len(steps) for steps in self.steps],
            "seconds": self.seconds,
            "units": dict(self.units),
            "removed": list(self.removed),
            "warnings": list(self.warnings),
            "provenance": dict(self.provenance),
        }

    @classmethod
    def from_content(cls, content: Content) -> "Fit":
        """The fit of a content that `content` made.

        Raises:
            DataError: A part of the content has a value that no fit can have.
            ModelError: The model in the content is not valid.
            LookupError, TypeError, ValueError, AttributeError: The content is damaged.
        """
        model = model_from(content["model"])
        names = tuple(map(str, content.get("names", model.free)))
        by_run = content.get("by_trajectory", {})
        _check_names(names, Theta.of(model, tuple(by_run) or ("",)).names)
        noise = _numbers(content["noise"])
        _check_names(noise, model.states)
        n = len(names)
        covariance = np.array(content["covariance"], dtype=float).reshape(n, n)
        covariances = {}
        for source, matrix in content.get("covariances", {}).items():
            found = np.array(matrix, dtype=float).reshape(n, n)
            covariances[Source(source)] = found
        freedom = content.get("freedom")
        freedom = None if freedom is None else np.array(freedom, dtype=float)
        for what, numbers in (
            ("the variances of the estimates", np.diag(covariance)),
            ("noise", np.array(list(noise.values()))),
            ("degrees of freedom", np.zeros(0) if freedom is None else freedom),
            ("n_values", np.array([content["n_values"]])),
        ):
            if np.any(numbers < 0):
                raise DataError(f"{what}: {numbers.tolist()}; none can be negative")
        if freedom is not None and freedom.shape != (n,):
            raise DataError(f"{freedom.size} degrees of freedom for {n} estimates")
        rows = content.get("model_error", [])
        huber = content.get("huber")
        uncertainty = FitUncertainty(
            covariance=covariance,
            # Files of before hold standard errors from white noise alone.
            source=Source(content.get("std_error_source", Source.NOISE)),
            covariances=covariances,
            freedom=freedom,
            model_error_rows=tuple(made_of(ModelErrorRow, row) for row in rows),
            log_evidence=float(content.get("log_evidence", np.nan)),
            warnings=tuple(map(str, content["warnings"])),
        )
        gaps = zip(content.get("steps", []), content.get("n_gaps", []), strict=True)
        return cls(
            model=model,
            names=names,
            by_trajectory={run: _numbers(own) for run, own in by_run.items()},
            loss=str(content["loss"]),
            loss_value=float(content["loss_value"]),
            uncertainty=Later.known(uncertainty),
            has_model_error=bool(content.get("has_model_error", False)),
            noise=noise,
            outcome=made_of(Outcome, content["outcome"]),
            n_values=int(content["n_values"]),
            bic=float(content["bic"]),
            hold=checked_hold(content["hold"], model.inputs),
            huber=None if huber is None else float(huber),
            steps=tuple(np.broadcast_to(np.array(k, int), n).copy() for k, n in gaps),
            seconds=float(content.get("seconds", np.nan)),
            units={name: str(unit) for name, unit in content["units"].items()},
            removed=tuple(map(str, content["removed"])),
            provenance=dict(content["provenance"]),
        )

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
        from phsi_opt.presentation.pictures import Channel, draw_state, plot_states

        data = aligned_once(self.model, data)
        self._check_states(data)
        number = data.trajectory_number(trajectory)
        run = data.trajectories[number]
        channels = []
        for k, name in enumerate(data.states):
            unit = data.units.get(name, "")
            estimated = np.asarray(self.states[number])[:, k]
            channels.append(Channel(name, unit, run.x[:, k], estimated, None))
        t_unit = data.units.get("t", "")
        title = f"Measured and estimated states of {run.name}"
        if ax is None:
            return plot_states(run.t, channels, t_unit=t_unit, title=title).axes[0]
        state = data.measured[0] if state is None else state
        if state not in data.states:
            raise DataError(
                f"state={state!r} is not one of {', '.join(data.states)}."
                f"{did_you_mean(state, data.states)}"
            )
        draw_state(ax, run.t, channels[data.states.index(state)], t_unit)
        ax.set_title(title)
        return ax

    def _check_states(self, data: Measurements) -> None:
        """The states of the fit belong to these data."""
        if not self.states:
            raise DataError(
                "the fit has no estimated states: a file does not keep them, and "
                "PHSILoss estimates none. Call identify, or compare(fit, data).plot()."
            )
        lengths = [len(x) for x in self.states]
        given = [run.n_samples for run in data.trajectories]
        if lengths != given:
            raise DataError(
                f"the fit has states for trajectories of {lengths} samples, the data "
                f"have {given}; give the measurements that were fitted."
            )

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


def _steps_content(steps: np.ndarray) -> int | list[int]:
    """One number where all gaps of a trajectory have as many steps, else a list."""
    if len(steps) and np.all(steps == steps[0]):
        return int(steps[0])
    per_gap: list[int] = steps.tolist()
    return per_gap


def _numbers(content: Content) -> dict[str, float]:
    return {name: float(value) for name, value in content.items()}


def _check_names(names: Iterable[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise DataError(f"{name!r} is not in the model{did_you_mean(name, known)}")
