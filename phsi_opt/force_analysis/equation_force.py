"""The missing force of one equation, as its pictures need it: values, labels, words."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.criteria import CERTAIN_FORCE, MOSTLY_CONSTANT
from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.dependence import CONSTANT, variables
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.pace import Pace
from phsi_opt.force_analysis.position_waves import PositionWave
from phsi_opt.force_analysis.units import (
    RateScale,
    force_unit,
    scale_of_rate,
    with_units,
)
from phsi_opt.model.structure import position_of_momentum
from phsi_opt.presentation.axes import label

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class EquationForce:
    """An analysis, seen from one of its equations.

    Attributes:
        analysis: of all missing forces.
        equation: the state in whose equation the force acts.
    """

    analysis: ForceAnalysis
    equation: str

    @classmethod
    def of(cls, analysis: ForceAnalysis, equation: str | None) -> "EquationForce":
        """The force of an equation.

        Args:
            analysis: of all missing forces.
            equation: None: the one whose force is strongest over its uncertainty.

        Raises:
            ModelError: the equation has no missing force.
        """
        if equation is None:
            table = analysis.where
            surest = int(table["times_noise"].argmax())
            return cls(analysis, str(table["equation"][surest]))
        forced = analysis.force.equations
        if equation not in forced:
            raise ModelError(
                f"equation={equation!r} has no missing force; "
                f"those that may lack one are {', '.join(forced)}."
                f"{did_you_mean(equation, forced)}"
            )
        return cls(analysis, equation)

    @property
    def record(self) -> ForceRecord:
        """The forces of all equations along the record."""
        return self.analysis.force

    @property
    def number(self) -> int:
        """Place of the force among those of all equations."""
        return self.record.equations.index(self.equation)

    @property
    def w(self) -> np.ndarray:
        """The force, (n_intervals,)."""
        return self.record.force_on(self.equation)

    @property
    def where(self) -> "pd.Series":
        """The equation's row of `located`."""
        table = self.analysis.where
        return table[table["equation"] == self.equation].iloc[0]

    @property
    def pace(self) -> Pace:
        """How fast and how large the force is beside the motion and the model."""
        return self.analysis.paces[self.equation]

    @property
    def shares(self) -> "pd.Series":
        """The equation's row of `energy_exchange`: what each cause explains."""
        table = self.analysis.energy.table
        return table[table["equation"] == self.equation].iloc[0]

    @property
    def cause(self) -> str:
        """The end of a sentence on what the force follows and does with energy."""
        energy = self.analysis.energy
        causes = dict(zip(energy.table["equation"], energy.sentences, strict=True))
        return causes[self.equation]

    @property
    def cause_in_brief(self) -> str:
        """The same without shares."""
        energy = self.analysis.energy
        causes = dict(zip(energy.table["equation"], energy.causes, strict=True))
        return causes[self.equation]

    @property
    def wave(self) -> PositionWave | None:
        """Along a position, where the force repeats along one."""
        return self.analysis.waves.get(self.equation)

    @property
    def follows(self) -> "pd.DataFrame":
        """The equation's rows of `depends_on`, best first."""
        table = self.analysis.follows
        return table[table["equation"] == self.equation]

    @property
    def sentence(self) -> str:
        """What is said of the force."""
        begin = f"d{self.equation}/dt"
        texts = self.analysis.sentences
        return next(text for text in texts if text.startswith(begin))

    @property
    def is_uncertain(self) -> bool:
        """Whether nothing is said about the force."""
        return bool(self.where["times_noise"] < CERTAIN_FORCE)

    @property
    def is_constant(self) -> bool:
        """Whether the mean predicts most of the force, and better than any variable."""
        best = self.follows.iloc[0]
        return bool(best["variable"] == CONSTANT and best["share"] > MOSTLY_CONSTANT)

    def share_of(self, variable: str) -> float:
        """Share of the force that a variable predicts."""
        return float(self.follows.set_index("variable")["share"][variable])

    def single_variable(self, variable: str | None) -> str:
        """A variable that the force was compared with, no pair.

        Args:
            variable: None: the one that predicts the force best, or the time for a
                constant force.

        Raises:
            ModelError: the force was not compared with the variable.
        """
        listed = variables(self.record, self.equation)
        single = [name for name in listed if "," not in name]
        if variable is None:
            if self.is_constant:
                return "t"
            is_single = self.follows["variable"].isin(single)
            return str(self.follows[is_single]["variable"].iloc[0])
        if variable not in single:
            raise ModelError(
                f"variable={variable!r} is not one that the force was compared with; "
                f"known are {', '.join(single)}."
                f"{did_you_mean(variable, single)}"
            )
        return variable

    @property
    def scale(self) -> RateScale:
        """The unit in which a text or a report tells the force."""
        longest = float(self.record.t.max())
        return scale_of_rate(self.equation, self.record.units, longest)

    def force_label(self, quantity: str = "missing force") -> str:
        """Label of an axis for the force, with its unit."""
        return label(quantity, force_unit(self.equation, self.record.units))

    @property
    def told_label(self) -> str:
        """Label of an axis for the force in the unit in which it is told."""
        return label("missing force", self.scale.unit)

    def variable_label(self, name: str) -> str:
        """Name and unit of a variable; a velocity has that of its position by time."""
        model = self.record.fit.model
        units = self.record.units
        if name not in model.efforts:
            return label(name, units.get(name, ""))
        state = model.states[model.efforts.index(name)]
        positions = position_of_momentum(model)
        if state not in positions:
            return f"effort {name}"
        position = positions[state]
        return label(f"velocity {name} = d{position}/dt", force_unit(position, units))

    def region_words(self, region: str) -> str:
        """A region of `strong_region` with units, velocities called by that name."""
        model = self.record.fit.model
        units = dict(self.record.units)
        velocities = []
        for momentum, position in position_of_momentum(model).items():
            effort = model.efforts[model.states.index(momentum)]
            units[effort] = force_unit(position, units)
            velocities.append(effort)
        told = with_units(region, units)
        for velocity in velocities:
            told = told.replace(f"{velocity} ", f"velocity {velocity} ")
        return told
