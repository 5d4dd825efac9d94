"""Drawn inputs: what is well formed is read exactly, and anything else is refused.

Each property is tried with its part of `N_INPUTS`; PHSI_OPT_INPUTS=10000 asks for more.
"""

import itertools
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import casadi as ca
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import phsi_opt as ph
from phsi_opt.model.expressions import CASADI, NUMPY, evaluate, parse
from problems.benchmarks import fuzz
from problems.benchmarks.fuzz_inputs import MARKER, Unshown

N_INPUTS = int(os.environ.get("PHSI_OPT_INPUTS", "1000"))
N_PROPERTIES = 3
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


# ---- wrong arguments and damaged files -----------------------------------------------

SELDOM = 0.1  # share of the inputs of an entry that takes long
TARGETS = fuzz.targets()
SHARES = fuzz.SHARES | dict.fromkeys(fuzz.BINARY, 0.0)  # these take long as well
QUICK = [name for name in TARGETS if SHARES.get(name, 1.0) > SELDOM]


@pytest.mark.parametrize("name", QUICK)
def test_no_error_is_foreign_and_no_input_misread(name: str) -> None:
    n_inputs = N_INPUTS // N_PROPERTIES // len(QUICK) + 1
    tally = fuzz.fuzzed(TARGETS[name], n_inputs)
    assert tally.faults == {}
    assert sum(tally.counts.values()) > 1


def test_the_usual_arguments_are_accepted(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, call in fuzz.public():
        values, _ = fuzz.arguments_of(name, call)
        if values and fuzz.SHARES.get(name, 1.0) > SELDOM:
            fuzz.used(call, values)


LONG = 10**5000
UNSHOWN = [LONG, [LONG], {"a": LONG}, {LONG: 1}, Unshown(), [Unshown()], (LONG,)]
UNSHOWN.append(np.array([LONG], dtype=object))


def test_arguments_that_cannot_be_shown_are_refused(
    tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tally = fuzz.Tally()
    for name, call in fuzz.public():
        values, _ = fuzz.arguments_of(name, call)
        target = fuzz.Target(st.none(), partial(fuzz.used, call))
        for argument, odd in itertools.product(values, UNSHOWN):
            fuzz.tried(target, values | {argument: odd}, tally)
    assert tally.faults == {}
    assert tally.counts["refused"] > tally.counts["accepted"] > 0


@pytest.mark.parametrize("call", [
    lambda: 1 / 0,
    lambda: ph.Measurements.from_arrays([0.0, 1.0], [1.0, 2.0], states=["q"]),
])  # fmt: skip
def test_the_search_notices_a_foreign_error_and_a_wrong_reading(call) -> None:
    tally = fuzz.Tally()
    target = fuzz.Target(st.none(), lambda _: call(), lambda *_: False)
    fuzz.tried(target, None, tally)
    assert len(tally.faults) == 1


def test_the_search_notices_what_is_slow_and_what_is_run(monkeypatch) -> None:
    monkeypatch.setattr(fuzz, "SLOW", -1.0)
    tally = fuzz.Tally()
    fuzz.tried(fuzz.Target(st.none(), lambda _: MARKER.touch()), None, tally)
    assert set(tally.faults) == {"slow", "ran"}
    assert not MARKER.exists(), "the next input is looked at anew"
