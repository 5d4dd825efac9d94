"""Units: what is written is converted to SI once, checked, and told as it was written."""

import copy
import datetime as dt
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.model.unit_checks import UnitCheck
from phsi_opt.presentation.units import (
    STANDARD_DEVIATIONS,
    dates_words,
    frequency_words,
    in_si,
    measure_of,
    rate_unit,
    scale_of,
    scale_of_errors,
    scale_of_rate,
    time_words,
    times_words,
    unit_of_rate,
)
from tests.systems import pair, spring

ENERGY = "k*q**2/2 + p**2/(2*m)"


def cart(**parameters: ph.Parameter | float) -> ph.PseudoHamiltonian:
    return pair(ENERGY, ph.damping("p"), **parameters)


def known(value: float, unit: str = "") -> ph.Parameter:
    return ph.Parameter(value, fixed=True, unit=unit)


def swings(
    units: dict[str, str], size: float = 1.0, per_s: float = 1.0
) -> ph.Measurements:
    """Three runs of a cart of 2.5 kg on 52 N/m, its position in sizes of a metre."""
    truth = cart(k=52.0, m=2.5).with_fixed({"R_p": 0.8})
    rng = np.random.default_rng(1)
    t = np.arange(200) * 0.02
    runs = []
    for start in (0.1, -0.07, 0.05):
        q = ph.simulate(truth, t, [start, 0.0])[:, 0] + rng.normal(0, 5e-4, len(t))
        runs.append(np.column_stack([q / size, np.full(len(t), np.nan)]))
    return ph.Measurements.from_arrays(
        [t * per_s] * 3, runs, states=["q", "p"], units=units
    )


MM = {"q": "mm", "t": "ms"}


def written(
    folder: Path, data: ph.Measurements, units: dict[str, str], text: str
) -> Path:
    """A study file of a cart beside its table."""
    table = data.to_dataframe().drop(columns="p")
    table.to_csv(folder / "cart.csv", index=False)
    path = folder / "study.toml"
    path.write_text(f"""
[data]
files = ["cart.csv"]
trajectory = "trajectory"
time = {{ column = "t", unit = "{units["t"]}" }}
[data.states]
q = {{ column = "q", unit = "{units["q"]}" }}
p = {{ measured = false }}
[held_out]
share = 0.3
[model]
states = ["q", "p"]
pairs = [["q", "p"]]
H = "{ENERGY}"
R = {{ p = "c" }}
[parameters]
c = {{ lower = 0 }}
{text}
""")
    return path


def complaints(path: Path) -> dict[str, str]:
    with pytest.raises(ph.StudyFileError) as caught:
        ph.StudyFile.read(path)
    return {one.key: str(one) for one in caught.value.complaints}


# ---- one unit ------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "powers", "size"), [
    ("rpm", {"rad": 1, "s": -1}, 2 * np.pi / 60),
    ("RPM", {"rad": 1, "s": -1}, 2 * np.pi / 60),
    ("min⁻¹", {"s": -1}, 1 / 60),
    ("deg", {"rad": 1}, np.pi / 180),
    ("°", {"rad": 1}, np.pi / 180),
    ("%", {}, 0.01),
    ("bar", {"kg": 1, "m": -1, "s": -2}, 1e5),
    ("kWh", {"kg": 1, "m": 2, "s": -2}, 3.6e6),
    ("km/h", {"m": 1, "s": -1}, 1 / 3.6),
    ("min", {"s": 1}, 60.0),
    ("mA", {"A": 1}, 1e-3),
    ("l/min", {"m": 3, "s": -1}, 1e-3 / 60),
    ("Nm", {"kg": 1, "m": 2, "s": -2}, 1.0),
    ("mNm", {"kg": 1, "m": 2, "s": -2}, 1e-3),
    ("N*s", {"kg": 1, "m": 1, "s": -1}, 1.0),
    ("Vs", {"kg": 1, "m": 2, "s": -2, "A": -1}, 1.0),
    ("kgm2/s", {"kg": 1, "m": 2, "s": -1}, 1.0),
    ("m2", {"m": 2}, 1.0),
    ("m^2", {"m": 2}, 1.0),
    ("cm³", {"m": 3}, 1e-6),
    ("µm", {"m": 1}, 1e-6),
    ("W/degF", {"kg": 1, "m": 2, "s": -3, "K": -1}, 1.8),
    ("mmH2O", {"kg": 1, "m": -1, "s": -2}, 9.80665),
    ("kOhm", {"kg": 1, "m": 2, "s": -3, "A": -2}, 1e3),
    ("counts", {"counts": 1}, 1.0),
    ("a.u.", {"a": 1, "u": 1}, 1.0),
    ("C", {"C": 1}, 1.0),
    ("foo", {"foo": 1}, 1.0),
])  # fmt: skip
def test_a_unit_is_powers_of_si_and_a_size(unit, powers, size) -> None:
    found = measure_of(unit)
    assert found is not None
    assert found.powers == powers
    assert found.size == pytest.approx(size, rel=1e-14)


