"""Which parameters a record can tell, before anything is solved.

The rank of the sensitivities (`sensitivity_rank`) tells what no record can, however
long and clean; with data, the Fisher information along the measured motion tells what
this one can be expected to.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from decimal import localcontext
from fractions import Fraction
from itertools import compress, product
from math import lcm
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from phsi_opt.arguments import typed
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError
from phsi_opt.estimation.sensitivity_rank import ImpreciseError, RandomPoints, Silent
from phsi_opt.interrupts import interruptible
from phsi_opt.model.model import Model
from phsi_opt.presentation.numbers import enumerated
from phsi_opt.presentation.summary import Part, Summarised, Summary, printed_table

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Group:
    """Parameters that no record can distinguish."""

    parameters: tuple[str, ...]  # their names
    combinations: tuple[str, ...]  # of them that are identifiable, such as ("k/m",)
    fix: tuple[str, ...]  # as few as make the others identifiable once they are known

    @property
    def n_identifiable(self) -> int:
        """How many independent combinations are identifiable."""
        return len(self.parameters) - len(self.fix)

    def __str__(self) -> str:
        names = ", ".join(self.parameters)
        if len(self.parameters) == 1:
            return f"no record tells {names}: fix it to a known value or remove it"
        told = ""
        if self.combinations:
            verb = "is" if len(self.combinations) == 1 else "are"
            told = f"{enumerated(self.combinations)} {verb} identifiable; "
            if len(self.combinations) == self.n_identifiable:
                told = f"only {told}"
        fix = "one of them to a known value"
        if len(self.fix) > 1:
            fix = f"{enumerated(self.fix)} to known values"
        return f"no record can distinguish {names}: {told}fix {fix}"


@dataclass(frozen=True, eq=False, repr=False)
class Identifiability(Summarised):
    """Which parameters of a model can be identified; see `identifiability`."""

    model: Model  # the model
    measured: tuple[str, ...]  # the states that sensors show
    groups: tuple[Group, ...]  # of parameters that no record can distinguish
    unobservable: tuple[str, ...]  # states whose values no record tells
    # By state that is not measured, the parameters that a sensor makes identifiable.
    sensors: Mapping[str, tuple[str, ...]]
    # The parameters that known states at the start make identifiable.
    known_start: tuple[str, ...]
    # By name the value near which the data are explained, and the standard error to be
    # expected of them; empty without data.
    expected: Mapping[str, tuple[float, float]]

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Names of the parameters that no record can tell, in the model's order."""
        names = {name for group in self.groups for name in group.parameters}
        return tuple(filter(names.__contains__, self.model.free))

    @property
    def sentences(self) -> tuple[str, ...]:
        """What no record can tell, and what would help; empty where nothing is."""
        told = list(map(str, self.groups))
        if self.unobservable:
            names = ", ".join(self.unobservable)
            told.append(f"these sensors do not determine {names}")
        by_gain: dict[tuple[str, ...], list[str]] = {}
        for state, gained in self.sensors.items():
            by_gain.setdefault(gained, []).append(state)
        for gained, states in by_gain.items():
            which = " or ".join(states)
            told.append(f"a sensor of {which} makes {self._what(gained)} identifiable")
        if self.known_start:
            names = self._what(self.known_start)
            told.append(f"known states at the start make {names} identifiable")
        return tuple(told)

    def _what(self, names: tuple[str, ...]) -> str:
        return "all" if names == self.unidentifiable else enumerated(names)

    @property
    def table(self) -> "pd.DataFrame":
        """Whether each free parameter is identifiable, and its start, a row each.

        With data the value near which they are explained, the standard error to be
        expected, and its share of the value; NaN where no record tells the parameter.
        """
        values = self.model.values
        rows: list[list[Any]] = []
        for name in self.model.free:
            is_told = name not in self.unidentifiable
            row = [name, is_told, values[name]]
            if self.expected:
                value, error = self.expected[name]
                error = error if is_told else np.nan
                share = error / abs(value) if value else np.nan
                row = [name, is_told, value, error, share]
            rows.append(row)
        columns = ["name", "identifiable", "value", "std_error", "relative_error"]
        return printed_table(rows, columns=columns[: 5 if self.expected else 3])

    def _summary(self) -> Summary:
        sensors = ", ".join(self.measured)
        title = f"Identifiability: sensors of {sensors}"
        text = ".\n".join(self.sentences) or "every parameter is identifiable"
        return Summary(title, (Part(text=f"{text}."), Part(table=self.table)))


