"""Every measured set: what a study is given to tell its story."""

from collections.abc import Callable
from dataclasses import dataclass

import phsi_opt as ph
from problems.measured import machines, storages, vibrations

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
        page: Of the story at length; "": it is told in short alone.
        note: What stands at the head of that page.
    """

    folder: str
    machine: str
    model: Callable[[], Model]
    records: Callable[[], Records]
    known: str
    physics: tuple[str, ...]
    tests: Callable[[], dict[str, ph.Measurements]] = dict
    page: str = ""
    note: str = ""


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
        page="emps_story",
        note="Windows of 1 s, thinned to 100 Hz; the record with force pulses judges.",
    ),
    "cascaded tanks": Set(
        "cascaded_tanks",
        "two tanks, the lower level measured; outflows by Torricelli",
        storages.textbook_tanks,
        lambda: storages.tanks().split(storages.TANKS_SHARE),
        "both tanks overflow in the record",
        ("overflow from h1 on h2",),
        lambda: {"test": storages.tanks("Val")},
        page="cascaded_tanks",
        note="The first 70 % of the fit record are fitted, the last 30 % judge; the "
        "test is only looked at, without its samples at the sensor's limit. Published "
        "test errors: linear 0.75, Volterra 0.54, neural 0.33 to 0.40, grey box with "
        "overflow 0.18 V.",
    ),
    "ball and hoop": Set(
        "ball_and_hoop",
        "a hoop's speed; one linear lag",
        machines.hoop_model,
        lambda: machines.hoop().split(machines.HOOP_SHARE),
        "not published; the response falls at large speeds",
        ("quadratic drag on y",),
        lambda: {name: machines.hoop(name) for name in machines.HOOP_TESTS},
        page="ball_and_hoop",
        note="The first 70 % of the random steps are fitted, the last 30 % judge. "
        "Least squares by hand on the two tests: 1 and 0.96 V with linear drag, "
        "0.283 and 0.267 V with quadratic drag.",
    ),
    "quarter drone": Set(
        "quarter_drone",
        "an arm with a propeller; gravity, viscous damping, linear thrust",
        machines.drone_model,
        lambda: (machines.drone("steps"), machines.drone("multisine")),
        "not published; the arm is not balanced, its bearing is dry",
        ("constant force on p", "coulomb friction on p"),
        lambda: {"swept sine": machines.drone("swept sine")},
        page="quarter_drone",
        note="Windows of 5 s at 20 Hz; those of the multisine judge. Simulations "
        "fitted by hand to the same windows: 8.57 degrees with the base model, "
        "2.85 with a thrust offset, 2.46 with a lag of the motor, 1.17 with friction.",
    ),
    "Silverbox": Set(
        "silverbox",
        "an electronic oscillator; linear spring and damper",
        machines.box_model,
        _box_records,
        "a cubic spring, and an offset",
        ("cubic stiffness on p", "constant force on p"),
        lambda: {"arrow": machines.box(*machines.ARROW)},
        page="silverbox",
        note="2048 samples of a multisine are fitted, 2048 of another one judge; the "
        "end of the arrow, with larger amplitudes, is only looked at.",
    ),
    "Bouc-Wen hysteresis": Set(
        "bouc_wen",
        "a mass that is shaken; linear spring and damper",
        vibrations.bouc_wen_base,
        lambda: machines.first_two(
            vibrations.N_BOUC_WEN, vibrations.bouc_wen("est_multisine")
        ),
        "Bouc and Wen's hysteresis",
        ("bouc-wen hysteresis on p",),
        page="bouc_wen",
        note="1000 samples at 750 Hz are fitted, the 1000 after them judge; the league "
        "table has the errors of whole test records.",
    ),
    "F-16": Set(
        "f16",
        "the main resonance of a wing with a payload, shaken at four levels (6.8 to "
        "8 Hz); linear stiffness and damping",
        vibrations.resonance_model,
        lambda: (
            vibrations.resonance(vibrations.FITTED),
            vibrations.resonance(vibrations.JUDGED),
        ),
        "the bolted joint of the payload slides with dry friction, and has a gap",
        ("hysteresis on p",),
        lambda: {f"level {n}": vibrations.resonance((n,)) for n in (2, 4, 6)},
        page="f16",
        note="10 s of the payload's velocity and the force within the band, at 100 Hz; "
        "levels 1 and 7 are fitted, 3 and 5 judge, 2, 4 and 6 are only looked at. The "
        "band has no noise to speak of, so the noise floor is far below every model.",
    ),
    "motor pendulum": Set(
        "torque_pendulum",
        "a pendulum with a motor, its angle measured; viscous friction",
        machines.pendulum_model,
        lambda: machines.pendulum().split(0.5),
        "dry friction 0.29 N m, offset 0.076 N m, over the inertia 0.15 kg m^2; the "
        "velocity in the file is worked out from the angle and left out",
        ("coulomb friction on v", "constant force on v"),
    ),
    "house 1": Set(
        "building",
        "a heated house; one heat capacity",
        storages.house_model,
        lambda: storages.house().split(0.5),
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
        storages.cell_model,
        lambda: storages.cell().split(0.5),
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
