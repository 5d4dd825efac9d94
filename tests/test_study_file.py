"""The study file: what it says becomes data, model and study, and goes back into text."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

import phsi_opt as ph
from phsi_opt.model.parameters import Share, Tried
from phsi_opt.study_file.toml_text import add_effects, toml_value
from problems.examples.friction_spring import CSV

SPRING = """
# my notes: the spring of the bench
[data]
files = ["spring.csv"]
trajectory = "run"
time = { column = "t_s", unit = "s" }

[data.states]
q = { column = "position_m", unit = "m" }
p = { measured = false, unit = "kg m/s" }

[held_out]
share = 0.4

[model]
states = ["q", "p"]
pairs = [["q", "p"]]
H = "k*q**2/2 + p**2/(2*m)"
R = { p = "c" }

[parameters]
m = 2.5  # weighed
k = { start = 10.0, lower = 0, unit = "N/m" }
c = { lower = 0 }

[study]
added = []  # none yet
"""


@pytest.fixture
def spring(tmp_path: Path) -> Path:
    (tmp_path / "spring.csv").write_bytes(CSV.read_bytes())
    path = tmp_path / "study.toml"
    path.write_text(SPRING)
    return path


def changed(path: Path, *changes: tuple[str, str]) -> Path:
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def complaints(path: Path) -> dict[str, str]:
    """What is wrong with a file, by key."""
    with pytest.raises(ph.StudyFileError) as caught:
        ph.StudyFile.read(path)
    assert str(path) in str(caught.value)
    return {one.key: str(one) for one in caught.value.complaints}


# ---- reading -------------------------------------------------------------------------


def test_a_study_file_is_the_data_and_the_model_that_a_user_would_write(spring) -> None:
    file = ph.StudyFile.read(spring)
    by_hand = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula(
            "k*q**2/2 + p**2/(2*m)", m=2.5, k=ph.Parameter(10.0, lower=0, unit="N/m")
        ),
        R={"p": ph.formula("c", c=ph.Parameter(lower=0))},
    )
    assert file.model() == by_hand
    assert list(file.model().entries) == ["m", "k", "c"]
    data = ph.Measurements.from_csv(
        CSV,
        time="t_s",
        trajectory="run",
        states={"q": "position_m", "p": None},
        units={"t": "s", "q": "m", "p": "kg m/s"},
    )
    assert file.measurements().digest == data.digest
    assert dict(file.measurements().units) == dict(data.units)
    train, held_out, final = file.parts()
    assert held_out is not None and final is not None
    first, others = data.split(0.6)
    parts = (first, others[:-1], others[-1:])
    assert [one.digest for one in (train, held_out, final)] == [p.digest for p in parts]


def test_a_part_of_the_time_can_be_held_out(spring: Path) -> None:
    file = ph.StudyFile.read(changed(spring, ("share = 0.4", "after = 3.0")))
    train, held_out, final = file.parts()
    assert held_out is not None and final is not None
    assert (len(train), len(held_out), len(final)) == (8, 7, 1)
    assert max(run.t[-1] for run in train) < 3.0
    assert min(run.t[0] for run in [*held_out, *final]) == 3.0
    n_samples = train.n_samples + held_out.n_samples + final.n_samples
    assert n_samples == file.measurements().n_samples


@pytest.mark.parametrize(("n_runs", "section", "numbers"), [
    (8, "share = 0.4", ([0, 1, 2, 3, 4], [5, 6], [7])),
    (3, "share = 0.4", ([0], [1], [2])),
    (3, 'runs = ["run 2"]', ([0], [1], [2])),
    (2, "share = 0.4", ([0], [1], None)),
    (8, 'runs = ["run 2", "run 4"]', ([0, 2, 4, 5, 6, 7], [1], [3])),
    (8, "share = 0.4\n[final]\nruns = []", ([0, 1, 2, 3, 4], [5, 6, 7], None)),
    (8, "share = 0.5\n[final]\nshare = 0.25", ([0, 1, 2], [3, 4, 5], [6, 7])),
    (8, 'share = 0.5\n[final]\nruns = ["run 1"]', ([1, 2, 3, 4], [5, 6, 7], [0])),
])  # fmt: skip
def test_of_three_runs_one_is_kept_for_the_end(
    spring: Path, n_runs: int, section: str, numbers: tuple[list[int] | None, ...]
) -> None:
    table = pd.read_csv(CSV)
    runs = list(dict.fromkeys(table["run"]))
    table[table["run"].isin(runs[:n_runs])].to_csv(
        spring.parent / "spring.csv", index=False
    )
    file = ph.StudyFile.read(changed(spring, ("share = 0.4", section)))
    told = []
    for part in file.parts():
        told.append(part and [runs.index(run.name) for run in part])
    assert tuple(told) == numbers
    names = [
        None if part is None else [*map(runs.__getitem__, part)] for part in numbers
    ]
    again = ph.StudyFile.read(file.write(spring.parent / "again.toml"))
    assert [part and [run.name for run in part] for part in again.parts()] == names


def test_times_may_be_cut_counted_or_dates(spring: Path) -> None:
    whole = ph.StudyFile.read(spring).measurements()
    empty = 'columns = []\nsheet = ""\n'  # counts as left out
    cut = changed(
        spring, ("[data.states]", f"{empty}between = [1.0, 2.0]\n[data.states]")
    )
    data = ph.StudyFile.read(cut).measurements()
    assert all(run.t[0] == 1.0 and run.t[-1] == 2.0 for run in data)
    steps = changed(cut, ('column = "t_s"', "step = 0.025"), ("between", "# between"))
    counted = ph.StudyFile.read(steps).measurements()
    for run, other in zip(counted, whole, strict=True):
        np.testing.assert_allclose(run.t, other.t, atol=1e-12)
    table = spring.with_name("spring.csv")
    table.write_text(
        "run,t_s,position_m\na,2020-02-28 23:59:00,1\na,2020-02-29 00:00:30.5,2\n"
        "a,2020-03-01 00:00:00,3\nb,2020-03-01 00:00:01,3\nb,2020-03-01 00:00:02,4\n"
    )
    dates = changed(steps, ("step = 0.025", 'column = "t_s", start = "2020-02-28"'))
    file = ph.StudyFile.read(dates)
    times = np.concatenate([run.t for run in file.measurements()])
    assert times.tolist() == [86340, 86430.5, 172800, 172801, 172802]
    again = ph.StudyFile.read(file.write(spring.with_name("again.toml")))
    assert again.measurements().digest == file.measurements().digest
    table.write_text(table.read_text().replace("2020-03-01 00:00:02", "monday"))
    assert "line 6" in str(complaints(dates))
    days = "".join(f"a,{day}.2020,1\n" for day in ("28.02", "29.02", "01.03", "02.03"))
    table.write_text(f"run,t_s,position_m\n{days}")
    form = ('start = "2020-02-28"', 'date_format = "%d.%m.%Y"')
    (run,) = ph.StudyFile.read(changed(dates, form)).measurements()
    assert run.t.tolist() == [0, 86400, 172800, 259200]


OTHER_KINDS = {  # the columns of t, y and u, and what else the data need
    "txt": ("0", "1", "2", 'decimal = ","'),
    "xlsx": ('"t"', '"y"', '"u"', 'sheet = "bench"'),
    "mat": ('"log.t"', '"X(:,1)"', '"X(:,2)"', ""),
}


@pytest.mark.parametrize("suffix", OTHER_KINDS)
def test_tables_of_other_kinds_are_read_and_their_script_reads_them_too(
    tmp_path: Path, suffix: str
) -> None:
    numbers = np.column_stack([np.arange(20) / 4, np.sin(np.arange(20)), np.ones(20)])
    table = tmp_path / f"data.{suffix}"
    if suffix == "txt":
        lines = [" ".join(f"{one:.17g}" for one in row) for row in numbers]
        table.write_text("\n".join(lines).replace(".", ","))
    elif suffix == "xlsx":
        frame = pd.DataFrame(numbers, columns=["t", "y", "u"])
        with pd.ExcelWriter(table) as writer:
            for sheet in ("bench", "other"):
                frame.to_excel(writer, sheet_name=sheet, index=False)
    else:
        savemat(table, {"log": {"t": numbers[:, 0]}, "X": numbers[:, 1:]})
    t, y, u, more = OTHER_KINDS[suffix]
    path = tmp_path / "study.toml"
    path.write_text(f"""
