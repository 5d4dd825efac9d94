"""What the search for errors draws: usual arguments, and what takes their place.

Strategies of Hypothesis: values of an annotated type, anything else, content of which
parts are replaced, damaged bytes, cells of tables, formulas.
"""

import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime  # noqa: F401  # of OTHERS
from decimal import Decimal
from fractions import Fraction
from functools import cache
from itertools import repeat
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

import numpy as np
import pandas as pd  # noqa: F401  # of OTHERS
import sympy as sp
from hypothesis import strategies as st

import phsi_opt as ph

Draw = st.SearchStrategy[Any]
Arguments = dict[str, Any]
FOLDER = tempfile.TemporaryDirectory(prefix="fuzz")
MARKER = Path(FOLDER.name, "ran")  # a file that hostile texts make where they are run
RUNS = f"__import__('pathlib').Path('{MARKER}').touch()"

NOTHING = object()  # in place of a part that is left out
TABLE = b"t,q,u\n0,1.5,2\n1,2.5,3\n2,3.5,4\n3,4.5,5\n"


# fmt: off
HUGE = 10**400
DIGITS = "9" * 5000
NUMBERS = [
    *(0, 1, -1, 2, 1.5, -1e9, 1e300, 5e-324, math.nan, math.inf, -math.inf, HUGE),
    *(-HUGE, int("9" * 4000), Fraction(HUGE), Fraction(1, 3), Decimal("NaN")),
    *(1j, np.complex128(1 + 2j), np.float64(math.nan), np.int64(3), np.float32(0.1)),
    *(True, False, np.True_, 2**53 + 1, Decimal("1e400")),
]
NAMES = ["q", "p", "t", "u", "k", "H", "R", "F", "linear", "zero", "coulomb friction"]
TEXTS = [
    *(*NAMES, "", "x", " ", "1", "1_000", "\ud800", "q\ud800", "a\0b", "x" * 5000),
    *(DIGITS, "10**400", "1e400", "\N{MATHEMATICAL ITALIC SMALL Q}", "q\n", "м", "sin"),
    *("lambda", "k*q**2", "q+\ud800", "((((", "9**9**9", "../x", "/", ".", "1 2"),
    *("a,b", "{}", "%s", "\x1b[31m", "N/m", RUNS),
]
SHAPES = [
    *(" ", "(", ")", "(:", "()", "[", "]", "{", "1", "0", "1.", "1,", "1e", "+", "-"),
    *("'", '"', '""', ";", ",", "\t", ":", "/", "*", "**", "^", "_", "=", "#", "%"),
    *(".", "a", "a ", "A1", "a_", "1:", "2024-", "N/m ", "m^2 ", "s^-1*", "S/N: 1, "),
    *("(a", "q (", "<c ", "sin(", "q*-", "min(q,", "dH_dp*", "\u00a0", "\\", "\n"),
]
OTHERS = [  # made anew for every input
    *("None", "b'q'", "[]", "()", "{}", "set()", "[None]", "['q']", "['q', 'q']"),
    *("[['q']]", "[1.0]", "{'q': None}", "{'q': []}", "{1: 2}", "{None: 1.0}", "{}"),
    *("{'q': 1.0}", "{'p': 'q'}", "{'q': {'q': 1}}", "('q', 'p')", "{'q', 'p'}"),
    *("np.array([])", "np.array([1.0, 2.0])", "np.array(['q', 'p'])", "np.array(1.0)"),
    *("np.array([1 + 2j, 2], object)", "np.ones((2, 2, 2))", "[[1.0], [1.0, 2.0]]"),
    *("[[1.0, 2.0], [3.0, 4.0]]", "np.eye(2, dtype=complex)", "range(3)", "iter('qp')"),
    *("int", "pd.NaT", "pd.NA", "pd.Series([1.0, 2.0])", "pd.DataFrame()", "slice(1)"),
    *("datetime(2020, 1, 1)", "np.datetime64('NaT')", "Path('q')", "ph.Parameter"),
    *("ph.formula('q')", "spring()", "measured()", "np.array([{}])", "{'q': 1j}"),
    *("np.array([[], []])", "np.ma.masked", "np.ma.masked_all(3)", "np.array([b'q'])"),
    *("np.array([HUGE, 1], object)", "[HUGE, 1.0]", "[10**5000]", "10**5000"),
    *("['q', '\\ud800']", "..."),
    *("[np.ma.masked, 0.0]", "pd.array(['a', None])", "{'q': ()}", "{'q': HUGE}"),
    *("np.timedelta64(1)", "[pd.DataFrame()]", "{'q': pd.DataFrame()}", "[pd.NA, 1.0]"),
    *("{'q': np.array([1.0, 2.0])}", "pd.DataFrame({'q': [1.0, 2.0]})", "lambda: 1"),
    *("memoryview(b'ab')", "pd.Series(['a', None])", "pd.Timestamp(0)", "Unshown()"),
    *("[Unshown()]", "{'q': [10**5000]}", "{10**5000: 1}", "(10**5000,)"),
]
# fmt: on


