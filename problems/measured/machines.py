"""Every measured set with its models, as the measurement of the halves takes them.

A set gives its training record and the length of a window that suits it: some time
constants of the machine, and as many windows as the record allows. The models are the
base models of the sets, and the larger ones that the pages beside this file arrive at.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import phsi_opt as ph
from phsi_opt.model.catalogue import effect_named
from problems.measured import (
    ball_and_hoop,
    battery_cell,
    cascaded_tanks,
    coupled_drives,
    emps,
    heaters,
    houses,
    quarter_drone,
    silverbox,
    torque_pendulum,
)
from problems.tools.data_paths import folder


@dataclass(frozen=True)
class Case:
    """A model of a measured set and the record that it is fitted to.

    Attributes:
        model: Makes the model.
        load: Reads the training record.
        path: Where it lies.
        window: Samples of a window; None: the record has its windows.
        length: Of a window, in words.
        is_windowed: Whether first and second half are cut into windows too, because
            free runs of the machine drift.
    """

    model: Callable[[], ph.Model]
    load: Callable[[Path], ph.Measurements]
    path: Path
    window: int | None
    length: str
    is_windowed: bool = False


def _with(model: ph.Model, effects: Mapping[str, str]) -> ph.Model:
    """The model with effects of the catalogue, each in an equation."""
    for effect, equation in effects.items():
        model = model.add(effect_named(model, effect, equation))
    return model


# --- the sets whose loaders ask for more than a path


def _quarter_drone(path: Path) -> ph.Measurements:
    """The flight in one piece."""
    begin, end = quarter_drone.FLYING
    return quarter_drone.load(path, "steps", window=end - begin)


def _silverbox(path: Path) -> ph.Measurements:
    return silverbox.load(path, *silverbox.FIT)


def _cascaded_tanks(path: Path) -> ph.Measurements:
    return cascaded_tanks.load(path, "Est")


# --- the cases of sets with several models


def _house(number: int, n_storages: int) -> Case:
    return Case(
        houses.two_storages if n_storages == 2 else houses.one_storage,
        lambda path: houses.load(path, number, n_storages),
        folder("building"),
        window=384,
        length="4 days",
    )


def _battery(n_pairs: int) -> Case:
    return Case(
        lambda: battery_cell.model(n_pairs),
        lambda path: battery_cell.load(path, n_pairs),
        battery_cell.FILE,
        window=None,
        length="one cycle of pulses",
    )


def _hoop(effects: Mapping[str, str]) -> Case:
    return Case(
        lambda: _with(ball_and_hoop.model(), effects),
        ball_and_hoop.load,
        folder("ball_and_hoop") / "randomStepSequence.mat",
        window=250,
        length="25 s",
    )


def _drone(effects: Mapping[str, str]) -> Case:
    return Case(
        lambda: _with(quarter_drone.model(), effects),
        _quarter_drone,
        folder("quarter_drone"),
        window=100,
        length="5 s",
        is_windowed=True,
    )


def _box(effects: Mapping[str, str]) -> Case:
    return Case(
        lambda: _with(silverbox.model(), effects),
        _silverbox,
        folder("silverbox") / "SNLS80mV.csv",
        window=512,
        length="256 samples, 0.42 s",
    )


def _drives(effects: Mapping[str, str]) -> Case:
    return Case(
        lambda: _with(coupled_drives.model(), effects),
        coupled_drives.load,
        coupled_drives.FILE,
        window=100,
        length="2 s",
    )


CASES: Mapping[str, Case] = {
    "ball and hoop, linear": _hoop({}),
    "ball and hoop, quadratic drag": _hoop({"quadratic drag": "y"}),
    "EMPS, published model": Case(
        lambda: emps.model(emps.START),
        emps.load,
        folder("emps") / emps.FIT_FILE,
        window=emps.WINDOW,
        length="1 s",
    ),
    "quarter drone, base": _drone({}),
    "quarter drone, offset and dry friction": _drone(
        {"constant force": "p", "coulomb friction": "p"}
    ),
    "Silverbox, linear": _box({}),
    "Silverbox, offset and cubic": _box(
        {"constant force": "p", "cubic stiffness": "p"}
    ),
    "cascaded tanks, textbook": Case(
        cascaded_tanks.textbook,
        _cascaded_tanks,
        folder("cascaded_tanks") / "dataBenchmark.csv",
        window=128,
        length="512 s",
    ),
    "torque pendulum": Case(
        torque_pendulum.model,
        torque_pendulum.load,
        torque_pendulum.FILE,
        window=117,
        length="0.39 s",
    ),
    "house 1, one storage": _house(1, 1),
    "house 1, two storages": _house(1, 2),
    "house 3, one storage": _house(3, 1),
    "house 3, two storages": _house(3, 2),
    "two heaters": Case(
        heaters.model, heaters.load, heaters.FILE, window=60, length="60 s"
    ),
    "battery cell, one pair": _battery(1),
    "battery cell, two pairs": _battery(2),
    "coupled drives, linear": _drives({}),
    "coupled drives, dry friction": _drives({"coulomb friction": "w"}),
}
