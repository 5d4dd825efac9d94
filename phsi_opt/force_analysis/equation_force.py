"""The missing force of one equation with all that is found of it, and its labels."""

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from phsi_opt.criteria import (
    CERTAIN_FORCE,
    MOST_OF_IT,
    NAMED_CAUSE,
    SURE_DEVIATIONS,
)
from phsi_opt.force_analysis.dependence import (
    CONSTANT,
    NO_VARIABLES,
    TIME_NAME,
    causes_of,
    dependence,
)
from phsi_opt.force_analysis.force_record import Force
from phsi_opt.force_analysis.localization import (
    Pace,
    strong_ranges,
    strongest_window,
)
from phsi_opt.model.catalogue import inertia_of, lacking_quantity
from phsi_opt.model.expressions import NUMPY, evaluate, names_of
from phsi_opt.model.kinds import ELECTRICAL, HYDRAULIC
from phsi_opt.model.parameter_units import drive_of
from phsi_opt.model.structure import kind_of, position_of_momentum, with_kinds_of_units
from phsi_opt.presentation.numbers import called, label
from phsi_opt.presentation.units import (
    Scale,
    are_alike,
    coefficient_unit,
    dates_words,
    powers_as_written,
    product,
    rate_unit,
    scale_of,
    scale_of_rate,
    times_words,
)
from phsi_opt.statistics import rms

if TYPE_CHECKING:
    import pandas as pd

MEMORY = re.compile(r"_second\b")  # of the memory state T_second
DIFFERENCE = " - "  # between the two variables of a difference
# A position and its rate, by the kind of the position.
BODIES = ("position", "velocity of")
NAMES_OF_PAIRS: dict[str, tuple[str, str]] = defaultdict(lambda: BODIES)
NAMES_OF_PAIRS[HYDRAULIC] = ("volume", "flow of")
NAMES_OF_PAIRS[ELECTRICAL] = ("charge", "current of")


