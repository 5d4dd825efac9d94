"""Typical mistakes: each message has place, value, expected and repair, in one line."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import phsi_opt as ph
from phsi_opt.command_line.app import app
from phsi_opt.transcription.grid import AlignedData

MOST_LETTERS = 300
T = np.linspace(0.0, 5.0, 51)
X = np.column_stack([np.cos(1.5 * T), -1.5 * np.sin(1.5 * T)])
K = ph.Parameter(2.0, lower=0)
ENERGY = "k*q**2/2 + p**2/2"
EXAMPLE = Path(ph.__file__).parent / "study_file" / "examples" / "spring"
FRAME: Any = pd.DataFrame({"t": T, "q": X[:, 0], "p": X[:, 1]})


def spring(**changes: Any) -> Any:
    energy = ph.formula(ENERGY, k=K)
    parts: dict[str, Any] = {"states": ["q", "p"], "S": ph.canonical(1), "H": energy}
    return ph.PseudoHamiltonian(**parts | {"R": ph.damping("p")} | changes)


def measured(t: Any = T, x: Any = X, **options: Any) -> Any:
    names: dict[str, Any] = {"states": ["q", "p"]}
    return ph.Measurements.from_arrays(t, x, **names | options)


def energy(text: str, **parameters: Any) -> Any:
    return spring(H=ph.formula(text, **parameters or {"k": K}))


def table(text: str, **options: Any) -> Any:
    Path("bench.csv").write_text(text)
    names: dict[str, Any] = {"time": "t", "states": ["q"]}
    return ph.Measurements.from_csv("bench.csv", **names | options)


def study(old: str, new: str) -> Any:
    for path in EXAMPLE.iterdir():
        Path(path.name).write_bytes(path.read_bytes())
    text = Path("study.toml").read_text()
    assert old in text
    Path("study.toml").write_text(text.replace(old, new))
    file = ph.StudyFile.read("study.toml")
    file.check_formulas()


def command(*arguments: str) -> Any:
    result = CliRunner().invoke(app, [*arguments, "--json"])
    raise ph.DataError(" ".join(json.loads(result.stdout)["error"].split()))


# The mistake, and words that its message has: what it is about, and what to do.
MISTAKES: dict[str, tuple[Callable[[], Any], list[str]]] = {
    # ---- Python: arguments of the wrong kind
    "swapped": (lambda: ph.identify(measured(), spring()), ["model=Measurements(...)", "comes first"]),
    "study swapped": (lambda: ph.Study(measured(), spring()), ["model=Measurements(...)", "comes first"]),
    "a frame": (lambda: ph.identify(spring(), FRAME), ["data=DataFrame(...)", "from_dataframe"]),
    "a frame for a study": (lambda: ph.Study(spring(), FRAME), ["train=DataFrame(...)", "from_dataframe"]),
    "an array": (lambda: ph.identify(spring(), X), ["data=ndarray(...)", "from_arrays"]),  # type: ignore[arg-type]
    "a path": (lambda: ph.identify(spring(), "bench.csv"), ["data='bench.csv'", "from_csv"]),  # type: ignore[arg-type]
    "effects of data": (lambda: ph.catalogue(measured()), ["model=Measurements(...)", "PseudoHamiltonian"]),
    "a class": (lambda: ph.identify(spring(), measured(), ph.PHSILoss), ["loss=PHSILoss ", "PHSILoss()"]),  # type: ignore[arg-type]
    "a frame as times": (lambda: ph.simulate(spring(), FRAME, [1, 0]), ["(51, 3)", "increasing"]),
    # ---- Python: measurements
    "states in one text": (lambda: measured(states="qp"), ["states='qp'", "['a', 'b']"]),
    "transposed": (lambda: measured(x=X.T), ["2 rows", "51", "transposed"]),
    "times as text": (lambda: measured(t=T.astype(str)), ["type text", "astype(float)"]),
    "runs of one name": (lambda: measured([T, T], [X, X], names=["a", "a"]), ["'a'", "Rename"]),
    "unit of no state": (lambda: measured(units={"x": "m"}), ["'x'", "t, q, p"]),
    "unknown column": (lambda: table("t,pos\n0,1\n1,2\n"), ["bench.csv", "'q'", "t, pos"]),
    "many columns": (lambda: table(",".join(f"channel {k}" for k in range(99)) + "\n" + "1," * 98 + "1\n"), ["'t'", "'channel 0'", "more"]),
    "dates as numbers": (lambda: table("t,q\n2020-01-01,1\n1.5,2\n"), ["column 't', line 3", "'1.5'", "date_format"]),
    "decimal comma": (lambda: table("t,q\n0,0,1,5\n0,5,2,5\n"), ["line 2 has 4 cells", "decimal"]),
    "a word": (lambda: table("t,q\n0,1\n1,low\n"), ["column 'q', line 3", "'low'", "leave it empty"]),
    "no file": (lambda: ph.Measurements.from_csv("gone.csv", time="t", states=["q"]), ["'gone.csv'", "check the path"]),
    "an empty file": (lambda: table(""), ["bench.csv", "header line"]),
    # ---- Python: models
    "unknown effect": (lambda: spring().add("coulom friction", "p"), ["'coulom friction' on p", "'coulomb friction'?"]),
    "effect elsewhere": (lambda: spring().add("coulomb friction", "q"), ["on q", "act on p"]),
    "not skew": (lambda: spring(S=[[0, 1], [1, 0]]), ["S[0, 1]=1", "-S[i, j]"]),
    "bounds": (lambda: ph.Parameter(1.0, lower=2, upper=1), ["lower=2", "upper=1", "swap"]),
    "start": (lambda: ph.Parameter(-1.0, lower=0), ["-1", "[0, inf]", "widen"]),
    "number as text": (lambda: ph.Parameter("2.5"), ["'2.5'", "expected float"]),  # type: ignore[arg-type]
    "unknown name": (lambda: energy("k*x**2/2"), ["'x'", "k, p, q", "Parameter"]),
    "caret": (lambda: energy("k*q^2/2"), ["'k*q^2", "**"]),
    "bracket": (lambda: energy("k*(q**2/2"), ["'k*(q**2/2'", "Close the bracket"]),
    "equation": (lambda: energy("H = k*q**2/2"), ["'H = k*q**2/2'", "right-hand side"]),
    "no sign": (lambda: energy("2q"), ["'2q'", "2*q"]),
    "comma in a formula": (lambda: energy("0,5*k*q**2"), ["'0,5*k*q**2'", "0.5"]),
    "no mass": (lambda: ph.identify(energy(f"{ENERGY}/m", k=K, m=0.0), measured()), ["in H", "m = 0", "change"]),
    "negative mass": (lambda: ph.identify(energy("p**2/(2*m)", m=-2.5), measured()), ["m=-2.5", "positive", "sign"]),
    "a gain as a loss": (lambda: ph.identify(spring(R={"p": "-c"}), measured()), ["R_p: '-c'", "dH/dx", "remove the sign"]),
    "missing input": (lambda: ph.identify(spring(inputs=["u"], F={"p": ph.formula("u")}), measured()), ["'u'", "inputs={'u': column}"]),
    # ---- study files
    "no quotes": (lambda: study('H = "k*q**2/2 + p**2/(2*m)"', "H = k*q"), ["line 22", "H = k*q", "in quotes"]),
    "comma": (lambda: study("start = 10.0", "start = 10,0"), ["line 28", "10,0", "point"]),
    "quotes": (lambda: study("m = 2.5", 'm = "2.5"'), ["parameters.m", '"2.5"', "a number"]),
    "no pairs": (lambda: study('pairs = [["q", "p"]]', ""), ["line 19", "pairs or S", 'A body has pairs = [["q", "p"]], the position first']),
    "states": (lambda: study('states = ["q", "p"]', 'states = "q, p"'), ["model.states", "'q, p'", "a list"]),
    "column": (lambda: study("position_m", "positon_m"), ["data.states.q.column", "positon_m", "'position_m'?"]),
    "file": (lambda: study("friction_spring.csv", "spring.csv"), ["data.files", "spring.csv", "relative"]),
    "key": (lambda: study("trajectory =", "trajectories ="), ["data.trajectories", "'trajectory'?"]),
    "share": (lambda: study("share = 0.4", "share = 40"), ["held_out.share = 40", "0 and 1"]),
    "effect": (lambda: study("added = []", 'added = ["coulomb friction on q"]'), ["study.added", "on q", "act on p"]),
    "mass": (lambda: study("m = 2.5", "m = 0"), ["in H", "m = 0", "change"]),
    "mass below zero": (lambda: study("m = 2.5", "m = -2.5"), ["parameters.m = -2.5", "positive", "sign"]),
    "loss below zero": (lambda: study('p = "c"', 'p = "-c"'), ["model.R.p", "'-c'", "remove the sign"]),
    # ---- the command line
    "no study": (lambda: command("check", "gone.toml"), ["gone.toml", "phsi-opt init"]),
    "no table": (lambda: command("init", "gone.csv"), ["gone.csv", "check the path"]),
    "no fit": (lambda: ph.Fit.load("gone.json"), ["gone.json", "save"]),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_a_typical_mistake_is_told_with_its_place_and_its_repair(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    mistake, words = MISTAKES[name]
    with pytest.raises(ph.PhsiOptError) as caught:
        mistake()
    said = str(caught.value)
    if isinstance(caught.value, ph.StudyFileError):
        (complaint,) = caught.value.complaints
        said = str(complaint)
    assert [word for word in words if word not in said] == [], said
    assert len(said) <= MOST_LETTERS
    assert "\n" not in said and "Error" not in said


@pytest.mark.parametrize(("force", "words"), [
    ("k*q - c*v", "neighbouring samples: check the sign of the term with k: k = -2"),
    ("-k*q + c*v", "c is at its lower bound 0; the data favour values beyond it: check the sign of the term with c."),
])  # fmt: skip
def test_a_wrong_sign_is_told_with_its_term(force: str, words: str) -> None:
    truth = ph.FirstOrder(["q", "v"], F={"q": "v", "v": ph.formula("-2*q - 0.3*v")})
    x = ph.simulate(truth, T, [1.0, 0.0])
    x = x + 0.01 * np.random.default_rng(0).normal(size=x.shape)
    free = {name: ph.Parameter(0.5, lower=0) for name in "kc"}
    model = ph.FirstOrder(["q", "v"], F={"q": "v", "v": ph.formula(force, **free)})
    said = " ".join(ph.identify(model, measured(x=x, states=["q", "v"])).warnings)
    assert words in said


def test_degrees_without_a_unit_in_a_sine_are_told() -> None:
    swing = np.column_stack([113 * np.cos(1.5 * T), np.sin(T)])
    model = spring(H=ph.formula("k*(1 - cos(q)) + p**2/2", k=K))
    words = "q runs from -113 to 113 in cos(q), which takes radians: probably these are"
    (said,) = AlignedData.of(model, measured(x=swing)).notes
    assert said.startswith(f"{words} degrees. Give the unit")
    for x, units in ((swing / 57, {}), (swing, {"q": "rad"})):
        assert not AlignedData.of(model, measured(x=x, units=units)).notes


def test_pure_noise_is_explained_by_nothing() -> None:
    noise = np.random.default_rng(0).normal(size=(400, 1)) * [1.0, np.nan]
    data = measured(0.1 * np.arange(400), noise)
    said = ph.compare(ph.identify(spring(), data), data).warning
    assert said.startswith("Nothing explains the measurements of q: they look like")
    assert not ph.compare(ph.identify(spring(), measured()), measured()).warning


def test_a_fit_of_one_run_of_three_says_what_that_costs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    study('trajectory = "run"', 'trajectory = "run"')
    runs = pd.read_csv("friction_spring.csv")
    for n, is_told in ((3, True), (8, False)):
        some = runs[runs["run"].isin(runs["run"].unique()[:n])]
        some.to_csv("friction_spring.csv", index=False)
        said = " ".join(CliRunner().invoke(app, ["check"]).stdout.split())
        cost = "Only 201 of 603 samples are fitted: standard errors are about 1.7 times"
        assert (cost in said) == is_told
        runs.to_csv("friction_spring.csv", index=False)