[data]
files = "data.{suffix}"
between = [0.5, 4.0]
thinned = 2
time = {{ column = {t} }}
states = {{ x = {{ column = {y} }} }}
inputs = {{ u = {{ column = {u}, hold = "zero" }} }}
{more}
[model]
type = "FirstOrder"
states = ["x"]
inputs = ["u"]
F = {{ x = "-a*x + u" }}
[parameters]
a = {{ start = 1.0 }}
""")
    file = ph.StudyFile.read(path)
    data = file.measurements()
    (run,) = data.trajectories
    assert run.t.tolist() == [0.625 + 0.5 * k for k in range(7)]
    expected = numbers[2:16, 1].reshape(7, 2).mean(axis=1)
    np.testing.assert_allclose(run.x[:, 0], expected, rtol=1e-14)
    again = ph.StudyFile.read(file.write(tmp_path / "again.toml"))
    assert again.data == file.data and data.hold == "zero"
    seen: dict[str, Any] = {"__file__": str(tmp_path / "study.py")}
    exec(file.script().partition("study = study_file")[0], seen)
    assert seen["data"].digest == data.digest and seen["data"].hold == "zero"
    path.write_text(path.read_text().replace(f"column = {y}", "column = 77"))
    assert complaints(path)


def test_a_script_of_dates_in_fahrenheit_computes_in_si_with_the_hold_that_was_chosen(
    tmp_path: Path,
) -> None:
    times = [f"2026-01-{day:02},{60 + day},{day % 3}" for day in range(1, 9)]
    (tmp_path / "room.csv").write_text("when,T,P\n" + "\n".join(times) + "\n")
    path = tmp_path / "study.toml"
    path.write_text("""