def test_what_is_no_unit_stays_as_it_is() -> None:
    assert measure_of('deg "C"') is None
    assert in_si({"t": "s", "x": 'deg "C"'}) == {"t": "s", "x": 'deg "C"'}


def test_temperatures_are_in_degrees_of_celsius_unless_all_are_in_kelvin() -> None:
    units = in_si({"t": "h", "T": "degF", "To": "K", "P": "kW"})
    assert units == {"t": "s", "T": "degC", "To": "degC", "P": "W"}
    assert scale_of(units["T"]).read(68.0) == pytest.approx(20.0)
    assert scale_of(units["T"]).shown(20.0) == pytest.approx(68.0)
    assert scale_of(units["To"]).read(293.15) == pytest.approx(20.0)
    assert in_si({"t": "s", "T": "K"}) == {"t": "s", "T": "K"}


def test_a_unit_keeps_how_it_was_written_in_copies_and_other_processes() -> None:
    unit = in_si({"t": "ms"})["t"]
    for one in (pickle.loads(pickle.dumps(unit)), copy.deepcopy(unit)):
        assert one == "s"
        assert scale_of(one).unit == "ms"


def test_times_and_rates_are_told_in_the_units_that_were_written() -> None:
    units = in_si({"t": "ms", "q": "mm"})
    assert time_words(0.25, units["t"]) == "250 ms"
    assert time_words(7200.0, units["t"]) == "120 min"
    assert time_words(2.5, units["t"]) == "2500 ms"
    assert time_words(28.0, units["t"]) == "28 s"
    assert scale_of_rate("q", units, 1.0).unit == "mm/s"
    assert scale_of_rate("p", {**units, "p": "kg m/s"}, 1.0).unit == "N"
    house = in_si({"t": "min", "T": "degF", "V": "l"})
    assert scale_of_rate("T", house, 600.0).unit == "degF/min"
    assert scale_of_rate("V", house, 600.0).unit == "l/min"
    assert scale_of(unit_of_rate("1", house["t"])).unit == "1/min"
    assert time_words(100.0, in_si({"t": "h"})["t"]) == "0.0278 h"
    assert times_words(-7200.0, 0.0, "s") == "-120 to 0 min"


@pytest.mark.parametrize(("frequency", "time", "words"), [
    (2.0, "s", "at 2 Hz"),
    (2.0, "ms", "at 2 cycles per ms"),
    (2.0, "", "at 2 cycles per unit of time"),
    (2.0, "h", "with a period of 0.5 h"),
    (1 / 7200, "s", "with a period of 120 min"),
])  # fmt: skip
def test_a_slow_frequency_is_told_by_its_period(frequency, time, words) -> None:
    assert frequency_words(frequency, {"t": time}) == words


def test_a_rate_is_per_hour_in_a_long_record_unless_it_has_a_name_of_its_own() -> None:
    units = {"t": "s", "T": "degC", "q": "m", "x": ""}
    scale = scale_of_rate("T", units, 86400.0)
    assert (scale.unit, scale.shown(1.0)) == ("degC/h", 3600.0)
    assert scale_of_rate("q", units, 86400.0).unit == "m/s"
    assert (rate_unit("", "s"), rate_unit("m", "")) == ("", "")


