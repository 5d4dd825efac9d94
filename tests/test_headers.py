"""Units that the names of columns tell are those of the channels, in every reader."""

import pandas as pd
import pytest

import phsi_opt as ph

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


def test_units_that_are_given_count_and_an_empty_one_is_none() -> None:
    states = {"x": "position_mm"}
    units = {"x": "", "t": "s"}
    data = ph.Measurements.from_dataframe(
        TABLE, time="t_ms", states=states, units=units
    )
    assert dict(data.units) == units


def test_a_column_of_times_without_a_unit_has_none() -> None:
    table = TABLE.rename(columns={"t_ms": "t_mm"})
    data = ph.Measurements.from_dataframe(table, time="t_mm", states={"n": "count"})
    assert data.units["t"] == ""