@typed
@interruptible
def identifiability(
    model: Model,
    data: Measurements | None = None,
    *,
    measured: Sequence[str] | None = None,
) -> Identifiability:
    """Find which parameters a record can tell, before anything is solved.

    What sensors show is y(t; x0, theta), with unknown states x0 at the start. A
    parameter is identifiable where no direction of (x0, theta) that contains it leaves
    y unchanged: ``dy/d(x0, theta) v = 0`` only for v without it. This is the rank of a
    Taylor series, worked out with a hundred digits at random values of the parameters,
    states and inputs. It is local: a parameter with several discrete solutions counts
    as identifiable. A prior tells its parameter.

    With data, the Fisher information gives the standard error that this record can be
    expected to give, if the model is right (`table`). Several runs have the same
    parameters, but for those of each trajectory.

    Args:
        model: the model, with its free parameters.
        data: measurements; they say which states have sensors, and how many runs there
            are.
        measured: the states that have sensors, where there are no data; default: all
            but memories.

    Raises:
        DataError: if model and data do not match.
        ModelError: a state in ``measured`` is unknown, or the model has no value at
            random states.

    Source: Sedoglavic, Journal of Symbolic Computation 33 (2002) 735-755; Stigter and
    Molenaar, Automatica 58 (2015) 118-124.

    Examples:
        >>> free = ph.PseudoHamiltonian(
        ...     states=["q", "p"], S=ph.canonical(1), H="k*q**2/2 + p**2/(2*m)"
        ... )
        >>> ph.identifiability(free, measured=["q"]).groups[0].combinations
        ('k/m',)
    """
    if data is not None:
        if measured is not None:
            raise ModelError(
                f"measured={list(measured)!r} beside data, which say themselves what "
                "was measured; leave one of them out."
            )
        # It needs what a fit needs, which is slow to load.
        from phsi_opt.estimation.expected_errors import expected_errors

        expected = expected_errors(model, data)
        return replace(_of_sensors(model, data), expected=expected)
    if measured is None:
        measured = [name for name in model.states if name not in model.memory]
    for name in measured:
        model.index(name, "measured")
    return structural(model, tuple(measured))


def _of_sensors(model: Model, data: Measurements) -> Identifiability:
    """What no record with the sensors and runs of the data can tell."""
    measured = tuple(filter(model.states.__contains__, data.measured))
    return structural(model, measured, min(data.n_trajectories, 4))


def cautions(model: Model, data: Measurements) -> tuple[str, ...]:
    """What a fit of these data cannot tell, for who is about to wait for it.

    Nothing of large dictionaries: 40 unknown parameters take a second, 140 a minute.
    """
    if len(model.free) > 40:
        return ()
    with suppress(ModelError):  # that it has no value is for the fit to say
        return _of_sensors(model, data).sentences
    return ()


def structural(
    model: Model, measured: tuple[str, ...], n_runs: int = 1
) -> Identifiability:
    """What no record of these sensors can tell.

    Raises:
        ModelError: the model has no value at random states.
    """
    for digits in (100, 200, 400):
        with localcontext(prec=digits), suppress(ImpreciseError):
            return _structural(model, measured, n_runs, digits)
    raise ModelError(
        "the sensitivities of the model have parts so small that 400 digits do not "
        "tell them from zero; fix parameters, or leave terms out."
    )


def _structural(
    model: Model, measured: tuple[str, ...], n_runs: int, digits: int
) -> Identifiability:
    points = RandomPoints(model, n_runs, digits)
    places = list(map(model.index, measured))
    silent = points.silent(places)
    sensors: dict[str, tuple[str, ...]] = {}
    known_start: tuple[str, ...] = ()
    if len(silent.parameters):
        for name in model.states:
            if name not in (*measured, *model.memory):
                larger = points.silent([*places, model.index(name)])
                sensors[name] = _gained(model, silent, larger)
        started = points.silent(places, knows_start=True)
        known_start = _gained(model, silent, started)
    return Identifiability(
        model=model,
        measured=measured,
        groups=tuple(_groups(model.free, silent.parameters, points.theta)),
        unobservable=tuple(model.states[i] for i in silent.states),
        sensors={name: gained for name, gained in sensors.items() if gained},
        known_start=known_start,
        expected={},
    )


