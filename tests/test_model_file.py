"""A model in a file begins a study: blocks, a study file, or a saved fit."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

import phsi_opt as ph
from phsi_opt.command_line.file_jobs import checked, first_study
from phsi_opt.page.session import Session
from problems.examples.docs_pictures import DRIVE as DIAGRAM

DRIVE = Path(__file__).parent.parent / "docs" / "data" / "drive.csv"
BLOCKS = "\n".join(
    ["[blocks]", *(f'{name} = "{one}"' for name, one in DIAGRAM.items())]
)
KNOWN = """
[parameters]
R = 1.0
L = 0.02
K = 0.3
J1 = { value = 10.0, unit = "kg m^2" }
k = { start = 15.0, lower = 0 }
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copy(DRIVE, tmp_path / "drive.csv")
    return tmp_path


def begun(folder: Path, model: str, table: str = "drive.csv") -> ph.StudyFile:
    """The study file that ``init`` writes, which is valid."""
    study = folder / "study.toml"
    first_study([folder / table], study, True, str(folder / model), draws=False)
    assert "is valid" in checked(study, draws=False).text
    return ph.StudyFile.read(study)


def test_blocks_in_a_file_are_the_model_that_they_are_in_python(folder: Path) -> None:
    (folder / "drive.toml").write_text(BLOCKS + KNOWN)
    file = begun(folder, "drive.toml")
    k = ph.Parameter(15.0, lower=0)
    known = ph.blocks(DIAGRAM, R=1.0, L=0.02, K=0.3, J1=10.0, k=k).model
    assert str(file.base).splitlines()[1:10] == str(known).splitlines()[1:10]
    assert dict(file.base.values) == dict(known.values)
    assert file.data.states["motor"].column == "motor_rad"
    assert file.data.inputs["u"].column == "voltage_V", "the only input"
    assert not file.data.states["p_load"].measured


def test_a_model_of_sympy_comes_by_a_saved_fit(tmp_path: Path) -> None:
    x, v, k, m = sp.symbols("x v k m")
    model = ph.from_sympy([v, -k * x / m], states=[x, v], m=2.0)
    t = np.linspace(0.0, 6.0, 121)
    rng = np.random.default_rng(4)
    values = np.c_[np.cos(1.5 * t), -1.5 * np.sin(1.5 * t)]
    values += 0.01 * rng.standard_normal(values.shape)
    units = {"t": "s", "x": "m", "v": "m/s"}
    data = ph.Measurements.from_arrays(t, values, states=["x", "v"], units=units)
    fit = ph.identify(model, data)
    fit.save(tmp_path / "fit.json")
    header = "t [s],x [m],v [m/s]"
    table = np.c_[t, values]
    np.savetxt(tmp_path / "table.csv", table, "%.6g", ",", header=header, comments="")
    file = begun(tmp_path, "fit.json", "table.csv")
    assert str(file.base).splitlines()[:5] == str(model).splitlines()[:5]
    assert file.base.values["k"] == pytest.approx(fit.values["k"])
    assert file.base.values["k"] == pytest.approx(4.5, rel=0.01)
    assert file.base.free == ("k",)
    assert file.data.states["v"].unit == "m/s"


def test_the_model_of_a_study_is_taken_to_another_record(folder: Path) -> None:
    (folder / "drive.toml").write_text(BLOCKS + KNOWN)
    known = begun(folder, "drive.toml")
    (folder / "study.toml").rename(folder / "other.toml")
    file = begun(folder, "other.toml")
    assert str(file.base) == str(known.base)
    assert file.data.states["motor"].unit == "rad"


