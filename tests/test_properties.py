"""Drawn inputs of readers, formulas and files: what is well formed is read exactly, and
anything else is read or refused, and never ends in an error of another kind.

Each property is tried with its part of `N_INPUTS`; PHSI_OPT_INPUTS=10000 asks for more.
"""

import copy
import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import casadi as ca
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import phsi_opt as ph
from phsi_opt.model.expressions import CASADI, NUMPY, evaluate, parse

N_INPUTS = int(os.environ.get("PHSI_OPT_INPUTS", "1000"))
N_PROPERTIES = 6
Test = TypeVar("Test", bound=Callable[..., Any])

NUMBERS = st.floats(-1e100, 1e100)  # larger ones are refused
SOME = st.floats(min_value=-1e6, max_value=1e6, allow_subnormal=False)
TEXTS = st.text(max_size=60)
NAMES = ("q", "p", "k", "t")


def tried(test: Test) -> Test:
    """Its part of the inputs, the same in every run."""
    chosen = settings(
        max_examples=N_INPUTS // N_PROPERTIES,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    result: Test = chosen(test)
    return result


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("drawn")


# ---- tables --------------------------------------------------------------------------


@st.composite
def tables(draw: st.DrawFn) -> np.ndarray:
    """Increasing times and two channels, (n_samples, 3)."""
    n = draw(st.integers(2, 12))
    t = draw(st.lists(SOME, min_size=n, max_size=n, unique=True))
    values = draw(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=n, max_size=n))
    return np.column_stack([np.sort(t), np.array(values)])


FORMATS = st.sampled_from(
    [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), (" ", ".")]
)


def written(table: np.ndarray, separator: str, point: str, end: str = "\n") -> str:
    lines = [separator.join(["t", "q", "u"])]
    for row in table.tolist():
        cells = [repr(value).replace(".", point) for value in row]
        lines.append(separator.join(cells))
    return end.join(lines) + end


def read(path: Path) -> ph.Measurements:
    return ph.Measurements.from_csv(path, time="t", states=["q"], inputs=["u"])


@tried
@given(tables(), FORMATS, st.sampled_from(["\n", "\r\n"]))
def test_a_table_is_read_exactly_however_it_is_separated(
    folder: Path, table: np.ndarray, kind: tuple[str, str], end: str
) -> None:
    path = folder / "table.csv"
    path.write_bytes(written(table, *kind, end).encode())
    (run,) = read(path).trajectories
    found = np.column_stack([run.t, run.x, run.u])
    assert found.tobytes() == (table + 0.0).tobytes() or np.array_equal(found, table)


@tried
@given(st.one_of(TEXTS.map(str.encode), st.binary(max_size=80)))
def test_any_bytes_are_a_table_or_refused(folder: Path, content: bytes) -> None:
    path = folder / "bytes.csv"
    path.write_bytes(b"t,q,u\n0,1,2\n" + content)
    try:
        data = read(path)
    except ph.DataError:
        return
    assert all(np.all(np.diff(run.t) > 0) for run in data.trajectories)


# ---- formulas ------------------------------------------------------------------------


