"""Whether the declared units of a model and its measurements fit together.

The equations of `parameter_units` are solved for dimensions, and then for the logarithm
of the size in SI, which is one more power: mm/ms^2 and N/kg are of one dimension and
differ by 1000. A term without a parameter may hide a constant of physics (p**2/2 of a
mass of 1 kg), so that only what contradicts itself whatever is hidden is a fault.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import filterfalse
from math import log
from operator import attrgetter

import numpy as np

from phsi_opt.errors import ModelError
from phsi_opt.model.base import BaseModel
from phsi_opt.model.expressions import NUMPY, divisors, evaluate, names_of
from phsi_opt.model.parameter_units import Equations, stated_units
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import place_of
from phsi_opt.presentation.numbers import shortened
from phsi_opt.presentation.units import (
    RADIAN,
    Measure,
    Powers,
    in_si,
    measure_of,
    product,
    scale_of,
    si_name,
    words_of,
)

SIZE = "size"  # the power that stands for the logarithm of the size in SI
_dimension = attrgetter("powers")  # of a measure
SOME_VALUES = np.array([-2.0, -0.5, 0.25, 3.0])  # values of what changes, in a loss


@dataclass(frozen=True)
class UnitFault:
    """What is wrong with a unit, or with a number that has none.

    ``name``: of the parameter or the channel; "": of a number in a formula, which
    stands in ``slot`` and ``equation``.
    """

    name: str
    said: str
    value: float | str | None = None
    slot: str = ""
    equation: str = ""


@dataclass(frozen=True, eq=False)
class UnitCheck:
    """A model with the units of its channels, and of its parameters, as written."""

    model: BaseModel
    units: Mapping[str, str]  # by state, input and time
    as_written: bool = False  # whether units are those that people wrote

    @cached_property
    def _stated(self) -> dict[str, str]:
        """The units that can be read, by what has them."""
        found = {}
        for name, unit in stated_units(self.model, self.units).items():
            written = scale_of(unit).unit if self.as_written else str(unit)
            measure = measure_of(written) if written else None
            if measure and "C" not in measure.powers:  # a coulomb, or a degree
                found[name] = written
        return found

    def _measure(self, name: str) -> Measure:
        return measure_of(self._stated[name]) or Measure({}, 1.0)

    @property
    def _of_parameters(self) -> list[str]:
        return list(filter(self.model.entries.__contains__, self._stated))

    def _others(self, names: Collection[str]) -> list[str]:
        """All quantities with a unit but these."""
        return list(filterfalse(names.__contains__, self._stated))

    def _in_other_units(self, names: Iterable[str]) -> list[str]:
        return [name for name in names if self._measure(name).size != 1.0]

    @cached_property
    def _equations(self) -> tuple[Equations, Equations]:
        """With pure numbers alone in terms without a parameter, and with constants."""
        return Equations(self.model), Equations(self.model, may_hide=True)

    def _solved(
        self, powers: Callable[[Measure], Powers], without: Collection[str] = ()
    ) -> dict[str, Powers] | None:
        """Powers of what has no unit, by its name; None for a contradiction."""
        names = self._others(without)
        known = dict(zip(names, map(powers, map(self._measure, names)), strict=True))
        plain, with_constants = self._equations
        found = plain.solved(known, numbers_are_pure=False)
        return with_constants.solved(known, False) if found is None else found

    # ---- faults ----------------------------------------------------------------------

    @property
    def contradiction(self) -> UnitFault | None:
        """Units of different dimensions in one place; None where there are none."""
        if self._solved(_dimension) is not None:
            return None
        expected = {}
        names = self._of_parameters
        for name in (*names, *self._others(names)):
            found = self._solved(_dimension, without=(name,))
            if found is not None:
                expected[name] = _expected(found.get(name))
        first, *others = expected or self._stated
        said = (
            f"the formulas ask for {expected.get(first, 'another unit')}, with "
            f"{self._listed(others or self._others([first]))}; correct the "
            "unit of one of them, or the formula."
        )
        return UnitFault(first, said, self._stated[first])

    @property
    def negative(self) -> UnitFault | None:
        """A mass or the like that is known to be negative, or a loss that is none."""
        for slot, equation, term in self.model.placed():
            inner = {name: _assumed(one) for name, one in term.inner.items()}
            names = dict.fromkeys(names_of(term.body), SOME_VALUES) | inner
            for text in divisors(term.body):
                known = term.inner.get(text)
                if known is not None and known.fixed and known.start < 0:
                    said = (
                        "it divides in the model, as a mass, a capacity or a time "
                        "constant, which is positive; remove the sign."
                    )
                    told = scale_of(known.unit).shown(known.start)
                    return UnitFault(text, said, told)
            with np.errstate(all="ignore"):
                loss = evaluate(term.body, names, NUMPY) if slot == "R" else 0.0
            if np.all(loss * _assumed(term.coefficient) < 0):
                said = (
                    f"{term.body!r} is negative: R is a loss, and dx/dt has -R dH/dx; "
                    "remove the sign, or put what supplies energy into F."
                )
                return UnitFault("", said, "", slot, equation)
        return None

    @property
    def numbers_without_unit(self) -> list[UnitFault]:
        """Numbers that mean one thing in SI and another in the units of the data.

        One whose unit is not known is among them: it cannot be converted.
        """
        foreign = self._in_other_units(self._others(self._of_parameters))
        found = self._solved(_dimension) if foreign else None
        if found is None:
            return []
        faults = []
        known = set().union(*map(words_of, self.units.values()))
        for name in self._of_parameters:
            unit = self._stated[name]
            if words_of(unit) - known:
                of_others = self._solved(_dimension, without=(name,)) or {}
                said = (
                    "this unit is not known, so the number cannot be converted; "
                    f"expected {_expected(of_others.get(name))} or a multiple of it."
                )
                faults.append(UnitFault(name, said, unit))
        # None: units of SI stand beside the data's; what has to do with these may be
        # in either.
        sizes = self._solved(_size) or self._solved(_size, without=self._of_parameters)
        bases = set().union(*(self._measure(name).powers for name in foreign))
        data = self._listed(foreign)
        for name, number in self._numbers.items():
            powers = _without_angle(found.get(name, {}))
            differs = not bases.isdisjoint(powers)
            if sizes and name in sizes:
                differs = sizes[name] != {}
            if name in found and differs:
                faults.append(self._ambiguous(name, number, powers, data))
        return faults

    def _ambiguous(
        self, name: str, number: float, powers: Powers, data: str
    ) -> UnitFault:
        unit = si_name(powers)
        key = "start" if name in self.model.free else "value"
        said = (
            f"it has no unit, and the data have {data}. If it is in {unit}: "
            f'{{}} = {{{{ {key} = {number:g}, unit = "{unit}" }}}}'
        )
        if name in self.model.entries:
            return UnitFault(name, f"{said.format(name)}.", number)
        _, at = self._equations[0].numbers[name]
        said = f"{said.format('g')} in [parameters], and g in the formula"
        if not powers:
            said = f"values are converted from {data}; leave out what converts them"
        where = f"{number:g} in {shortened(at.term.body, 40)!r}: "
        return UnitFault("", f"{where}{said}.", "", at.slot, at.equation)

    @property
    def _numbers(self) -> dict[str, float]:
        """The numbers without a unit, zeros left out, by their quantities' names."""
        numbers = {}
        for name, entry in self.model.entries.items():
            one = entry.parameter
            for number in (one.upper, one.lower, one.value):
                if number and np.isfinite(number) and not one.unit:
                    numbers[name] = number
        for name, (number, _) in self._equations[0].numbers.items():
            numbers[name] = number
        return numbers

    def _listed(self, names: Iterable[str]) -> str:
        """Such as "q in mm, t in ms", of four at most."""
        told = [f"{name} in {self._stated[name]}" for name in names]
        return ", ".join(told[:4])

    # ---- measurements as they are given ----------------------------------------------

    def refuse(self) -> None:
        """Refuse units that do not fit together as they are.

        Raises:
            ModelError: a mass or a loss is negative, units contradict each other, or a
                fixed number has no unit where units of SI stand beside others.
        """
        wrong = self.negative
        if wrong is not None:
            of_parameter = f"{wrong.name}={wrong.value}"
            place = place_of(wrong.slot, wrong.equation) or of_parameter
            raise ModelError(f"{place}: {wrong.said}")
        wrong = self.contradiction
        if wrong is not None:
            raise ModelError(f"{wrong.name} is in {wrong.value}: {wrong.said}")
        foreign = self._in_other_units(self._stated)
        if not foreign:
            return
        sizes = self._solved(_size)
        said = (
            "units of different size are mixed in the formulas" if sizes is None else ""
        )
        of_data = self._solved(_size, without=self._of_parameters) or {}
        powers = self._solved(_dimension) or {}
        for name, number in self._numbers.items():
            is_known = name not in self.model.free and powers.get(name)
            if sizes and is_known and sizes.get(name) and name not in of_data:
                told = name if name in self.model.entries else "a number"
                said = f"{told} = {number:g} has no unit, and would not be in SI units"
        if said:
            beside = self._listed(self._others(foreign))
            told = f"{self._listed(foreign)}; {beside}".rstrip("; ")
            raise ModelError(f"{said} ({told}). {self._repair()}")

    def _repair(self) -> str:
        if in_si(self.units) != dict(self.units):
            return (
                "Convert the data: data = data.in_si(); results are still shown in the "
                "units that were written."
            )
        values = []
        for name in self._in_other_units(self._of_parameters):
            measure = self._measure(name)
            number = self.model.values[name] * measure.size
            unit = si_name(measure.powers, self._stated[name])
            values.append(f'{name}=ph.Parameter({number:g}, unit="{unit}")')
        return f"Give parameters in SI units: {', '.join(values[:2])}."


def _assumed(parameter: Parameter | None) -> float:
    """Its value where that is known, else one of a sign that it may have."""
    if parameter is None:
        return 1.0
    return parameter.start if parameter.fixed else float(np.sign(parameter.upper))


def _size(measure: Measure) -> Powers:
    return {SIZE: log(measure.size)}


def _expected(powers: Powers | None) -> str:
    if powers is None:
        return "a unit of SI"
    return si_name(_without_angle(powers)) if powers else "no unit"


def _without_angle(powers: Powers) -> Powers:
    """Without radians, which come and go, but in an angle or its rates."""
    if powers.keys() <= {RADIAN, "s"}:
        return powers
    return product(powers, {RADIAN: -powers.get(RADIAN, 0.0)})
