"""What a missing force looks like: where, what it follows, what it does with energy.

One record that is made once and handed to tables, sentences and pictures.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from phsi_opt.arguments import require_known
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.words import sentence
from phsi_opt.presentation.summary import printed_table

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class ForceAnalysis:
    """The missing forces of a record and what is said of them.

    Attributes:
        record: the forces, beside everything that they may depend on.
        forces: of every equation that may lack one.
    """

    record: ForceRecord
    forces: tuple[EquationForce, ...]

    @classmethod
    def of(cls, record: Record) -> "ForceAnalysis":
        """The analysis of a record's missing forces."""
        found = ForceRecord.of(record)
        forces = [EquationForce(found, equation) for equation in found.equations]
        return cls(found, tuple(forces))

    def force_in(self, equation: str | None = None) -> EquationForce:
        """The missing force of an equation.

        Args:
            equation: None: the one whose force is strongest over its uncertainty.

        Raises:
            ModelError: the equation has no missing force.
        """
        if equation is None:
            return max(self._strongest_first, key=lambda f: f.where["times_noise"])
        by_equation = {force.equation: force for force in self.forces}
        said = f"equation={equation!r} has no missing force"
        require_known(equation, by_equation, said)
        return by_equation[equation]

    @property
    def _strongest_first(self) -> list[EquationForce]:
        return sorted(self.forces, key=lambda force: -force.where["strength"])

    @cached_property
    def where(self) -> "pd.DataFrame":
        """Where the forces are strong, strongest first.

        A row per equation that may lack one: equation; trajectory (its name) and
        time_window where it is strongest; state_region where it is strong; frequency
        (cycles per unit of time; 0 for a force that is mostly constant); strength
        (rms); times_noise (strength over the typical standard deviation of the
        estimate: below 1 it is not sure).
        """
        return printed_table([force.where for force in self._strongest_first])

    @cached_property
    def follows(self) -> "pd.DataFrame":
        """What the forces depend on, best first (see `dependence`)."""
        import pandas as pd

        tables = [force.follows for force in self.forces]
        return pd.concat(tables, ignore_index=True)

    @cached_property
    def energy(self) -> "pd.DataFrame":
        """Whether the forces dissipate, store or supply energy.

        A row per equation: equation, mean_power (force times effort, averaged over the
        time; negative: taken out), parameters, constant, dissipated, conserved, inputs,
        time and unexplained. These shares are parts of the force's mean square on
        stretches of time left out, each what its cause adds to the stronger ones; they
        sum to one.
        """
        rows = []
        for force in self.forces:
            known = {"equation": force.equation, "mean_power": force.mean_power}
            rows.append({**known, **force.causes.shares})
        return printed_table(rows)

    @cached_property
    def sentences(self) -> list[str]:
        """Where the model fails, in plain words, an equation each; strongest first."""
        return list(map(sentence, self._strongest_first))
