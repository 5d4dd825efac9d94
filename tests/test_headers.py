"""Units that the names of columns tell are those of the channels, in every reader."""

import pandas as pd
import pytest

import phsi_opt as ph
from phsi_opt.data.headers import Header
from phsi_opt.errors import StudyFileError
from phsi_opt.study_file.study_file import StudyFile

TABLE = pd.DataFrame(
    {
        "t_ms": [0.0, 20.0, 40.0],
        "position_mm": [1.0, 2.0, 3.0],
        "speed [rad/s]": [0.0, 1.0, 0.0],
        "v_m_s": [0.0, 1.0, 0.0],
        "Chamber (degF)": [70.0, 71.0, 72.0],
        "delay_s": [1.0, 2.0, 1.0],
        "count": [1.0, 2.0, 1.0],
    }
)
NAMES = ["x", "w", "v", "T", "d", "n"]
STATES = dict(zip(NAMES, TABLE.columns[1:], strict=True))


def test_units_in_headers_are_those_of_the_channels(tmp_path) -> None:
    path = tmp_path / "log.csv"
    TABLE.to_csv(path, index=False)
    data = ph.Measurements.from_csv(path, time="t_ms", states=STATES)
    told = dict(zip(NAMES, ("mm", "rad/s", "m/s", "degF", "", ""), strict=True))
    assert dict(data.units) == {"t": "ms", **told}
    assert data.in_si().stacked("t").tolist() == pytest.approx([0.0, 0.02, 0.04])
    from_frame = ph.Measurements.from_dataframe(TABLE, time="t_ms", states=STATES)
    assert from_frame.units == data.units


def test_c_behind_a_temperature_is_its_unit_and_else_an_index() -> None:
    headers = ("T_C", "T_amb_C", "temp1_C", "phase_C", "C_C")
    units = ["degC", "degC", "degC", "", ""]
    assert [Header.of(header).unit for header in headers] == units


def test_a_given_unit_is_compared_with_that_of_the_file() -> None:
    def units(**given: str) -> dict[str, str]:
        columns = {name: STATES[name] for name in given if name != "t"}
        columns |= {"n": "count"}
        return dict(
            ph.Measurements.from_dataframe(
                TABLE, time="t_ms", states=columns, units=given
            ).units
        )

    # An empty one is none; another word for the same unit, and one that is not sure.
    for given in ({"x": ""}, {"x": "millimeter"}, {"t": "msec"}, {"w": "1/s"}):
        assert given.items() <= units(**given).items()
    for given, of_file in (
        ({"x": "m"}, "'mm'"),  # of another size
        ({"t": "s"}, "'ms'"),
        ({"x": "N"}, "'mm'"),  # of another dimension
        ({"T": "degC"}, "'degF'"),
        ({"T": "K"}, "'degF'"),
    ):
        ((name, unit),) = given.items()
        said = rf"units: '{name}' has the unit '{unit}', .* data frame is in {of_file};"
        with pytest.raises(ph.DataError, match=said):
            units(**given)


def test_units_of_two_meanings_and_letters_that_may_count_are_left_to_the_user() -> (
    None
):
    table = pd.DataFrame(
        {"t": [0.0, 1], "a (g)": [0.0, 1], "T (F)": [0.0, 1], "p_A": [0.0, 1]}
    )
    units = {"a": "m/s^2", "T": "degF", "p": "bar"}
    states = {"a": "a (g)", "T": "T (F)", "p": "p_A"}
    data = ph.Measurements.from_dataframe(table, time="t", states=states, units=units)
    assert units.items() <= data.units.items()


def test_a_fault_of_a_unit_is_that_of_its_key(tmp_path) -> None:
    (tmp_path / "log.csv").write_text("t [s],force [N]\n0,1\n1,2\n2,4\n")
    (tmp_path / "study.toml").write_text(
        '[data]\nfiles = ["log.csv"]\ntime = { column = "t [s]", unit = "ms" }\n'
        '[data.states]\nf = { column = "force [N]", unit = "mm" }\n'
        '[model]\nstates = ["f"]\nH = "f**2/2"\n'
    )
    with pytest.raises(StudyFileError) as error:
        StudyFile.read(tmp_path / "study.toml")
    keys = [one.key for one in error.value.complaints]
    assert keys[:2] == ["data.time.unit", "data.states.f.unit"]


@pytest.mark.parametrize(("header", "label", "unit"), [
    ("Channel 0 (PXI1Slot5/0)", "Channel 0 (PXI1Slot5/0)", ""),
    ("Strain (Dev1/ai3)", "Strain (Dev1/ai3)", ""),
    ("Level (CH1)", "Level (CH1)", ""),
    ("rate_m_s (gyro)", "rate", "m/s"),
    ("q (gyro)", "q (gyro)", ""),
    ("q ()", "q", ""),
    ("p (mmHg)", "p", "mmHg"),
    ("n [counts]", "n", "counts"),
    ("RH, % (S/N: 1)", "RH", "%"),
    ("x / mm", "x", "mm"),
    ("x / left", "x / left", ""),
    ("T in °C", "T", "°C"),
])  # fmt: skip
def test_a_word_in_brackets_is_a_unit_if_it_is_known(header, label, unit) -> None:
    told = Header.of(header)
    assert (told.label, told.unit) == (label, unit)


def test_a_column_of_times_without_a_unit_has_none() -> None:
    table = TABLE.rename(columns={"t_ms": "t_mm"})
    data = ph.Measurements.from_dataframe(table, time="t_mm", states={"n": "count"})
    assert data.units["t"] == ""
