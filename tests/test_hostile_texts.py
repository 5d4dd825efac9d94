"""Texts of users take a time that grows with their length, and not with its square."""

import ast
import importlib
import io
import pkgutil
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

import phsi_opt as ph
from phsi_opt.data.headers import Header
from phsi_opt.data.table_extent import unit_in
from phsi_opt.errors import did_you_mean
from phsi_opt.study_file.survey import survey

N = 100_000  # letters: a time of the second power is minutes, one of the first 0.01 s
SECONDS = 5.0  # of processor time
PACKAGE = Path(ph.__file__).parent
TREES = {path: ast.parse(path.read_text("utf-8")) for path in PACKAGE.rglob("*.py")}
USES = ("match", "fullmatch", "search", "sub", "split", "findall", "finditer")


def calls() -> Iterator[tuple[str, str, list[ast.expr], str]]:
    """Calls of methods that expressions have: of what, which, with what, where."""
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                of = ast.unparse(node.func.value)
                yield of, node.func.attr, node.args, f"{path.name}:{node.lineno}"


def expressions() -> Iterator[tuple[str, re.Pattern[Any], tuple[str, ...]]]:
    """All of the package: where each stands, and how it is used."""
    used: dict[str, set[str]] = {}
    for of, use, args, place in calls():
        if use in USES:
            used.setdefault(of.rpartition(".")[2], set()).add(use)
            if of == "re" and isinstance(args[0], ast.Constant):
                yield place, re.compile(args[0].value), (use,)
    seen = set()
    for module in pkgutil.walk_packages([str(PACKAGE)], "phsi_opt."):
        named: dict[str, Any] = {}
        with suppress(ImportError):  # of an extra
            if not module.name.endswith("__main__"):
                named = vars(importlib.import_module(module.name))
        for name, value in named.items():
            for one in value if isinstance(value, tuple | list) else [value]:
                if isinstance(one, re.Pattern) and one not in seen:
                    seen.add(one)
                    uses = used.get(name, {"fullmatch", "match"})
                    yield f"{module.name}.{name}", one, tuple(sorted(uses))


EXPRESSIONS = list(expressions())


def hostile(pattern: str) -> list[str]:
    """Long texts of what an expression names, which it matches nearly."""
    letters = re.findall(r"[^\\\[\]()*+?{}|^$\w]", pattern)
    words = re.findall(r"[A-Za-z]{1,8}", re.sub(r"\\[a-zA-Z]", "", pattern))
    signs = list(dict.fromkeys([*letters, *" ([{a1.,:"]))[:12]
    pairs = [f"{a}{b}" for a in signs[:4] for b in ("1", "a", " ", ":", signs[-1])]
    pairs += [f"{signs[0]}{word} " for word in words]
    units = list(dict.fromkeys([*signs, *words[:8], *pairs, "1,5 ", "a_1/"]))
    texts = []
    for unit in units:
        body = unit * (N // len(unit))
        texts += [f"{body}\n!", f"a{body}", f"1{body[:-1]}x"]
    return texts


@contextmanager
def processor_time(seconds: float) -> Iterator[None]:
    """Fail after so many seconds of processor time; searches notice signals, too."""

    def stop(*_: Any) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def test_every_expression_of_the_package_is_looked_at() -> None:
    names = {place.rpartition(".")[2] for place, _, _ in EXPRESSIONS}
    assert {"NUMBER", "MOMENT", "UNIT", "THOUSANDS", "FACTOR", "ENTRY"} <= names
    assert len(EXPRESSIONS) > 40


@pytest.mark.parametrize(
    ("pattern", "uses"), [pytest.param(*one, id=place) for place, *one in EXPRESSIONS]
)
def test_an_expression_takes_a_time_of_the_first_power(
    pattern: re.Pattern[Any], uses: tuple[str, ...]
) -> None:
    is_bytes = isinstance(pattern.pattern, bytes)
    written = pattern.pattern.decode() if is_bytes else pattern.pattern
    with processor_time(SECONDS):
        for text in hostile(written):
            given: Any = text.encode() if is_bytes else text
            for use in uses:
                if use == "sub":
                    pattern.sub(given[:0], given)
                elif use == "finditer":
                    pattern.findall(given)
                else:
                    getattr(pattern, use)(given)


def table(cell: str, header: str = "q") -> str:
    rows = [f"{k},{k}\n" for k in range(2, 9)]
    return f"t,{header}\n0,1\n1,{cell}\n{''.join(rows)}"


@pytest.mark.parametrize("unit", [
    *("9", "1.", "1,", "a", "(", "[:", "(:", "1/", "m ", "1:", "2020-", "#", "T "),
])  # fmt: skip
def test_cells_and_headers_of_any_length_are_read_at_once(
    unit: str, tmp_path: Path
) -> None:
    text = (unit * N)[:N]
    path = tmp_path / "a.csv"
    with processor_time(2 * SECONDS):
        for odd in (text, f"q ({text}x)"):
            Header.of(odd)
            unit_in(odd)
            did_you_mean(odd, [odd[::-1], odd[1:]])
        path.write_text(table("1", f'"{odd}"'))
        for written in (table(f"{text}x"), f"{text}\n{table('1')}"):
            with suppress(ph.DataError):
                survey(path)
            with suppress(ph.DataError):
                ph.Measurements.from_csv(io.StringIO(written), time=1, states={"q": 0})
            path.write_text(written)


def test_a_table_of_many_columns_with_like_names_is_looked_at_at_once(tmp_path) -> None:
    path = tmp_path / "a.csv"
    names = [f"q{k:b}".translate({48: "!", 49: "?"}) for k in range(2000)]
    rows = [",".join(str((k * n) % 7) for k in range(2000)) for n in range(3)]
    path.write_text("\n".join([",".join(names), *rows]))
    with processor_time(2 * SECONDS):
        survey(path)


def test_hundreds_of_columns_of_texts_are_looked_at_at_once(tmp_path: Path) -> None:
    names = ",".join(f"s{k}" for k in range(400))
    texts = ",".join(["S/N: 1"] * 400)
    path = tmp_path / "wide.csv"
    rows = [f"{k},{k**2},{texts}\n" for k in range(5)]
    path.write_text(f"t,q,{names}\n{''.join(rows)}")
    with processor_time(2 * SECONDS):
        assert [one.said for one in survey(path).columns][-1] == 'text: "S/N: 1"'