@pytest.mark.parametrize(("last", "words"), [
    (5, "2024-03-05 14:30 to 14:30:05"),
    (3600, "2024-03-05 14:30 to 15:30"),
    (43200, "2024-03-05 14:30 to 2024-03-06 02:30"),
    (3 * 86400, "2024-03-05 to 2024-03-08"),
])  # fmt: skip
def test_dates_are_told_as_exactly_as_their_range_asks(last: float, words: str) -> None:
    assert dates_words(0.0, last, dt.datetime(2024, 3, 5, 14, 30)) == words
    assert dates_words(0.0, last, None) == ""


# ---- measurements --------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "largest", "expected"), [
    ("m", 0.0101, (1.0, "m")),
    ("m", 0.0099, (1e3, "mm")),
    ("m", 0.99e-5, (1e6, "µm")),
    ("m", 1e-30, (1.0, "m")),  # no prefix is so small
    ("m", 0.0, (1.0, "m")),
    ("degC", 0.001, (1.0, "degC")),
    (STANDARD_DEVIATIONS, 0.001, (100.0, "% of the standard deviation")),
])  # fmt: skip
def test_small_errors_are_told_with_a_prefix(unit, largest, expected) -> None:
    size, told = scale_of_errors(unit, largest)
    assert told == expected[1]
    assert size == pytest.approx(expected[0])


def test_measurements_in_si_are_computed_in_si_and_told_as_written() -> None:
    data = ph.Measurements.from_arrays(
        [0, 20, 40],
        [[1.0], [2.0], [3.0]],
        [[600.0], [0.0], [1.0]],
        states=["q"],
        inputs=["n"],
        units={"q": "mm", "t": "ms", "n": "rpm"},
        noise={"q": 0.5},
    )
    converted = data.in_si()
    assert dict(converted.units) == {"q": "m", "t": "s", "n": "rad/s"}
    np.testing.assert_allclose(converted.stacked("t"), [0, 0.02, 0.04])
    np.testing.assert_allclose(converted.stacked("x")[:, 0], [0.001, 0.002, 0.003])
    np.testing.assert_allclose(converted.stacked("u")[0], 20 * np.pi)
    assert converted.noise is not None
    assert converted.noise["q"] == pytest.approx(5e-4)
    assert str(converted) == str(data)
    assert converted.in_si() is converted
    assert data.units["q"] == "mm"
    assert data.stacked("t").tolist() == [0, 20, 40]


def test_what_is_in_si_or_has_no_time_stays_the_same_object() -> None:
    for units in ({"q": "m", "t": "s"}, {"q": "mm"}, {}, {"q": "counts", "t": "s"}):
        data = swings(units)
        assert data.in_si() is data


# ---- formulas ------------------------------------------------------------------------


def fault(model: ph.PseudoHamiltonian | ph.FirstOrder, units: dict[str, str]) -> str:
    with pytest.raises(ph.ModelError) as caught:
        UnitCheck(model, units).refuse()
    assert len(str(caught.value)) <= 300
    return str(caught.value)


def test_a_unit_of_the_wrong_dimension_is_told_with_the_expected_one() -> None:
    wrong = cart(k=ph.Parameter(50.0, unit="N"), m=known(2.5, "kg"))
    for units in ({"q": "m", "t": "s"}, MM):
        said = fault(wrong, units)
        assert said.startswith("k is in N: the formulas ask for N/m, with m in kg")


def test_a_mass_of_one_that_is_left_out_is_no_contradiction() -> None:
    model = spring(ph.Parameter(50.0, unit="N/m"))
    UnitCheck(model, {"q": "m", "t": "s"}).refuse()


