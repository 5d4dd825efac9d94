"""The rooms keep their order, and the code stays readable: one thought a line."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "phsi_opt"

# Measured in the same way on five codebases that are worth imitating (optimistix,
# diffrax, lmfit, pysindy, tinygp): 4.4 to 7.8 syntax nodes a line of code, at most 2
# comprehensions per 100 lines, tuples of values packed into one assignment in at most
# 1.5 % of assignments.
MOST_NODES_A_LINE = 7.0
MOST_COMPREHENSIONS = 2.8  # per 100 lines of code
MOST_PACKED = 0.01  # share of assignments

COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
Node = ast.Module | ast.ClassDef | ast.FunctionDef


def test_a_room_imports_only_from_rooms_below_it_and_nothing_in_a_circle(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    status = lint_imports(no_cache=True)
    assert status == EXIT_STATUS_SUCCESS, capsys.readouterr().out


def test_the_init_files_of_the_rooms_are_empty_of_imports() -> None:
    for init in PACKAGE.glob("*/__init__.py"):
        if init.parent.name == "study":
            continue  # phsi_opt.study.Study is a promise, from when it was one file
        names = [n for n in ast.walk(ast.parse(init.read_text())) if _imports(n)]
        assert not names, f"{init.relative_to(ROOT)} imports; leave it empty"


def test_a_line_of_the_package_carries_one_thought() -> None:
    n_nodes = n_lines = n_comprehensions = n_assignments = n_packed = 0
    for path in PACKAGE.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        tree = ast.parse(source)
        n_lines += _lines_of_code(source, tree)
        for node in ast.walk(tree):
            n_nodes += not isinstance(node, ast.expr_context)
            n_comprehensions += isinstance(node, COMPREHENSIONS)
            n_assignments += isinstance(node, ast.Assign)
            n_packed += _is_packed(node)
    assert n_nodes / n_lines <= MOST_NODES_A_LINE
    assert 100 * n_comprehensions / n_lines <= MOST_COMPREHENSIONS
    assert n_packed / n_assignments <= MOST_PACKED


def _imports(node: ast.AST) -> bool:
    return isinstance(node, ast.Import | ast.ImportFrom)


def _is_packed(node: ast.AST) -> bool:
    """Whether several values are assigned to several names at once: a, b = x, y."""
    if not isinstance(node, ast.Assign):
        return False
    return isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)


def _lines_of_code(source: str, tree: ast.Module) -> int:
    """Lines that are neither blank, nor a comment, nor of a docstring."""
    lines = [line.strip() for line in source.splitlines()]
    n_lines = sum(bool(line) and not line.startswith("#") for line in lines)
    for docstring in _docstrings(tree):
        text = lines[docstring.lineno - 1 : docstring.end_lineno]
        n_lines -= sum(bool(line) and not line.startswith("#") for line in text)
    return n_lines


def _docstrings(tree: ast.Module) -> Iterator[ast.Expr]:
    for node in ast.walk(tree):
        if isinstance(node, Node) and ast.get_docstring(node) is not None:
            first = node.body[0]
            assert isinstance(first, ast.Expr)
            yield first


def test_a_constant_has_one_name_and_one_value() -> None:
    values: dict[str, set[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        for name, value in _constants(path):
            values.setdefault(name, set()).add(value)
    twice = {name for name, found in values.items() if len(found) > 1}
    assert twice <= {"FORMAT"}, "the format of each kind of file is its own, no other"


def test_every_limit_of_the_diagnosis_is_explained_and_used() -> None:
    criteria = PACKAGE / "criteria.py"
    lines = criteria.read_text(encoding="utf-8").splitlines()
    code = [p.read_text(encoding="utf-8") for p in PACKAGE.rglob("*.py")]
    explained = False
    for line in lines[lines.index('"""', 1) + 1 :]:
        explained = "#" in line or (explained and bool(line))
        name = line.split(" = ")[0]
        if " = " in line and name.isupper():
            assert explained, f"criteria.{name} has no reason"
            n_files = sum(name in text for text in code)
            assert n_files > 1, f"criteria.{name} is not used"


def _constants(path: Path) -> Iterator[tuple[str, str]]:
    """Names and values, as written, of the constants of a file."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            if name.isupper() and len(name) > 1:
                yield name, ast.unparse(node.value)