[data]
files = "room.csv"
time = { column = "when" }
states = { T = { column = "T", unit = "degF" } }
inputs = { P = { column = "P", unit = "W" } }
[model]
type = "FirstOrder"
states = ["T"]
inputs = ["P"]
F = { T = "P/C" }
[parameters]
C = { start = 1e5, unit = "J/K" }
""")
    file = ph.StudyFile.read(path).with_hold({"P": "zero"})
    again = ph.StudyFile.read(file.write(tmp_path / "again.toml"))
    data = again.measurements()
    seen: dict[str, Any] = {"__file__": str(tmp_path / "study.py")}
    exec(again.script().partition("study = study_file")[0], seen)
    assert seen["data"].digest == data.digest and data.units["T"] == "degC"
    assert seen["data"].hold == data.hold == "zero"
    assert again.with_hold("linear").measurements().hold == "linear"


def test_terms_may_be_polynomials_and_waves(spring: Path) -> None:
    changed(
        spring,
        (
            'R = { p = "c" }',
            'F = { p = [{ trigonometric = "t", n = 2, frequency = 3.0 }, { body = "1" }] }',
        ),
        ('"k*q**2/2 + p**2/(2*m)"', '{ polynomials = ["q", "p"], degree = 2 }'),
        ("m = 2.5  # weighed", ""),
        ('k = { start = 10.0, lower = 0, unit = "N/m" }', ""),
        ("c = { lower = 0 }", ""),
    )
    model = ph.StudyFile.read(spring).model()
    assert ph.polynomials(["q", "p"], degree=2) == model.H
    constant = ph.polynomials(["q"], degree=1, constant=True).terms[0]
    assert model.F["p"].terms == (*ph.trigonometric("t", 2, 3.0).terms, constant)


def test_nothing_of_a_study_file_runs(spring: Path, tmp_path: Path) -> None:
    canary = tmp_path / "ran"
    attack = f"__import__('pathlib').Path('{canary}').touch()"
    path = changed(spring, ('R = { p = "c" }', f'R = {{ p = "c + {attack}" }}'))
    assert "is not known" in complaints(path)["model.R.p"]
    assert not canary.exists()


def test_the_study_of_a_file_takes_its_effects_one_after_the_other(spring) -> None:
    path = changed(
        spring,
        ('k = { start = 10.0, lower = 0, unit = "N/m" }', "k = 50.0"),
        ("c = { lower = 0 }", "c = 0.8"),
        ("[]  # none yet", "[]"),
        ("[data.states]", "between = [0.0, 1.0]\n[data.states]"),
    )
    file = ph.StudyFile.read(path).with_added("constant force on p")
    assert file.steps.max_steps == 4
    for name, said in (("constant force on p", "already"), ("rain on p", "rain")):
        with pytest.raises(ph.ModelError, match=said):
            file.with_added(name)
    told: list[list[str]] = []
    said_of: list[str] = []
    study = file.study(
        said_of.append, after_each=lambda one: told.append(list(map(str, one.added)))
    )
    assert told == [[], ["constant force on p"]]
    assert study.model.free == file.model().free
    assert said_of and study.record.title == "Study of spring.csv"
    parts = file.parts()
    digests = [
        part and part.digest for part in (study.train, study.held_out, study.final)
    ]
    assert digests == [part and part.digest for part in parts]


# ---- refusals ------------------------------------------------------------------------


def test_everything_that_is_wrong_is_told_at_once(spring: Path) -> None:
    path = changed(
        spring,
        ("trajectory =", "trajectry ="),
        ('unit = "m" }', "unit = 3 }"),
        ("share = 0.4", 'share = 0.4\nruns = ["run 1"]'),
        ("k*q**2/2", "kk*q**2/2"),
        ('p = "c"', 'z = "c"'),
        ("lower = 0, unit", "lower = 20, unit"),
        ("added = []", "added = []\n[loss]\nhuber = -1"),
    )
    found = complaints(path)
    assert set(found) == {
        *("data.trajectry", "data.states.q.unit", "held_out", "model.H", "model.R.z"),
        *("parameters.k", "loss.huber"),
    }
    assert "Did you mean 'k'?" in found["model.H"]
    assert "expected one of q, p" in found["model.R.z"]
    said = "held_out: expected exactly one of runs or share or after; found runs and "
    assert said in found["held_out"]
    assert "outside its bounds" in found["parameters.k"]


@pytest.mark.parametrize(("old", "new", "key", "said"), [
    ("[data]", "[date]", "date", "Did you mean 'data'?"),
    ("[data]", "[data", "", "this is not TOML"),
    ('files = ["spring.csv"]', "", "data.files", "expected the data file"),
    ('files = ["spring.csv"]', "files = []", "data.files", "line 4: data.files: expected the data file"),
    ("time = {", "# {", "data.time.column", "expected the column of the times"),
    ('"spring.csv"', '"sprung.csv"', "data.files", "there is no such file"),
    ('["spring.csv"]', '["spring.csv", "spring.csv"]', "data.files", "is listed 2 times"),
    ("q = { column", "Q = { column", "data.states.q", "Did you mean 'Q'?"),
    ("measured = false, ", "", "data.states.p.column", "or measured = false"),
    ("measured = false", "measured = 1", "data.states.p.measured", "true or false"),
    ("share = 0.4", 'runs = ["run 11"]', "held_out.runs", "Did you mean 'run 1'?"),
    ("share = 0.4", "after = 99", "held_out", "0 samples between 99 and inf; expected at least 2"),
    ("share = 0.4", "", "held_out", "found none"),
    ('H = "k', 'H = ""  #', "model.H", "expected the energy as a formula"),
    ('"k*q**2/2', '"k*q^2/2', "model.H", "Write a power as **"),
    ('p**2/(2*m)"', 'p**2/(2*m) + t"', "model.H", "an energy depends only on the " "states"),
    ('[["q", "p"]]', '[["q", "v"]]', "model.pairs", "not a state"),
    ('[["q", "p"]]', '["q", "p"]', "model.pairs", "expected pairs of states"),
    ("pairs =", "S = [[0, 1], [1, 0]]  #", "model", "not skew-symmetric"),
    ("pairs =", "#", "model", "exactly one of pairs or S"),
    ('["q", "p"]\npairs', '["q", "q", "p"]\npairs', "model.states", "twice"),
    ('["q", "p"]\npairs', '["q", "p-1"]\npairs', "model.states", "cannot be used"),
    ("c = {", "d = {", "model.R.p", "c = { start = 1.0 }"),
    ("c = {", "x = 1\nc = {", "parameters.x", "no formula contains this name"),
    ("start = 10.0", "start = 1.0, value = 2", "parameters.k.value", "start is given, too"),
    ("start = 10.0", "start = nan", "parameters.k", "not finite"),
    ("{ lower = 0 }", "{ guess = { kind = 'Sha' } }", "parameters.c.guess.kind", "'Share'"),
    ("{ lower = 0 }", "{ guess = { kind = 'Share' } }", "parameters.c.guess.of", "needs this key"),
    ("[data.states]", "between = [5]\n[data.states]", "data.between", "two times"),
    ("[data.states]", "between = [6, 9]\n[data.states]", "data", "0 samples"),
    ("added = []", 'without = ["gep on p"]', "study.without", "Did you mean 'gap on p'?"),
    ("added = []", "max_steps = 0", "study.max_steps", "at least 1"),
    ("[study]", "[loss]\nstart = 2\n[study]", "loss.start", "Did you mean 'starts'?"),
    ("[study]", "[loss]\nhuber = 1\nmodel_error = true\n[study]", "loss", "outliers"),
    ("[study]", "[[effects]]\nname = 'a'\n[study]", "effects[0].slot", "needs this key"),
])  # fmt: skip
def test_a_wrong_value_is_refused_by_its_key(spring, old, new, key, said) -> None:
    found = complaints(changed(spring, (old, new)))
    assert said in found[key]


def test_a_fault_is_told_with_its_line_and_a_missing_key_with_that_of_its_table(
    spring: Path,
) -> None:
    path = changed(
        spring,
        ("trajectory =", "trajectry ="),
        ('unit = "m" }', "unit = 3 }"),
        ('H = "k*q**2/2 + p**2/(2*m)"\n', ""),
        ("[study]", "[[effects]]\nname = 'a'\n[[effects]]\nslot = 'G'\n[study]"),
    )
    with pytest.raises(ph.StudyFileError) as caught:
        ph.StudyFile.read(path)
    lines = path.read_text().splitlines()
    told = {one.key: one.line or 0 for one in caught.value.complaints}
    for key, written in (
        ("data.trajectry", "trajectry ="),
        ("data.states.q.unit", "q = { column"),
        ("model.H", "[model]"),
        ("effects[0].slot", "[[effects]]"),
        ("effects[1].slot", "slot = 'G'"),
    ):
        assert lines[told[key] - 1].startswith(written)
    assert f"line {told['model.H']}: model.H: expected" in str(caught.value)


def test_what_a_model_does_not_use_and_has_no_unit_is_told(spring: Path) -> None:
    from phsi_opt.study_file.survey import unfilled

    forces = "model.F: no forces, such as F = { p = "
    assert [one[: len(forces)] for one in unfilled(spring)] == [forces]
    changed(
        spring,
        ('states = ["q", "p"]', 'states = ["q", "p"]\ninputs = ["u", "w"]'),
        ("p**2/(2*m)", "p**2/(2*m) - u*q"),
        (', unit = "m"', ""),
    )
    idle, units = unfilled(spring)[1:]
    assert idle == "model.inputs: no formula contains w"
    assert units.startswith("units: no unit is given for q (such as")


# ---- writing -------------------------------------------------------------------------


def test_a_file_that_was_written_reads_as_what_it_was_written_from(spring) -> None:
    file = ph.StudyFile.read(changed(spring, ("[]", '["coulomb friction on p"]')))
    other = spring.parent / "deeper"
    other.mkdir()
    again = ph.StudyFile.read(file.write(other / "copy.toml"))
    assert again.data.files == ("../spring.csv",)
    assert "\ninputs =" not in file.text() and "\nmemory" not in file.text()
    assert again.measurements().digest == file.measurements().digest
    assert replace(again, data=file.data, folder=file.folder) == file
    assert again.model() == file.model()


def everything() -> ph.PseudoHamiltonian:
    """A model with all that a study file can hold."""
    return ph.PseudoHamiltonian(
        states=["x 1".replace(" ", "_"), "v", "T", "lag"],
        inputs=["u"],
        S=[[0, 0.5, 0, 0], [-0.5, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]],
        H=ph.polynomials(["x_1"], degree=2) + ph.formula("T**2/C", C=3.0),
        R=ph.damping("v"),
        F={
            "v": ph.formula("g*lag", g=ph.Parameter(1.0, per_trajectory=True))
            + ph.trigonometric("t", n=2),
            "T": ph.formula(
                "w*u*tanh(v/v0)",
                w=ph.Parameter(guess=Tried("v", (0.1, 0.5), 2.0), lower=0),
                v0=ph.Parameter(fixed=True, guess=Share("v", 0.06, (0.25,))),
            ),
            "lag": ph.formula("(u - lag)/tau", tau=ph.Parameter(0.3, 0.01, 5, "s")),
        },
        sensor={"T": ph.formula("b", b=ph.Parameter(0.0, unit='deg "C"'))},
        memory=["lag"],
        kind={"T": "thermal"},
    )


def everything_measured() -> ph.Measurements:
    rng = np.random.default_rng(1)
    t = np.arange(12) / 3
    x = rng.normal(size=(12, 3))
    x[:, 1] = np.nan
    x[3, 2] = np.nan
    runs = [x, x + 1, x + 2]
    return ph.Measurements.from_arrays(
        [t] * 3,
        runs,
        [t, t, t],
        states=["x_1", "v", "T"],
        inputs=["u"],
        names=["one", 'two, "again"', "three"],
        units={"T": "degC", "t": "s"},
        noise={"T": 0.1},
        hold="zero",
    )


def own_effect() -> ph.Effect:
    return ph.Effect(
        "wind", "F", "v", ph.formula("a*v**2", a=ph.Parameter(0.1, unit="1/m"))
    )


def test_a_model_and_measurements_become_a_study_file_and_come_back(tmp_path) -> None:
    data = everything_measured()
    loss = ph.MaximumLikelihood(huber=1.5, starts=2)
    file = ph.StudyFile.of(
        everything(),
        data[:2],
        data[2:],
        loss=loss,
        own_effects=(own_effect(),),
        without=("harmonic force",),
    )
    again = ph.StudyFile.read(file.write(tmp_path / "study.toml"))
    assert again.base == everything()
    assert list(again.base.entries) == list(everything().entries)
    assert again.measurements().digest == data.digest
    train, held_out = again.split()
    assert held_out is not None
    assert [train.digest, held_out.digest] == [data[:2].digest, data[2:].digest]
    assert dict(train.units) == dict(data.units)
    assert train.noise == data.noise
    assert again.loss == loss
    assert again.own_effects == (own_effect(),)
    considered = again.effects()
    assert considered is not None and considered[-1] == own_effect()
    assert considered[:-1] == list(map(str, ph.catalogue(again.base, data.units)))
    assert again.steps.without == ("harmonic force",)
    file.write(tmp_path / "study.toml")  # the same table is no other file
    parts = data[:1].split(0.5)
    file = ph.StudyFile.of(everything(), *parts)
    again = ph.StudyFile.read(file.write(tmp_path / "one.toml"))
    for one, part in zip(again.split(), parts, strict=True):
        assert one is not None
        np.testing.assert_array_equal(one.stacked("x"), part.stacked("x"))
    assert [run.name for run in again.measurements()] == ["one", "one held out"]


def test_what_a_study_file_cannot_hold_is_refused_by_name(tmp_path: Path) -> None:
    data = everything_measured()
    with pytest.raises(ph.ModelError, match="noise="):
        ph.StudyFile.of(everything(), data, loss=ph.MaximumLikelihood(noise={"T": 1.0}))
    clash = ph.Effect("wind", "F", "v", ph.formula("g*v", g=ph.Parameter(2.0)))
    with pytest.raises(ph.ModelError, match="'g' of an effect differs"):
        ph.StudyFile.of(everything(), data, own_effects=(clash,))
    with pytest.raises(ph.ModelError, match="model=None"):
        ph.StudyFile.of(None, data)  # type: ignore[arg-type]
    in_mm = replace(data, units={"x_1": "mm", "t": "ms"})
    with pytest.raises(ph.DataError, match=r"the data are in ms, mm, and .*in_si\(\)"):
        ph.StudyFile.of(everything(), in_mm)
    with pytest.raises(ph.DataError, match="held out' is a copy of"):
        ph.StudyFile.of(everything(), data[:2], data[1:]).parts()
    with pytest.raises(ph.DataError, match="units of the data held out"):
        ph.StudyFile.of(everything(), data[:2], replace(data[2:], units={}))
    (tmp_path / "s_measurements.csv").write_text("mine")
    with pytest.raises(ph.DataError, match="exists already"):
        ph.StudyFile.of(everything(), data).write(tmp_path / "s.toml")
    assert (tmp_path / "s_measurements.csv").read_text() == "mine"


@pytest.mark.parametrize("value", [
    'quote " and \\ backslash\n\t\x7f\x00',
    "Grüße 🌍",
    [1, 2.5, -1e-300, 1e300, float("inf")],
    {"a b": {"c.d": [True, False]}, "": "empty"},
    [],
    {},
])  # fmt: skip
def test_values_are_written_so_that_toml_reads_them(value: Any) -> None:
    import tomllib

    assert tomllib.loads(f"x = {toml_value(value)}") == {"x": value}


# ---- the script ----------------------------------------------------------------------


def test_the_script_builds_the_same_model_data_and_effects(tmp_path: Path) -> None:
    data = everything_measured()
    file = ph.StudyFile.of(
        everything(),
        data[:2],
        data[2:],
        loss=ph.MaximumLikelihood(huber=1.5),
        own_effects=(own_effect(),),
        effects=("wind", "harmonic force on v"),
        added=("wind on v",),
    )
    file = ph.StudyFile.read(file.write(tmp_path / "study.toml"))
    script = file.script()
    seen: dict[str, Any] = {"__file__": str(tmp_path / "study.py")}
    exec(script.partition("study = study_file")[0], seen)
    assert seen["model"] == file.base
    assert list(seen["model"].entries) == list(file.base.entries)
    assert seen["data"].digest == data.digest
    assert seen["data"].noise == data.noise
    assert seen["train"].digest == data[:2].digest
    assert seen["held_out"].digest == data[2:].digest
    assert "ph.MaximumLikelihood(huber=1.5)" in script
    assert seen["study_file"] == file


# ---- adding to the text --------------------------------------------------------------


@pytest.mark.parametrize(("before", "after"), [
    ("a = 1\n", 'a = 1\n\n[study] # effects added so far, the oldest first\nadded = ["x on p"]\n'),
    ("[study]\n", '[study]\nadded = ["x on p"]\n'),
    ("[study]", '[study]\nadded = ["x on p"]\n'),
    ("[study] # mine\nadded = [] # none\n", '[study] # mine\nadded = ["x on p"] # none\n'),
    (
        '[study]\nadded = [\n  "a # ] b", # why\n  # "c"\n]\n[loss]\n',
        '[study]\nadded = [\n  "a # ] b", # why\n  # "c"\n  "x on p"\n]\n[loss]\n',
    ),
    ("[study]\r\nadded = ['a']\r\n", "[study]\r\nadded = ['a', \"x on p\"]\r\n"),
    ("[study]\r\nwithout = []\r\n", '[study]\r\nwithout = []\r\nadded = ["x on p"]\r\n'),
    ("[study]\nwithout = []\n[loss]\n", '[study]\nwithout = []\nadded = ["x on p"]\n[loss]\n'),
    ("study = { added = ['a'] } # mine\n", "study = { added = ['a', \"x on p\"] } # mine\n"),
    ("study.added = ['a']\n", "study.added = ['a', \"x on p\"]\n"),
    ("[study]\nadded = 'a' # mine\n", '[study]\nadded = ["a", "x on p"] # mine\n'),
])  # fmt: skip
def test_an_effect_is_written_into_the_text_and_nothing_else_changes(
    tmp_path: Path, before: str, after: str
) -> None:
    path = tmp_path / "study.toml"
    path.write_bytes(before.encode())
    backup = add_effects(path, ["x on p"])
    assert path.read_bytes().decode() == after
    assert backup.read_bytes().decode() == before


@pytest.mark.parametrize("text", ["[[study]]\na = 1\n", "study = 3\n"])
def test_a_form_that_cannot_be_changed_safely_is_refused(tmp_path, text) -> None:
    path = tmp_path / "study.toml"
    path.write_text(text)
    with pytest.raises(ph.DataError, match="nothing was written"):
        add_effects(path, ["x on p"])
    assert path.read_text() == text
    assert sorted(tmp_path.glob("*.bak*")) == []


def test_the_file_as_it_was_is_kept_and_no_backup_is_overwritten(spring: Path) -> None:
    texts = [spring.read_text()]
    spring.chmod(0o640)
    link = spring.with_name("link.toml")
    link.symlink_to(spring)
    for name in ("coulomb friction on p", "gap on p"):
        add_effects(link, [name])
        texts.append(spring.read_text())
    assert spring.with_name("study.toml.bak").read_text() == texts[0]
    assert spring.with_name("study.toml.bak2").read_text() == texts[1]
    assert link.is_symlink()
    assert spring.stat().st_mode & 0o777 == 0o640
    assert "# none yet" in texts[2]
    assert "# weighed" in texts[2]
    assert ph.StudyFile.read(spring).steps.added == (
        "coulomb friction on p",
        "gap on p",
    )
