"""Every measured set: what a study is given to tell its story, and the models and
records of which halves are compared.

    python -m problems.measured.sets [MODEL ...] [--data=FOLDER]

fits the models whose name contains one of the words, and prints them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import phsi_opt as ph
from problems.measured import machines, storages
from problems.tools.command_line import chosen
from problems.tools.data_paths import folder, is_present

Model = ph.PseudoHamiltonian | ph.FirstOrder
Records = tuple[ph.Measurements, ph.Measurements]


@dataclass(frozen=True)
class Set:
    """A measured set with a base model that lacks what the set is known for.

    Attributes:
        folder: Of its files.
        machine: What it is, and what the base model has.
        model: Makes the base model.
        records: Reads the records to fit and to judge by.
        known: What is published or known of what the base lacks.
        physics: The same as effects that are added by hand, to compare.
        tests: Reads further records, by name, that are looked at only to report.
    """

    folder: str
    machine: str
    model: Callable[[], Model]
    records: Callable[[], Records]
    known: str
    physics: tuple[str, ...]
    tests: Callable[[], dict[str, ph.Measurements]] = dict


def _box_records() -> Records:
    n = machines.N_BOX_STORY
    first, second = machines.BOX_FIT[0], machines.BOX_HELD_OUT[0]
    return machines.box(first, first + n), machines.box(second, second + n)


SETS = {
    "EMPS": Set(
        "emps",
        "a linear drive; mass and viscous friction",
        machines.emps_base,
        lambda: (machines.emps(), machines.emps("test")),
        "dry friction 20.4 N, offset 3.2 N (to the other side)",
        ("coulomb friction on p", "constant force on p"),
    ),
    "cascaded tanks": Set(
        "cascaded_tanks",
        "two tanks, the lower level measured; outflows by Torricelli",
        storages.textbook_tanks,
        lambda: storages.tanks().split(storages.TANKS_SHARE),
        "both tanks overflow in the record",
        ("overflow from h1 on h2",),
        lambda: {"test": storages.tanks("Val")},
    ),
    "ball and hoop": Set(
        "ball_and_hoop",
        "a hoop's speed; one linear lag",
        machines.hoop_model,
        lambda: machines.hoop().split(machines.HOOP_SHARE),
        "not published; the response falls at large speeds",
        ("quadratic drag on y",),
        lambda: {name: machines.hoop(name) for name in machines.HOOP_TESTS},
    ),
    "quarter drone": Set(
        "quarter_drone",
        "an arm with a propeller; gravity, viscous damping, linear thrust",
        machines.drone_model,
        lambda: (machines.drone("steps"), machines.drone("multisine")),
        "not published; the arm is not balanced, its bearing is dry",
        ("constant force on p", "coulomb friction on p"),
        lambda: {"swept sine": machines.drone("swept sine")},
    ),
    "Silverbox": Set(
        "silverbox",
        "an electronic oscillator; linear spring and damper",
        machines.box_model,
        _box_records,
        "a cubic spring, and an offset",
        ("cubic stiffness on p", "constant force on p"),
    ),
    "motor pendulum": Set(
        "torque_pendulum",
        "a pendulum with a motor, its angle measured; viscous friction",
        partial(machines.pendulum_model, is_base=True),
        lambda: machines.pendulum(has_velocity=False).split(0.5),
        "dry friction 0.29 N m, offset 0.076 N m, over the inertia 0.15 kg m^2; the "
        "velocity in the file is worked out from the angle and left out",
        ("coulomb friction on v", "constant force on v"),
    ),
    "house 1": Set(
        "building",
        "a heated house; one heat capacity",
        partial(storages.house_model, 1),
        lambda: storages.house(1, 1).split(0.5),
        "a second storage (the envelope)",
        ("second heat storage on Ti",),
    ),
    "two heaters": Set(
        "heaters",
        "two heaters on a board with lagging sensors",
        storages.heaters_model,
        lambda: storages.heaters().split(0.5),
        "radiation is some percent of the loss; little else",
        ("radiation on T1", "radiation on T2"),
    ),
    "battery cell": Set(
        "battery_cell",
        "a cell with one resistor and capacitor",
        partial(storages.cell_model, 1),
        lambda: storages.cell(1).split(0.5),
        "a second pair",
        ("second charge storage on v",),
    ),
    "coupled drives": Set(
        "coupled_drives",
        "two drums and a belt; viscous friction",
        machines.drives_model,
        lambda: machines.drives().split(0.67),
        "not published; the drums have dry friction",
        ("coulomb friction on w",),
    ),
}


def with_effects(model: ph.Model, effects: tuple[str, ...]) -> ph.Model:
    """The model with effects of the catalogue, each as "coulomb friction on p"."""
    for effect in effects:
        name, _, equation = effect.rpartition(" on ")
        model = model.add(name, equation)
    return model


# --- the halves


@dataclass(frozen=True)
class Case:
    """A model of a measured set and the training record that it is fitted to.

    Attributes:
        folder: Of the set's files.
        model: Makes the model: the base, or a larger one that the pages arrive at.
        load: Reads the record.
        window: Samples of a window, some time constants of the machine; None: the
            record has its windows.
        length: Of a window, in words.
        effects: Added to the model.
        is_windowed: Whether first and second half are cut into windows too, because
            free runs of the machine drift.
    """

    folder: str
    model: Callable[[], ph.Model]
    load: Callable[[], ph.Measurements]
    window: int | None
    length: str
    effects: tuple[str, ...] = ()
    is_windowed: bool = False

    def fit(self, data: ph.Measurements) -> ph.Fit:
        """The model, fitted to some of the data."""
        return ph.identify(with_effects(self.model(), self.effects), data)


def _hoop(*effects: str) -> Case:
    model, load = machines.hoop_model, machines.hoop
    return Case("ball_and_hoop", model, load, 250, "25 s", effects)


def _drone(*effects: str) -> Case:
    begin, end = machines.FLYING
    flight = partial(machines.drone, window=end - begin)  # in one piece
    model = machines.drone_model
    return Case("quarter_drone", model, flight, 100, "5 s", effects, is_windowed=True)


def _box(*effects: str) -> Case:
    load = partial(machines.box, *machines.BOX_FIT)
    length = "256 samples, 0.42 s"
    return Case("silverbox", machines.box_model, load, 512, length, effects)


def _house(number: int, n_storages: int) -> Case:
    model = partial(storages.house_model, n_storages)
    load = partial(storages.house, number, n_storages)
    return Case("building", model, load, 384, "4 days")


def _cell(n_pairs: int) -> Case:
    model = partial(storages.cell_model, n_pairs)
    load = partial(storages.cell, n_pairs)
    return Case("battery_cell", model, load, None, "one cycle of pulses")


def _drives(*effects: str) -> Case:
    model, load = machines.drives_model, machines.drives
    return Case("coupled_drives", model, load, 100, "2 s", effects)


CASES: Mapping[str, Case] = {
    "ball and hoop, linear": _hoop(),
    "ball and hoop, quadratic drag": _hoop("quadratic drag on y"),
    "EMPS, published model": Case(
        "emps",
        machines.emps_model,
        partial(machines.emps, window=None),
        machines.EMPS_WINDOW,
        "1 s",
    ),
    "quarter drone, base": _drone(),
    "quarter drone, offset and dry friction": _drone(
        "constant force on p", "coulomb friction on p"
    ),
    "Silverbox, linear": _box(),
    "Silverbox, offset and cubic": _box("constant force on p", "cubic stiffness on p"),
    "cascaded tanks, textbook": Case(
        "cascaded_tanks", storages.textbook_tanks, storages.tanks, 128, "512 s"
    ),
    "torque pendulum": Case(
        "torque_pendulum", machines.pendulum_model, machines.pendulum, 117, "0.39 s"
    ),
    "house 1, one storage": _house(1, 1),
    "house 1, two storages": _house(1, 2),
    "house 3, one storage": _house(3, 1),
    "house 3, two storages": _house(3, 2),
    "two heaters": Case(
        "heaters", storages.heaters_model, storages.heaters, 60, "60 s"
    ),
    "battery cell, one pair": _cell(1),
    "battery cell, two pairs": _cell(2),
    "coupled drives, linear": _drives(),
    "coupled drives, dry friction": _drives("coulomb friction on w"),
}


def chosen_cases(words: list[str]) -> dict[str, Case]:
    """The cases whose name contains one of the words and whose data are there; all by
    default.
    """
    found = {}
    for name, case in CASES.items():
        is_wanted = any(word.lower() in name.lower() for word in words) or not words
        if is_wanted and is_present(folder(case.folder)):
            found[name] = case
    return found


if __name__ == "__main__":
    for name, case in chosen_cases(chosen()).items():
        fit = case.fit(case.load())
        print(name, fit, f"{fit.seconds:.0f} s", sep="\n", flush=True)