class Unshown:
    """A value of which no message can tell what it is."""

    def __repr__(self) -> str:
        raise RuntimeError("no text")


def each_odd() -> Iterator[Any]:
    """The odd values that are listed above, each of them once."""
    yield from (*NUMBERS, *TEXTS)
    yield from map(eval, OTHERS, repeat(globals()))


# A few letters, up to 100 000 of them: what is not linear in them never ends.
REPEATED: Draw = st.builds(
    lambda begin, shape, length, end: begin + shape * (length // len(shape)) + end,
    st.sampled_from(["", "q (", "t", "1", "-", '"', "1e", "a"]),
    st.sampled_from(SHAPES),
    st.sampled_from([100, 2000, 20_000, 100_000]),
    st.sampled_from(["", "x", "1", ")", "]", "!", '"', " "]),
)

ODD: Draw = st.one_of(
    REPEATED,
    st.sampled_from(NUMBERS),
    st.sampled_from(TEXTS),
    st.sampled_from(OTHERS).map(lambda text: eval(text)),
    st.floats(),
    st.integers(),
    st.text(st.characters(), max_size=8),
    st.lists(st.sampled_from([*NUMBERS[:12], *TEXTS[:8], None]), max_size=3),
)


@cache
def spring() -> ph.PseudoHamiltonian:
    """A mass on a spring with a damper and a force."""
    energy = ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(2.0, lower=0, unit="N/m"))
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=energy,
        R=ph.damping("p"),
        F={"p": ph.formula("u")},
    )


@cache
def measured() -> ph.Measurements:
    """Its motion."""
    t = np.linspace(0.0, 2.4, 25)
    x = np.column_stack([np.cos(t), -np.sin(t)])
    names: Arguments = {"states": ["q", "p"], "inputs": ["u"]}
    x += 0.01 * np.sin(1000 * x)
    return ph.Measurements.from_arrays(t, x, np.sin(3 * t), **names)


@cache
def fitted() -> ph.Fit:
    """Its fit to its motion."""
    return ph.identify(spring(), measured())