@dataclass(frozen=True, eq=False)
class EquationForce(Force):
    """The missing force of one equation: where, how fast, what it follows."""

    @cached_property
    def where(self) -> dict[str, Any]:
        """The equation's row of `ForceAnalysis.where`."""
        region = [f"{one} {' or '.join(told)}" for one, told in self.region.items()]
        return {
            "equation": self.equation,
            "trajectory": self.window.trajectory,
            "time_window": self.window.words(scale_of(self.record.units.get("t", ""))),
            "state_region": ", ".join(region) or "everywhere",
            "frequency": self.pace.frequency,
            "strength": rms(self.w) / self.scale.size,
            "unit": self.scale.unit,
            "times_noise": self.record.estimate.posterior.times_noise[self.number],
        }

    window = cached_property(strongest_window)
    pace = cached_property(Pace.of)

    def window_words(self, longest: float = 0.0) -> str:
        """Its times with their dates; "" where none stand out."""
        window = self.window
        if window.is_whole:
            return ""
        unit = self.record.units.get("t", "")
        told = times_words(window.begin, window.end, unit, longest)
        origin = self.record.origin_of(window.trajectory)
        dates = dates_words(window.begin, window.end, origin)
        return f"{told} ({dates})" if dates else told

    @cached_property
    def region(self) -> Mapping[str, list[str]]:
        """Ranges of states in which it is strong; of those where any stands out."""
        region = {}
        for name in self.record.model.states:
            ranges = strong_ranges(self.told(name), self.w)
            if ranges and name not in self.record.model.memory:
                region[name] = ranges
        return region

    causes = cached_property(causes_of)

    @property
    def mean_power(self) -> float:
        """Force times effort, averaged over the time."""
        h = self.record.estimate.grid.h
        return float((self.w * self.effort) @ h / h.sum())

    @property
    def power_unit(self) -> str:
        """The unit of `mean_power`, "" where it is not known."""
        units = self.record.units
        time = units.get("t", "")
        own = effort = units.get(self.equation, "")
        if self.record.model.has_energy:
            effort = rate_unit(units.get(self.position, ""), time)
        force, rate = map(powers_as_written, (rate_unit(own, time), effort))
        return coefficient_unit(product(force, rate), ("W",)) if force and rate else ""

    @cached_property
    def follows(self) -> "pd.DataFrame":
        return dependence(self)

    @property
    def is_uncertain(self) -> bool:
        """Whether nothing is said about the force."""
        return bool(self.where["times_noise"] < CERTAIN_FORCE)

    @property
    def is_sure(self) -> np.ndarray:
        """Whether its band excludes zero in an interval, (n_intervals,)."""
        return np.abs(self.w) > SURE_DEVIATIONS * self.deviation

    def share_of(self, variable: str) -> float:
        """The share of its variance that a variable, or the mean, predicts."""
        return float(self.follows.set_index("variable")["share"][variable])

    @property
    def single_variable(self) -> str:
        """The variable (no pair) that predicts the force best, time only if clearly."""
        best = self.follows.iloc[0]
        if best["variable"] == CONSTANT and best["share"] > MOST_OF_IT:
            return TIME_NAME
        rows = self.follows[~self.follows["variable"].str.contains(",")]
        rows = rows[~rows["variable"].isin(NO_VARIABLES)]
        good = rows["variable"][rows["share"] > rows["share"].iloc[0] - NAMED_CAUSE]
        return str([*good[good != TIME_NAME], TIME_NAME][0])

    @cached_property
    def inertia(self) -> str:
        """What divides the forces of its equation; "" where no fit determines it."""
        record = self.record
        model = with_kinds_of_units(record.model, record.units)
        found = inertia_of(model, self.equation, record.units)
        fit = record.along.fit
        free = names_of(found).intersection(fit.names) if found else ()
        values = abs(np.array([fit.estimates[name] for name in free]))
        errors = np.array([fit.std_errors[name] for name in free])
        return found if np.all(values >= SURE_DEVIATIONS * errors) else ""

    @cached_property
    def scale(self) -> Scale:
        """The unit in which a text or a report tells the force.

        Where the equation tells its mass or inertia, that is the unit of a force; else
        the force is told as the rate that it is missing in.
        """
        record = self.record
        if self.inertia:
            size = 1 / float(evaluate(self.inertia, record.model.values, NUMPY))
            return Scale(drive_of(record.units[self.equation]), size)
        return scale_of_rate(self.equation, record.units, float(record.t.max()))

    @cached_property
    def quantity(self) -> str:
        """What is missing, such as a force, a voltage or a heat flow."""
        record = self.record
        return lacking_quantity(record.model, self.equation, record.units, self.inertia)

    @property
    def equation_words(self) -> str:
        """Such as "the equation of p"."""
        return f"the equation of {self.called(self.equation)}"

    def called(self, name: str) -> str:
        """A state or an input as people read it."""
        return called(MEMORY.sub(" of the second storage", name), self.record.labels)

    @property
    def position(self) -> str:
        """The position whose rate the effort of the equation is; "" where none is."""
        return position_of_momentum(self.record.model).get(self.equation, "")

    @property
    def place_noun(self) -> str:
        """The name of a position in the field of the equation, such as charge."""
        unit = self.record.units.get(self.position, "")
        kind = kind_of(self.record.model, self.position)
        return "voltage" if are_alike(unit, "V") else NAMES_OF_PAIRS[kind][0]

    def velocity_words(self, position: str) -> str:
        """Such as "velocity of q"; in a circuit it is a current."""
        words = NAMES_OF_PAIRS[kind_of(self.record.model, position)][1]
        return f"{words} {self.called(position)}"

    def position_of(self, variable: str) -> str:
        """The position whose velocity an effort is; "" for other variables."""
        model = self.record.model
        state = self._states_of_efforts.get(variable, "")
        position = position_of_momentum(model).get(state, "")
        is_known = position and NAMES_OF_PAIRS[kind_of(model, position)] == BODIES
        return position if model.has_energy or is_known else ""

    @property
    def _states_of_efforts(self) -> dict[str, str]:
        model = self.record.model
        return dict(zip(model.efforts, model.states, strict=True))

    def variable_words(self, name: str) -> str:
        """A variable as it is called in speech: a velocity by its position."""
        if self.position_of(name):
            return self.velocity_words(self.position_of(name))
        known = self._channel_of(name)
        return self.called(known) if known else f"effort {name}"

    def _channel_of(self, name: str) -> str:
        """The state or input that a variable is; "" of an effort that is none."""
        record = self.record
        if name not in record.model.efforts:
            return name
        if not record.model.has_energy:
            return self._states_of_efforts[name]
        values = record.variable(name)
        for state in record.model.states:
            if np.allclose(values, record.variable(state)):
                return state
        return ""

    def scale_of(self, variable: str) -> Scale:
        """The scale of a variable; a velocity has that of its position by time."""
        units = self.record.units
        position = self.position_of(variable)
        if position:
            return scale_of_rate(position, units, 0.0)
        return scale_of(units.get(self._channel_of(variable), ""))

    def told(self, variable: str) -> np.ndarray:
        """Values of a variable, or of a difference, in its `scale_of`."""
        first, _, second = variable.partition(DIFFERENCE)
        values = np.asarray(self.scale_of(first).shown(self.record.variable(first)))
        return values - self.told(second) if second else values

    def variable_label(self, name: str) -> str:
        """Label of an axis for a variable, or for a difference, with its unit."""
        if DIFFERENCE in name:
            first, second = name.split(DIFFERENCE)
            told = DIFFERENCE.join(map(self.variable_words, (first, second)))
            return label(told, self.scale_of(first).unit)
        words = self.variable_words(name)
        return words if "effort " in words else label(words, self.scale_of(name).unit)