def _deeper(parts: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    functions = ("sin", "cos", "tan", "atan", "exp", "log", "sqrt", "tanh", "abs")
    one = st.tuples(st.sampled_from((*functions, "sign")), parts)
    two = st.tuples(parts, st.sampled_from(["+", "-", "*", "/"]), parts)
    pair = st.tuples(st.sampled_from(["min", "max"]), parts, parts)
    power = st.tuples(parts, st.integers(-4, 6))
    return st.one_of(
        one.map(lambda f: f"{f[0]}({f[1]})"),
        two.map(lambda f: f"({f[0]} {f[1]} {f[2]})"),
        pair.map(lambda f: f"{f[0]}({f[1]}, {f[2]})"),
        power.map(lambda f: f"({f[0]})**{f[1]}"),
        parts.map(lambda f: f"(-{f})"),
    )


LEAVES = st.one_of(st.sampled_from((*NAMES, "pi")), st.floats(0, 1e3).map(repr))
FORMULAS = st.recursive(LEAVES, _deeper, max_leaves=12)
VALUES = st.fixed_dictionaries(dict.fromkeys(NAMES, st.floats(-10, 10)))


@tried
@given(FORMULAS, VALUES)
def test_a_formula_has_one_value_in_every_library(text, values) -> None:
    try:
        parse(text)
    except ph.ModelError as refused:  # a part without names that has no value
        assert "finite" in str(refused) or "beyond" in str(refused)
        return
    arguments = {name: np.float64(value) for name, value in values.items()}
    with np.errstate(all="ignore"):
        expected = float(evaluate(text, arguments, NUMPY))
    symbols = {name: ca.SX.sym(name) for name in NAMES}
    made = ca.Function("f", list(symbols.values()), [evaluate(text, symbols, CASADI)])
    found = float(made(*[values[name] for name in NAMES]))
    if math.isfinite(expected):  # elsewhere q/q may be one, or no number
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-9)


@tried
@given(st.one_of(TEXTS, st.text("qpk+-*/()., 0123456789e_^[]'\"=:lambdimport")))
def test_any_text_is_a_formula_or_refused(text: str) -> None:
    try:
        dictionary = ph.formula(text, k=1.0)
    except ph.ModelError:
        return
    try:
        model = ph.PseudoHamiltonian(
            states=["q", "p"], S=ph.canonical(1), H=dictionary, R=ph.damping("p")
        )
    except ph.ModelError:
        return
    assert str(model)


# ---- files ---------------------------------------------------------------------------

ANYTHING = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), NUMBERS, TEXTS),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(TEXTS, inner, max_size=3)
    ),
    max_leaves=6,
)


@pytest.fixture(scope="module")
def saved(folder: Path) -> dict[str, Any]:
    """The content of a fit's file."""
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(1.0, unit="N/m")),
        R=ph.damping("p"),
    )
    t = np.linspace(0, 5, 41)
    x = ph.simulate(model.with_values({"k": 1.3, "R_p": 0.2}), t, [1.0, 0.0])
    noise = 0.01 * np.random.default_rng(0).normal(size=x.shape)
    data = ph.Measurements.from_arrays(t, x + noise, states=["q", "p"])
    path = folder / "fit.json"
    ph.identify(model, data).save(path)
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def places(content: Any, above: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The path of every entry below."""
    if isinstance(content, dict):
        entries = list(content.items())
    elif isinstance(content, list):
        entries = list(enumerate(content))
    else:
        return []
    found = []
    for key, value in entries:
        path = (*above, key)
        found += [path, *places(value, path)]
    return found


@tried
@given(st.data())
def test_a_damaged_fit_is_loaded_or_refused(folder, saved, data) -> None:
    content = copy.deepcopy(saved)
    *above, key = data.draw(st.sampled_from(places(saved)))
    parent: Any = content
    for step in above:
        parent = parent[step]
    if data.draw(st.booleans()):
        parent[key] = data.draw(ANYTHING)
    else:
        del parent[key]
    path = folder / "damaged.json"
    path.write_text(json.dumps(content))
    try:
        fit = ph.Fit.load(path)
    except ph.PhsiOptError:
        return
    assert str(fit)
    assert set(fit.std_errors) == set(fit.values)


EXAMPLE = Path(ph.__file__).parent / "study_file" / "examples" / "spring"
STUDY = (EXAMPLE / "study.toml").read_text()


@tried
@given(st.data())
def test_a_damaged_study_file_is_read_or_refused(folder, data) -> None:
    shutil.copy(EXAMPLE / "friction_spring.csv", folder)
    first = data.draw(st.integers(0, len(STUDY)))
    last = data.draw(st.integers(first, min(first + 12, len(STUDY))))
    text = STUDY[:first] + data.draw(TEXTS) + STUDY[last:]
    path = folder / "study.toml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        study = ph.StudyFile.read(path)
        model = study.model()
        train, _ = study.split()
    except ph.PhsiOptError:
        return
    assert str(model)
    assert train.n_samples >= 2