def test_columns_find_states_by_their_very_names_first(tmp_path: Path) -> None:
    rates = '{ Q = "-a*Q", q = "-a*q", m_1 = "-a*m_1 + F_1" }'
    model = f"""[model]
type = "FirstOrder"
states = ["Q", "q", "m_1", "lag"]
memory = ["lag"]
inputs = ["F_1"]
F = {rates[:-2]}, lag = "(F_1 - lag)/0.1" }}
[parameters]
a = {{ start = 1.0 }}
b = {{ start = 0.1 }}
[[effects]]
name = "own"
slot = "F"
equation = "q"
term = "-b*q**3"
"""
    (tmp_path / "model.toml").write_text(model)
    table = np.random.default_rng(0).standard_normal((40, 5))
    table[:, 0] = np.arange(40)
    header = "t_s,q,Q,M 1,f_1"
    np.savetxt(tmp_path / "table.csv", table, "%.6g", ",", header=header, comments="")
    file = begun(tmp_path, "model.toml", "table.csv")
    columns = {name: one.column for name, one in file.data.states.items()}
    assert columns == {"Q": "Q", "q": "q", "m_1": "M 1"}
    assert file.data.inputs["F_1"].column == "f_1"
    assert file.base.memory == ("lag",) and file.base.free == ("a",)


def test_an_input_without_a_column_is_said_to_lack_one(folder: Path) -> None:
    (folder / "drive.toml").write_text(BLOCKS + KNOWN)
    lines = DRIVE.read_text().splitlines()
    kept = [",".join(np.array(line.split(","))[[0, 2, 3]]) for line in lines]
    (folder / "less.csv").write_text("\n".join(kept))
    study = folder / "study.toml"
    first_study([folder / "less.csv"], study, True, str(folder / "drive.toml"), False)
    told = checked(study, draws=False).text
    assert 'data.inputs.u: the model has this name: give { column = "..." }.' in told


def test_the_values_of_a_fit_keep_the_units_in_which_they_were_fitted(
    tmp_path: Path,
) -> None:
    t = np.arange(0.0, 6000.0, 50.0)
    x = np.c_[np.exp(-t / 2000)] + 0.001 * np.random.default_rng(1).standard_normal(
        (120, 1)
    )
    units = {"t": "ms", "x": "mm"}
    data = ph.Measurements.from_arrays(t, x, states=["x"], units=units)
    model = ph.FirstOrder(["x"], {"x": "-a*x"})
    ph.identify(model, data).save(tmp_path / "fit.json")
    table = np.c_[t / 1000, x / 1000]
    header = "t [s],x [m]"
    np.savetxt(tmp_path / "si.csv", table, "%.6g", ",", header=header, comments="")
    file = begun(tmp_path, "fit.json", "si.csv")
    assert file.base.values["a"] == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.toml", "", 'model: expected [model], or [blocks] such as m = "mass: x".'),
        ("a.toml", "[blocks", "this is not TOML"),
        ("a.toml", '[blocks]\nm = "mass"', "mass"),
        ("a.toml", "[blocks]\nm = 3", "blocks"),
        ("a.toml", BLOCKS + "\n[parameters]\nX = 1.0", "'X'"),
        ("a.toml", BLOCKS + '\n[parameters]\nk = "stiff"', "parameters.k"),
        ("a.toml", '[model]\nstates = ["q"]\nH = "q**2/2 + z"', "'z' is not known"),
        ("a.toml", "data = 5", "expected [model]"),
        ("a.json", "{}", "a.json"),
        ("none.toml", None, "there is no such file"),
    ],
)
def test_a_file_without_a_valid_model_is_refused_by_name(
    folder: Path, name: str, text: str | None, told: str
) -> None:
    if text is not None:
        (folder / name).write_text(text)
    with pytest.raises(ph.DataError) as raised:
        first_study(
            [folder / "drive.csv"], folder / "study.toml", False, str(folder / name)
        )
    assert told in str(raised.value) and name in str(raised.value)
    assert not (folder / "study.toml").exists()


def test_the_page_takes_the_file_of_a_model_beside_a_table(folder: Path) -> None:
    session = Session(folder / "state")
    try:
        assert session.upload("drive.csv", DRIVE.read_bytes()), session.upload_error
        known = (BLOCKS + KNOWN).encode()
        assert session.upload("drive.toml", known), session.upload_error
        model = session.draft.model
        assert model.names("states")[:2] == ["motor", "load"]
        assert model.title == "drive.toml"
        assert session.check() == ()
        assert not session.upload("wrong.toml", b'[blocks]\nm = "mass"')
        assert "wrong.toml: " in session.upload_error
        assert session.draft.model.names("states")[:2] == ["motor", "load"]
    finally:
        session.close()
