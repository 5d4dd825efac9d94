"""The gallery: every base model is identified from its own study text, and columns get
the names of its states and inputs.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
from phsi_opt.command_line.file_jobs import checked, first_study, gallery
from phsi_opt.study_file.columns import Column
from phsi_opt.study_file.gallery import GALLERY, BaseModel
from phsi_opt.study_file.keys import Complaints
from phsi_opt.study_file.model_reading import ModelReader

# The record: its length, the starting states, the largest inputs; and the truth of
# parameters that are not a fifth above their start.
RECORDS: dict[str, tuple[float, list[float], list[float], dict[str, float]]] = {
    "mass": (10, [0.5, 0], [3], {"c": 0.5}),
    "cart": (10, [0, 1], [3], {"c": 0.5}),
    "coast-down": (50, [30], [900], {}),
    "pendulum": (10, [1.0, 0], [1], {"c": 0.1}),
    "pendulum-cart": (10, [0, 0.8, 0, 0], [2], {"c": 0.3, "b": 0.01}),
    "two-masses": (10, [0.3, 0, 0, 0], [3], {"c1": 0.3, "c2": 0.5}),
    "motor": (2, [0], [12], {}),
    "motor-resistance": (0.5, [0], [12], {}),
    "motor-circuit": (0.5, [0, 0], [12], {}),
    "pump-tank": (60, [1], [0.1], {"a": 0.1, "g": 1.5}),
    "two-tanks": (60, [1, 1], [0.1], {"a1": 0.1, "a2": 0.1, "a3": 0.08, "g": 1.2}),
    "rlc": (0.02, [0, 0], [5], {}),
    "room": (1e5, [18], [1000, 10], {"C": 5e4}),
    "room-walls": (1e5, [18, 15], [1000, 10], {"C": 1e4}),
    "cell": (3000, [4, 0, 0], [2], {}),
}
N = 201


def with_speed(base: BaseModel) -> BaseModel:
    """The base model as it is where its velocities were measured."""
    states = base.velocity["states"].items()
    return base.seen_by([Column(name, name=name, unit=unit) for name, unit in states])


SEEN = {**GALLERY}
SEEN |= {
    f"{name}, speed": with_speed(one) for name, one in GALLERY.items() if one.velocity
}


def model_of(base: BaseModel) -> ph.Model:
    model, parameters = base.sections(list(base.inputs))
    file = {"model": model, "parameters": parameters}
    read = ModelReader.of(file, Complaints(file)).model()
    assert read is not None
    return read


def record_of(base: BaseModel) -> tuple[pd.DataFrame, dict[str, float]]:
    """A record of the machine as a table, and the true parameters."""
    length, x0, sizes, truth = RECORDS[base.name]
    rng = np.random.default_rng(1)
    t = np.linspace(0, length, N)
    levels = rng.uniform(0, 1, (21, len(sizes))) * sizes
    u = np.repeat(levels, 10, axis=0)[:N]  # steps up and down, none negative
    model = model_of(base)
    truth = {name: 1.2 * model.values[name] for name in model.free} | truth
    model = model.with_values(truth)
    x = ph.simulate(model, t, x0, u, hold="zero")
    table = {"t [s]": t}
    for k, (state, unit) in enumerate(base.units.items()):
        rows = zip(x, u, t, strict=True)
        shown = np.array([float(model.output()(*r, model.theta)[k]) for r in rows])
        if state in base.states:
            noise = 1e-3 * np.ptp(shown) * rng.normal(size=N)
            table[f"{state} [{unit}]"] = shown + noise
    for k, (name, unit) in enumerate(base.input_units.items()):
        table[f"{name} [{unit.removesuffix(' or any')}]"] = u[:, k]
    return pd.DataFrame(table), truth


@pytest.mark.parametrize("base", SEEN.values(), ids=list(SEEN))
def test_a_base_model_is_identified_from_the_study_file_that_init_writes(
    base: BaseModel, tmp_path: Path
) -> None:
    table, truth = record_of(base)
    path = tmp_path / "study.toml"
    table.to_csv(tmp_path / "data.csv", index=False)
    first_study([tmp_path / "data.csv"], path, force=False, model=base.name)
    answer = checked(path)
    assert answer.code == 0, answer.text
    file = ph.StudyFile.read(path)
    assert file.data.states.keys() == base.units.keys()
    assert file.data.inputs.keys() == base.inputs.keys()
    fit = ph.identify(file.model(), file.measurements())
    assert fit.outcome.success
    for name, value in truth.items():
        # The noise is 0.1 % of the range; four standard errors hold for all seeds but
        # one in 10 000.
        assert abs(fit.values[name] - value) < 4 * fit.std_errors[name] + 1e-4 * value
        assert fit.std_errors[name] < 0.3 * value, name


@pytest.mark.parametrize("base", GALLERY.values(), ids=list(GALLERY))
def test_a_base_model_stands_without_inputs_and_has_a_drawing(base: BaseModel) -> None:
    model, parameters = base.sections([])
    file = {"model": model, "parameters": parameters}
    faults = Complaints(file)
    read = ModelReader.of(file, faults).model()
    assert read is not None, faults.listed
    assert read.states == tuple(base.units) and read.inputs == ()
    drawing = ET.fromstring(base.picture)
    assert drawing.attrib["viewBox"].endswith(" 200 120")
    assert drawing.attrib["stroke"] == "currentColor"
    colours = {one.attrib.get("fill", "currentColor") for one in drawing.iter()}
    assert colours == {"none", "currentColor"}, "readable in light and dark"


@pytest.mark.parametrize(("name", "header", "states", "inputs"), [
    ("mass", "t [s],speed [mm/s],Weg [mm],F [N]", {"q": "Weg [mm]", "v": "speed [mm/s]"}, {"u": "F [N]"}),
    ("mass", "t [s],v,x", {"q": "x", "v": "v"}, {}),
    ("pendulum", "t [s],rate [deg/s],angle [deg]", {"q": "angle [deg]", "w": "rate [deg/s]"}, {}),
    ("two-masses", "t [s],x1 [m],x2 [m],v1 [m/s]", {"q1": "x1 [m]", "q2": "x2 [m]", "v1": "v1 [m/s]"}, {}),
    ("mass", "t [s],x", {"q": "x"}, {}),
    ("two-masses", "t [s],x1,x2,u", {"q1": "x1", "q2": "x2"}, {"u": "u"}),
    ("pendulum", "t [s],angle [deg]", {"q": "angle [deg]"}, {}),
    ("room", "t [s],outdoor [degC],Ti [degC],heater [W]", {"Ti": "Ti [degC]"}, {"P": "heater [W]", "Ta": "outdoor [degC]"}),
    ("coast-down", "time (min),speed (km/h)", {"v": "speed (km/h)"}, {}),
    ("rlc", "t [s],u_in [V],u_C [V],i [A]", {"uC": "u_C [V]", "i": "i [A]"}, {"u": "u_in [V]"}),
    ("rlc", "t [s],Spannung [V],Strom [mA]", {"i": "Strom [mA]"}, {"u": "Spannung [V]"}),
    ("motor", "t [s],U [mV],speed [rpm]", {"w": "speed [rpm]"}, {"u": "U [mV]"}),
    ("motor", "t [s],U [V],Drehzahl [1/min]", {"w": "Drehzahl [1/min]"}, {"u": "U [V]"}),
    ("pendulum", "t [s],phi [°],n [min⁻¹],M [Nm]", {"q": "phi [°]", "w": "n [min⁻¹]"}, {"u": "M [Nm]"}),
    ("pump-tank", "t [min],level [cm],flow [l/min]", {"h": "level [cm]"}, {"u": "flow [l/min]"}),
    ("pump-tank", "t [s],level [m],pump [V]", {"h": "level [m]"}, {"u": "pump [V]"}),
    ("cell", "t [s],I [A],U [V]", {"U": "U [V]"}, {"I": "I [A]"}),
])  # fmt: skip
def test_columns_are_states_and_inputs_by_name_unit_and_order(
    name: str,
    header: str,
    states: dict[str, str],
    inputs: dict[str, str],
    tmp_path: Path,
) -> None:
    names = header.split(",")
    rows = np.random.default_rng(0).uniform(1, 2, (9, len(names)))
    rows[:, 0] = range(9)
    pd.DataFrame(rows, columns=names).to_csv(tmp_path / "a.csv", index=False)
    path = tmp_path / "study.toml"
    first_study([tmp_path / "a.csv"], path, force=False, model=name)
    file = ph.StudyFile.read(path)
    found = {state: one.column for state, one in file.data.states.items()}
    assert {state: column for state, column in found.items() if column} == states
    assert found.keys() == set(file.base.states), "the others were not measured"
    assert {one: data.column for one, data in file.data.inputs.items()} == inputs
    of_rotation = [one.unit for one in file.data.states.values() if "min" in one.unit]
    assert not of_rotation, "a speed of rotation is in rpm"


def test_init_lists_the_gallery_and_suggests_a_name() -> None:
    text = gallery().text
    assert all(f"\n{name}: " in text for name in GALLERY)
    assert max(map(len, text.splitlines())) <= 80
    with pytest.raises(ph.DataError, match="Did you mean 'pendulum'"):
        first_study([Path("a.csv")], Path("study.toml"), False, "pendulu")