def test_units_of_different_size_are_refused_with_the_repair() -> None:
    stiff = ph.Parameter(50.0, unit="N/m")
    both = fault(cart(k=stiff, m=known(2.5, "kg")), MM)
    assert "q in mm, t in ms; k in N/m, m in kg" in both
    assert "data.in_si()" in both
    number = fault(cart(k=stiff, m=2.5), MM)
    assert number.startswith("m = 2.5 has no unit")
    parameter = fault(
        cart(k=ph.Parameter(50.0, unit="N/mm"), m=known(2.5, "kg")),
        {"q": "m", "t": "s"},
    )
    assert 'k=ph.Parameter(50000, unit="N/m")' in parameter


def test_an_angle_in_degrees_does_not_stand_in_a_cosine() -> None:
    energy, loss = "-m*9.81*l*cos(q) + p**2/(2*m*l**2)", ph.damping("p")
    pendulum = pair(energy, loss, m=known(1, "kg"), l=known(0.5, "m"))
    UnitCheck(pendulum, {"q": "rad", "t": "s"}).refuse()
    assert "q in deg" in fault(pendulum, {"q": "deg", "t": "s"})
    assert "q is in m" in fault(pendulum, {"q": "m", "t": "s"})


def test_what_fits_together_as_written_is_left_alone() -> None:
    UnitCheck(cart(k=50.0, m=2.5), MM).refuse()
    rate = ph.formula("a*(To - T) + 1000*P/C", a=ph.Parameter(0.1), C=known(1e6, "J/K"))
    house = ph.FirstOrder(["T"], {"T": rate}, inputs=["To", "P"])
    UnitCheck(house, {"T": "degC", "To": "degC", "P": "kW", "t": "s"}).refuse()
    rate = ph.formula("a*(To - T) + P/C", a=ph.Parameter(0.1), C=1000.0)
    house = ph.FirstOrder(["T"], {"T": rate}, inputs=["To", "P"])
    UnitCheck(house, {"T": "degC", "To": "degC", "P": "W", "t": "h"}).refuse()


def test_every_public_call_refuses_units_that_do_not_fit() -> None:
    data = swings(MM, 1e-3, 1e3)
    wrong = cart(k=ph.Parameter(50.0, unit="N/m"), m=2.5)
    for call in (ph.identify, ph.Study):
        with pytest.raises(ph.ModelError, match="in_si"):
            call(wrong, data)
    frozen = cart(k=known(50.0, "N/m"), m=2.5).with_fixed({"R_p": 0.8})
    for judge in (ph.compare, ph.diagnose):
        with pytest.raises(ph.ModelError, match="in_si"):
            judge(frozen, data)


# ---- study files ---------------------------------------------------------------------


def test_a_number_without_a_unit_is_asked_for_where_the_data_are_not_in_si(
    tmp_path: Path,
) -> None:
    data = swings(MM, 1e-3, 1e3)
    text = 'k = { start = 50, unit = "N/m" }\nm = 2.5'
    found = complaints(written(tmp_path, data, MM, text))
    assert list(found) == ["parameters.m"]
    assert 'm = { value = 2.5, unit = "kg" }' in found["parameters.m"]


def test_a_study_in_mm_and_ms_finds_the_stiffness_and_tells_mm_and_ms(tmp_path) -> None:
    data = swings(MM, 1e-3, 1e3)
    text = 'k = { start = 0.05, unit = "N/mm" }\nm = { value = 2500, unit = "g" }'
    file = ph.StudyFile.read(written(tmp_path, data, MM, text))
    study = file.study()
    row = study.fit.parameters.set_index("name").loc["k"]
    assert row["unit"] == "N/mm"
    assert abs(row["value"] - 0.052) < 4 * row["std_error"]
    assert study.fit.values["k"] == pytest.approx(1000 * row["value"])
    assert study.unit == "mm"
    assert 0.4 < study.history["train_rmse"][0] < 0.6
    assert list(study.history["unit"]) == ["mm"]
    content = study.content()
    assert content.time.unit == "s"  # of some thousand ms
    channel = content.runs[0].channels[0]
    assert channel.unit == "mm"
    (run,) = data[content.runs[0].name].trajectories
    np.testing.assert_allclose(channel.t, run.t / 1000, rtol=1e-12)
    np.testing.assert_allclose(channel.measured, run.x[:, 0])
    rows = {one.name: one for one in content.models[0].parameters}
    assert rows["m"].value == pytest.approx(2500)
    ends = (rows["k"].lower, rows["k"].upper)
    assert ends[0] is not None and ends[1] is not None
    assert ends[0] < 0.052 < ends[1]
    for said in (str(study.fit), str(study.compare()), *map(str, content.checks)):
        assert not re.search(r"\d m\b", said)
    # What is written is what was read, and the script computes the same.
    again = ph.StudyFile.read(file.write(tmp_path / "again.toml"))
    assert again.base == file.base
    assert 'k = { start = 0.05, unit = "N/mm" }' in file.text()
    seen: dict[str, Any] = {"__file__": str(tmp_path / "study.py")}
    exec(file.script().partition("study = study_file")[0], seen)
    assert seen["data"].digest == file.measurements().digest


