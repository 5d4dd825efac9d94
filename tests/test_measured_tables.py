"""The measured sets that are tables are read by one short call each."""

from typing import Any

import numpy as np
import pytest

from phsi_opt.data.measurements import Measurements
from problems.tools.data_paths import folder

# By file: which column is what, its samples, its last time.
TABLES: dict[str, tuple[dict[str, Any], int, float]] = {
    "ball_and_hoop/fixedStepSequence.mat": ({"time": "time", "states": {"v": "y"}, "inputs": ["u"]}, 2150, 214.9),
    "emps/DATA_EMPS.mat": ({"time": "t", "states": {"q": "qm", "p": None}, "inputs": {"u": "vir"}}, 24841, 24.84),
    "coupled_drives/drive.mat": ({"step": 0.02, "states": {"z": "z1"}, "inputs": {"u": "u1"}}, 500, 9.98),
    "quarter_drone/sinal2_degraus_malha_fechada.csv": (
        {"time": "Tempo_s", "states": {"q": "Saida_y"}, "inputs": {"u": "Controle_u"}, "between": (20, 80)}, 6001, 80.0
    ),
    "silverbox/SNLS80mV.csv": (
        {"step": 1 / 610.35, "states": {"q": "V2"}, "inputs": {"u": "V1"}}, 131072, 131071 / 610.35
    ),
    "cascaded_tanks/dataBenchmark.csv": ({"step": 4, "states": {"h": "yEst"}, "inputs": {"u": "uEst"}}, 1024, 4092.0),
    "torque_pendulum/data_measured.csv": (
        {"time": "time", "states": {"q": "position", "v": "velocity"}, "inputs": {"u": "torque"}}, 1170, 3.89782
    ),
    "building/blg_1.csv": (
        {"time": "t", "states": {"T": "yTi"}, "inputs": ["Ps", "Ta", "Thm"]}, 4181, 4180 * 900.0
    ),
    "heaters/tclab.txt": ({"time": 0, "states": {"T1": 3, "T2": 4}, "inputs": {"u1": 1, "u2": 2}}, 599, 598.9),
    "battery_cell/hppc_25c.csv": (
        {"time": "Time(s)", "states": {"V": "Voltage(V)"}, "inputs": {"i": "Current(A)"}}, 13248, 58968.2
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_a_measured_table_is_read_by_a_short_call(name: str) -> None:
    path = folder(name)
    if not path.exists():
        pytest.skip(f"the measurements are not at {path}; set PHSI_OPT_DATA")
    columns, n_samples, end = TABLES[name]
    part = columns.get("between", (None, None))
    columns = {key: value for key, value in columns.items() if key != "between"}
    read = Measurements.from_mat if path.suffix == ".mat" else Measurements.from_csv
    data = read(path, **columns).between(*part)
    assert data.n_samples == n_samples
    # The last lines of the files are written here with five digits.
    assert data.trajectories[0].t[-1] == pytest.approx(end, rel=1e-5)
    for run in data:
        assert np.isfinite(run.x).any(axis=1).all()