@cache
def usual() -> Arguments:
    """Usual arguments by name, or by the name of the entry and theirs."""
    pair = [[1.0, 0.0], [0.5, 0.5]]
    frame = {"t": [0.0, 1.0, 2.0], "q": [1.0, 2.0, 3.0], "u": [0.0, 0.0, 1.0]}
    section: Arguments = {
        "files": ["a.csv"],
        "time": ph.Times("t"),
        "inputs": {"u": ph.Channel()},
    }
    columns = {"q": ph.Channel(), "p": ph.Channel(measured=False)}
    read = {"time": "t", "states": {"q": "q"}, "inputs": ["u"], "hold": "zero"}
    usual_of_readers = {
        f"Measurements.from_{kind}.{name}": value
        for kind in ("csv", "dataframe")
        for name, value in read.items()
    }
    sections = {f"DataSection.{name}": value for name, value in section.items()}
    # fmt: off
    return {
        **{"states": ["q", "p"], "inputs": ["u"], "S": [[0.0, 1.0], [-1.0, 0.0]]},
        **{"H": "k*q**2/2 + p**2/2", "R": {"p": "c"}, "F": {"p": "u"}, "memory": []},
        **{"sensor": {"q": "b"}, "FirstOrder.sensor": None, "FirstOrder.R": None},
        **{"kind": {"q": "mechanical", "p": "mechanical"}, "expression": "k*q"},
        **{"FirstOrder.kind": None, "variables": ["q", "p"], "degree": 2, "n": 2},
        **{"*states": ["q", "p"], "coordinates": ["x"], "mass": "m"},
        **{"channels": ["q"], "Measurements.resampled.step": 0.1},
        **{"forces": "-k*x - c*v + u", "name": "k", "slot": "F", "equation": "p"},
        **{"term": ph.formula("q"), "Effect.memory": {"z": ph.formula("q")}},
        **{"effect": "coulomb friction", "values": {"k": 1.0}, "bounds": {"k": 1.0}},
        **{"names": ["k"], "model": spring(), "data": measured(), "train": measured()},
        **{"fit": fitted(), "Study.fit": None, "loss": ph.PHSILoss(), "n_draws": 2},
        **{"Study.loss": None, "diagnose.loss": None, "effects": ["constant force"]},
        **{"without": ["gap"], "t": [0.0, 0.5, 1.0], "x": [*pair, [0.0, 1.0]]},
        **{"u": [1.0, 2.0, 3.0], "x0": [1.0, 0.0], "hold": "linear", "key": 0},
        **{"Trajectory.x": [[1.0], [2.0], [3.0]], "trajectories": list(measured())},
        **{"Measurements.from_arrays.names": ["one"], "units": {"q": "m", "t": "s"}},
        **{"noise": {"q": 0.1}, "Channel.noise": 0.1},
        **{"fraction": 0.7, "begin": 0.0, "end": 1.0},
        **{"source": table(), "separator": ",", "frame": frame, "path": "saved.json"},
        **{"function": callable, "cases": {"a": 1}, "called": "coulomb friction"},
        **{"level": 0.9, "l1": {"H": 0.1}, "share": 0.4, "column": "t"},
        **{"DataSection.states": columns, "Fit.content.states": True},
        **{"added": ["coulomb friction"]},
        **{"diagram": {"m": "mass: x", "k": "spring: x, ground"}, "positions": ["x"]},
        **{"from_sympy.system": [sp.Symbol("p"), -sp.Symbol("k") * sp.Symbol("q")]},
        **{"StudyFile.of.data": ph.DataSection(states=columns, **section)},
        **{"StudyFile.of.held_out": ph.HeldOut(share=0.4), "max_iterations": 5},
        **{"StudyFile.of.loss": None, "StudyFile.of.folder": ".", "what": "x"},
        **{"FirstOrder.S": None, "FirstOrder.H": None, "folder": None},
        **{"executor": ThreadPoolExecutor(1), "Fit.export.path": f"{FOLDER.name}/a.c"},
        **usual_of_readers,
        **sections,
    }
    # fmt: on


def of_type(hint: Any) -> Draw:
    """Values of an annotated type."""
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return st.one_of(*map(of_type, parts))
    if kind in PLAIN:
        return PLAIN[kind]
    if isinstance(kind, type) and issubclass(kind, Mapping) and parts:
        return st.dictionaries(of_type(parts[0]), of_type(parts[1]), max_size=2)
    if isinstance(kind, type) and issubclass(kind, Iterable) and parts:
        return st.lists(of_type(parts[0]), max_size=3)
    fitting = [one for one in usual().values() if type(one) is kind]
    return st.sampled_from(fitting) if fitting else ODD


PLAIN: dict[Any, Draw] = {
    NoneType: st.none(),
    str: st.one_of(st.sampled_from(NAMES), st.sampled_from(TEXTS), REPEATED),
    bool: st.booleans(),
    # What lies between costs hours where it counts, and is no other kind of number.
    int: st.one_of(st.integers(-2, 5), st.integers(10**7), st.integers(max_value=-9)),
    float: st.one_of(st.floats(), st.floats(-9, 9), st.integers()),
}