def test_times_of_a_study_file_are_in_the_unit_of_the_times(tmp_path: Path) -> None:
    text = 'k = { start = 50, unit = "N/m" }\nm = { value = 2.5, unit = "kg" }'
    path = written(tmp_path, swings(MM, 1e-3, 1e3), MM, text)
    path.write_text(path.read_text().replace("share = 0.3", "after = 3000"))
    train, held_out = ph.StudyFile.read(path).split()
    assert held_out is not None
    assert train.stacked("t").max() == pytest.approx(2.98)
    assert held_out.stacked("t").min() == pytest.approx(3.0)


def test_without_a_unit_of_the_time_nothing_is_converted_in_silence(tmp_path) -> None:
    units = {"q": "mm", "t": ""}
    found = complaints(written(tmp_path, swings(MM, 1e-3), units, "k = 50\nm = 2.5"))
    assert list(found) == ["data.time.unit"]


def test_a_unit_that_is_not_known_cannot_be_converted(tmp_path: Path) -> None:
    data = swings(MM, 1e-3, 1e3)
    text = 'k = { start = 50, unit = "N/foo" }\nm = { start = 2.5 }'
    found = complaints(written(tmp_path, data, MM, text))
    assert 'parameters.k.unit = "N/foo"' in found["parameters.k.unit"]
    text = 'k = { start = 50, unit = "N" }\nm = { value = 2.5, unit = "kg" }'
    found = complaints(written(tmp_path, data, MM, text))
    assert "N/m" in found["parameters.k.unit"]


def circuit(of_charge: str) -> UnitCheck:
    model = ph.FirstOrder(
        ["i", "q"],
        {
            "i": ph.formula(
                "(u - R*i - q/C)/L",
                R=ph.Parameter(4.0, unit="Ohm"),
                C=ph.Parameter(2e-5, unit="F"),
                L=0.01,
            ),
            "q": ph.formula("i"),
        },
        inputs=["u"],
    )
    return UnitCheck(model, {"t": "s", "i": "A", "q": of_charge, "u": "V"})


def test_a_charge_in_c_is_in_coulombs_and_contradicts_no_farad() -> None:
    circuit("C").refuse()
    circuit("A s").refuse()
    with pytest.raises(ph.ModelError, match="q in V"):
        circuit("V").refuse()


def test_a_temperature_in_c_contradicts_no_kelvin() -> None:
    known = {"k": ph.Parameter(1.0, unit="W/K"), "c": ph.Parameter(1.0, unit="J/K")}
    loss = ph.formula("-k*T/c", **known)
    UnitCheck(ph.FirstOrder(["T"], {"T": loss}), {"t": "s", "T": "C"}).refuse()


@pytest.mark.parametrize(
    "unit", ["9**9**9", "(9)**(9)**(9)", "9^9^9", "m**9**9**9", "9⁹⁹⁹⁹⁹⁹"]
)
def test_a_power_of_a_number_is_no_unit_and_not_worked_out(unit: str) -> None:
    found = measure_of(unit)
    assert found is None or set(found.powers) - {"m"}