def _gained(model: Model, before: Silent, after: Silent) -> tuple[str, ...]:
    """The parameters that are open before and not after."""
    is_gained = np.any(before.parameters != 0, axis=0)
    is_gained &= ~np.any(after.parameters != 0, axis=0)
    return tuple(compress(model.free, is_gained))


# ---- what is identifiable of a group -------------------------------------------------


def _groups(
    names: Sequence[str], silent: np.ndarray, theta: np.ndarray
) -> Iterator[Group]:
    """Parameters that share directions (n_directions, n_free) of relative changes."""
    is_member = silent != 0
    n_shared = is_member.astype(int) @ is_member.T
    n_groups, group_of = scipy.sparse.csgraph.connected_components(n_shared)
    for number in range(n_groups):
        own = np.flatnonzero(group_of == number)
        members = np.flatnonzero(np.any(is_member[own], axis=0)).tolist()
        changes = silent[own][:, members]
        called = [names[i] for i in members]
        has_own = (silent[own] == 1) & (is_member.sum(axis=0) == 1)
        leads = np.sort(np.argmax(has_own, axis=1)).tolist()
        yield Group(
            parameters=tuple(called),
            combinations=tuple(_combinations(called, changes, theta[members])),
            fix=tuple(names[i] for i in leads),
        )


def _combinations(
    names: Sequence[str], changes: np.ndarray, theta: np.ndarray
) -> Iterator[str]:
    """Independent products and sums that do not change along any direction."""
    n_told = len(names) - len(changes)
    slopes = np.zeros((0, len(names)))  # in relative changes
    found = []
    for factors in _whole_numbers(changes):
        found.append((_product_text(names, factors), factors.astype(float)))
    for factors in _whole_numbers(changes * theta):
        found.append((_sum_text(names, factors), factors * theta))
    for text, slope in sorted(found, key=lambda one: np.count_nonzero(one[1])):
        more = np.vstack([slopes, slope / np.linalg.norm(slope)])
        if np.linalg.matrix_rank(more, tol=1e-8) > len(slopes):
            slopes = more
            yield text
        if len(slopes) == n_told:
            return


def _whole_numbers(changes: np.ndarray) -> list[np.ndarray]:
    """Small whole numbers a with changes a = 0, few and small ones first."""
    n = changes.shape[1]
    tried: list[np.ndarray] = []
    if n <= 6:
        tried += map(np.array, product((0, 1, -1), repeat=n))
    _, _, order = scipy.linalg.qr(changes, mode="economic", pivoting=True)
    leads = order[: len(changes)]
    solved = np.linalg.solve(changes[:, leads], changes)
    for column in order[len(changes) :]:
        fractions = [Fraction(-one).limit_denominator(6) for one in solved[:, column]]
        common = lcm(*(one.denominator for one in fractions))
        numbers = np.zeros(n, dtype=int)
        numbers[column] = common
        numbers[leads] = [int(one * common) for one in fractions]
        tried.append(numbers)
    found = []
    size = np.max(np.abs(changes))
    for numbers in tried:
        first = next(filter(None, numbers), 0)
        if first and np.all(np.abs(changes @ numbers) < 1e-10 * size):
            found.append(numbers * np.sign(first))
    found.sort(key=lambda one: (np.count_nonzero(one), np.abs(one).sum(), -one.sum()))
    return found


def _product_text(names: Sequence[str], exponents: np.ndarray) -> str:
    """Such as "k/m"."""
    above: list[str] = []
    below: list[str] = []
    for name, exponent in zip(names, exponents.tolist(), strict=True):
        power = name if abs(exponent) == 1 else f"{name}**{abs(exponent)}"
        if exponent:
            (above if exponent > 0 else below).append(power)
    divisor = "*".join(below)
    divisor = f"({divisor})" if len(below) > 1 else divisor
    return "/".join(filter(None, ["*".join(above) or "1", divisor]))


def _sum_text(names: Sequence[str], factors: np.ndarray) -> str:
    """Such as "a + 2*b"."""
    parts = []
    for name, factor in zip(names, factors.tolist(), strict=True):
        if factor:
            sign = "+" if factor > 0 else "-"
            parts.append(
                f"{sign} {'' if abs(factor) == 1 else f'{abs(factor)}*'}{name}"
            )
    return " ".join(parts).removeprefix("+ ")