def places(content: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every part below."""
    entries: Any = []
    if isinstance(content, dict):
        entries = content.items()
    elif isinstance(content, list | tuple):
        entries = enumerate(content)
    for key, value in entries:
        yield (*above, key)
        yield from places(value, (*above, key))


def replaced(content: Any, path: tuple[Any, ...], part: Any) -> Any:
    """The same with another part at a path; without it for `NOTHING`."""
    key, *below = path
    items = dict(content) if isinstance(content, dict) else dict(enumerate(content))
    items[key] = replaced(items[key], tuple(below), part) if below else part
    if items[key] is NOTHING:
        del items[key]
    return items if isinstance(content, dict) else list(items.values())


@st.composite
def changed(
    draw: st.DrawFn, content: Any, odd: Draw = ODD, hints: Arguments | None = None
) -> Any:
    """The content with one or two parts replaced or left out.

    Where types are given, half of the parts are of their own.
    """
    result = content
    for _ in range(draw(st.sampled_from([1, 1, 1, 2]))):
        paths = list(places(result))
        path = draw(st.sampled_from(paths)) if paths else None
        if path is None:
            continue
        if hints and draw(st.booleans()):
            result = replaced(result, path[:1], draw(of_type(hints[path[0]])))
            continue
        # Python itself says which argument is missing.
        is_left_out = len(path) > 1 and draw(st.integers(0, 9)) == 9
        result = replaced(result, path, NOTHING if is_left_out else draw(odd))
    return result


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """The bytes with some of them replaced, put in or left out."""
    result = content
    for _ in range(draw(st.integers(1, 3))):
        first = draw(st.integers(0, len(result)))
        length = draw(st.sampled_from([0, 1, 1, 2, 8, 30]))
        put = draw(st.one_of(st.binary(max_size=3), st.sampled_from(WORDS)))
        result = result[:first] + put + result[first + length :]
    return result


# fmt: off
WORDS = [
    *(b"_", b",", b";", b"\n", b"\r", b'"', b"'", b"=", b"[", b"]", b"{", b"}", b"\0"),
    *(b"#", b"1e999", b"-1e9", b"9" * 5000, b"\xff\xfe", b"\xed\xa0\x80", b"nan"),
    *(b"inf", b"null", b"true", b"0", b"-1", b'""', b"[[]]", b"\\ud800", b"[" * 60),
    *(b"a." * 50, b"\t", b"1_0"),
]

# fmt: on
# fmt: off
CELLS: Draw = st.one_of(
    st.sampled_from([
        *("1_000", "1,000", "1 000", "1'000", "0x10", "1e400", DIGITS, "1/2", "+-1"),
        *("1e", "inf", "-Infinity", "nan", "NA", "#DIV/0!", "-", "1..2", "1.2.3"),
        *("1d3", "1D3", "\u0661", "\uff11", "½", "\u22121", "1j", "(1)", "True", "1%"),
        *("0b1", "1e1_0", "1E+02", ".5", "5.", "+3", "1 ", " 1", '"1"', "''", "1e-400"),
        *("0_1", "_1", "1__0"),
    ]),
    REPEATED,
    st.floats(-1e6, 1e6).map(repr),
    st.text(st.sampled_from("0123456789.eE+-_ xj/'\"\u00a0"), max_size=6),
)
# fmt: on
# fmt: off
PIECES = [
    *("q", "p", "t", "u", "k", "pi", "sin(", "min(", "abs(", ")", ",", "(", "+", "-"),
    *("*", "/", "**", "2", "0.5", "1e400", "64", "dH_dp", " ", "1_0", "0x1", "1j"),
]
# fmt: on
LETTERS = "qpkut+-*/().,0123456789 e_^[]'\"=:sincolgabxm\ud800\0\n"
FORMULAS: Draw = st.one_of(
    REPEATED,
    st.sampled_from(TEXTS),
    st.text(st.characters(), max_size=20),
    st.text(st.sampled_from(LETTERS), max_size=24),
    st.lists(st.sampled_from(PIECES), max_size=12).map("".join),
)
# fmt: off
LAWS: Draw = st.fixed_dictionaries({
    "start": st.one_of(
        st.sampled_from([1.0, 0.0, 1e100, 1e-300, 1e300]), st.floats(-9, 9)
    ),
    "lower": st.sampled_from([-math.inf, 0.0, -1.0]),
    "size": st.sampled_from([None, 0.0, 0.1, 1e200]),
    "text": st.sampled_from([
        *("c*q*exp(-w*t)", "c*log(w - q)", "c*sqrt(q - w)", "c/(q - w)", "c*q**w"),
        *("c*sin(w*q)", "c*tanh(q/w)", "c*exp(w*p)", "c*abs(p)**w", "c*(w*q)**64"),
        *("c*q/(w*w)", "c + w*p"),
    ]),
    "loss": st.sampled_from([*[ph.PHSILoss()] * 9, ph.MaximumLikelihood()]),
})  # fmt: skip
# fmt: on


def table() -> str:
    """The path of a table that is read without a fault."""
    path = Path(FOLDER.name, "fine.csv")
    path.write_bytes(TABLE)
    return str(path)
