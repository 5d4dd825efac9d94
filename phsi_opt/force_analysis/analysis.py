"""What a missing force looks like: where, what it follows, what it does with energy.

One record that is made once and handed to tables, sentences and pictures.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from phsi_opt.criteria import CERTAIN_FORCE, CLEAR_PATTERN
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.dependence import depends_on
from phsi_opt.force_analysis.energy import EnergyExchange, energy_exchange
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.localization import located
from phsi_opt.force_analysis.pace import Pace
from phsi_opt.force_analysis.position_waves import PositionWave, position_wave
from phsi_opt.force_analysis.wording import sentences

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class ForceAnalysis:
    """The missing force of a record and what is said of it.

    Attributes:
        force: the force along the record, beside everything that it may depend on.
    """

    force: ForceRecord

    @classmethod
    def of(cls, record: Record) -> "ForceAnalysis":
        """The analysis of a record's missing force."""
        return cls(ForceRecord.of(record))

    @cached_property
    def where(self) -> "pd.DataFrame":
        """Where the force is strong, strongest first (see `located`)."""
        return located(self.force)

    @cached_property
    def follows(self) -> "pd.DataFrame":
        """What the force depends on, best first (see `depends_on`)."""
        return depends_on(self.force, self.waves)

    @cached_property
    def energy(self) -> EnergyExchange:
        """Whether the force dissipates, stores or supplies energy."""
        if not self.waves:
            return self._energy_by_knots
        return energy_exchange(self.force, self.waves)

    @cached_property
    def _energy_by_knots(self) -> EnergyExchange:
        """The same by functions with a few knots alone."""
        return energy_exchange(self.force, {})

    @cached_property
    def waves(self) -> dict[str, PositionWave]:
        """Waves along positions, by equation.

        They are sought in a force that is sure, and of which the rest leaves much.
        """
        left = self._energy_by_knots.table.set_index("equation")["unexplained"]
        sure = self.where.set_index("equation")["times_noise"] >= CERTAIN_FORCE
        waves = {}
        for equation in self.force.equations:
            if sure[equation] and left[equation] > CLEAR_PATTERN:
                wave = position_wave(self.force, equation)
                if wave is not None:
                    waves[equation] = wave
        return waves

    @cached_property
    def sentences(self) -> list[str]:
        """Where the model fails, in plain words, an equation each; strongest first."""
        return sentences(
            self.force.units,
            self.where,
            self.follows,
            self.energy,
            self.paces,
            dict(zip(self.force.trajectories, self.force.origins, strict=True)),
            float(self.force.t.max()),
        )

    @cached_property
    def paces(self) -> dict[str, Pace]:
        """How fast and how large each force is beside motion and model, by equation."""
        paces = {}
        for _, row in self.where.iterrows():
            paces[str(row["equation"])] = Pace.of(self.force, row)
        return paces
