"""The record of a diagnosis: where a model fails, the candidates, the verdict."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import pandas as pd

from phsi_opt.comparison.compare import Comparison
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.experiment_design import Separation, separating
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.missing_force import ForceEstimate, force_deviation
from phsi_opt.force_analysis.dependence import depends_on, leading
from phsi_opt.force_analysis.energy import Power, power
from phsi_opt.force_analysis.localization import located
from phsi_opt.force_analysis.wording import sentences
from phsi_opt.model.effect import Effect

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from phsi_opt.learning.learned_force import LearnedForce


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What `diagnose` found: `verdict`, `reason`, `where`, `missing_force`,
    `candidates`, `effects`.
    """

    fit: Fit
    data: Measurements = field(repr=False)
    estimate: ForceEstimate = field(repr=False)
    base: Comparison = field(repr=False)
    ranked: tuple[Candidate, ...] = field(repr=False)
    verdict: str
    reason: str
    together: tuple[
        Effect, ...
    ] = ()  # what the verdict names, or the nearest to it: one effect, or two together
    nearest: Fit | None = field(repr=False, default=None)  # the brief re-fit with them

    @property
    def effects(self) -> list[Effect]:
        """The candidate effects, best first."""
        return [candidate.effect for candidate in self.ranked]

    @property
    def candidates(self) -> pd.DataFrame:
        """The candidates, best first, as a table with the columns named below.

        delta_bic and held_out_rmse are those of the re-fit, NaN for candidates that
        screening ruled out.
        """
        rows = [
            (
                c.effect.name,
                c.effect.slot,
                c.effect.equation,
                c.coefficient,
                c.std_error,
                c.p_value,
                c.delta_bic,
                c.held_out_rmse,
                ", ".join(c.confusable_with),
            )
            for c in self.ranked
        ]
        columns = [
            "effect",
            "slot",
            "equation",
            "coefficient",
            "std_error",
            "p_value",
            "delta_bic",
            "held_out_rmse",
        ]
        return pd.DataFrame(rows, columns=[*columns, "confusable_with"])

    @cached_property
    def missing_force(self) -> pd.DataFrame:
        """trajectory, t (middle of the interval), then force and standard deviation per
        equation.
        """
        grid = self.estimate.grid
        frame = pd.DataFrame(
            {
                "trajectory": grid.trajectory[grid.begin],
                "t": grid.t[grid.begin] + grid.h / 2,
            }
        )
        deviation = force_deviation(self.estimate)
        for k, row in enumerate(self.estimate.prior.rows):
            name = self.fit.model.states[row]
            frame[name], frame[f"std_{name}"] = self.estimate.w[:, k], deviation[:, k]
        return frame

    @cached_property
    def where(self) -> pd.DataFrame:
        """Where the missing force is strong, strongest first (see `where.located`)."""
        return located(self.fit, self.estimate, self.runs)

    @cached_property
    def follows(self) -> pd.DataFrame:
        """What the missing force depends on, per equation and variable, best first (see
        `where.depends_on`).
        """
        return depends_on(self.fit, self.estimate, self.runs)

    @cached_property
    def power(self) -> Power:
        """Whether the missing force dissipates, stores or supplies energy (see
        `where.power`).
        """
        return power(self.fit, self.estimate, self.runs, self.data.units)

    @property
    def sentences(self) -> list[str]:
        """Where the model fails, in plain words, an equation each; strongest first."""
        return sentences(self.fit, self.estimate, self.runs, self.data.units)

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the trajectories."""
        return tuple(run.name for run in self.data.trajectories)

    @cached_property
    def separation(self) -> Separation | None:
        """The experiment that would tell the first two candidates of a tie apart; None
        where there is no tie.
        """
        fitted = {str(c.effect): c.fit for c in self.ranked if c.fit is not None}
        first = next(iter(self.ranked), None)
        if first is None or first.fit is None:
            return None
        rival = next(
            (fitted[name] for name in first.confusable_with if name in fitted), None
        )
        if rival is None:
            return None
        noise = self.estimate.sigma
        return separating(first.fit, rival, self.data, noise)

    def learned_force(
        self,
        equation: str | None = None,
        on: Sequence[str] | None = None,
        seed: int = 0,
    ) -> "LearnedForce":
        """A stop-gap where nothing fits: a network for what one equation lacks (see
        `stopgap.learned_force`).

        Default: the equation whose missing force is strongest, and the variable that it
            depends on most.
        """
        from phsi_opt.learning.learned_force import learned_force

        equation = equation or str(self.where["equation"].iloc[0])
        if on is None:
            best = leading(self.follows, equation)
            known = best is not None and best["variable"] not in (
                "constant",
                "parameters",
            )
            on = (
                str(best["variable"]).split(", ")
                if best is not None and known
                else self.fit.model.states
            )
        return learned_force(
            self.fit,
            self.data,
            self.estimate,
            equation=equation,
            on=list(on),
            seed=seed,
        )

    def plot(self, ax: "Axes | None" = None, trajectory: str | int = 0) -> "Axes":
        """Draw the missing force along one trajectory, with two standard deviations.

        Args:
            ax: Axes to draw on; None: a new figure.
            trajectory: Name of the trajectory, or its number, counted from 0.

        Raises:
            DataError: There is no such trajectory.
        """
        from phsi_opt.presentation.pictures import plot_missing_force

        number = self.data.trajectory_number(trajectory)
        rows = self.missing_force["trajectory"] == number
        states = self.fit.model.states
        equations = [states[row] for row in self.estimate.prior.rows]
        along_trajectory = self.missing_force[rows]
        return plot_missing_force(along_trajectory, equations, self.data.units, ax)

    def plot_where(self, equation: str | None = None) -> "Figure":
        """Missing force along the time, over the states, against what it depends on,
        and its spectrum.
        """
        from phsi_opt.force_analysis.force_plots import plot_where

        return plot_where(self, equation)

    def __str__(self) -> str:
        shown = self.candidates.head(6).to_string(
            index=False, float_format=lambda v: f"{v:.4g}"
        )
        where = self.where.to_string(index=False, float_format=lambda v: f"{v:.4g}")
        return f"{self.verdict}: {self.reason}\nwhere it fails\n{where}\ncandidates, best first\n{shown}"

    __repr__ = __str__
