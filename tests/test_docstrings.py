"""What docstrings say: a first line, and to users shapes of arrays and errors raised.

Users see what `phsi_opt` exports, the baselines and what a network learns. Names inside
a room need a docstring only where they do not say enough themselves.
"""

import ast
import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import phsi_opt
from phsi_opt import errors

WIDTH = 88
QUOTES = len('"""')
PACKAGE = Path(phsi_opt.__file__).parent
ARRAY = re.compile(r"\bndarray\b")
# Such as (n_samples,), (n_nodes, n_states), (2 n, 2 n), (3, n_states), (..., n).
SHAPE = re.compile(r"\((\.\.\.|\d+|(\d ?)?[nmk](_\w+)?)( [-+*] \w+)*,")
CONSTRUCTORS = ("__init__", "__post_init__")
ERRORS = {
    name
    for name, value in vars(errors).items()
    if inspect.isclass(value) and issubclass(value, errors.PhsiOptError)
}

Function = ast.FunctionDef
Raised = Mapping[str, set[str]]


@dataclass(frozen=True)
class Documented:
    """A public module, class, function, method or property, as it stands in a file."""

    name: str
    docstring: str
    column: int = 0
    context: str = ""
    annotations: str = ""
    raised: frozenset[str] = frozenset()

    @property
    def has_first_line(self) -> bool:
        lines = self.docstring.splitlines()
        if not lines or not lines[0].endswith("."):
            return False
        is_alone = len(lines) == 1 or not lines[1].strip()
        # A docstring of one line has the closing quotes on it too.
        n_quotes = 1 if len(lines) > 1 else 2
        width = self.column + n_quotes * QUOTES + len(lines[0])
        return is_alone and width <= WIDTH

    @property
    def has_shapes(self) -> bool:
        if not ARRAY.search(self.annotations):
            return True
        return SHAPE.search(self.docstring + self.context) is not None

    @property
    def has_errors(self) -> bool:
        after = self.docstring.partition("Raises:")[2]
        return all(f"{name}:" in after for name in self.raised)


@cache
def documented() -> tuple[Documented, ...]:
    """All that is public in the package."""
    found: list[Documented] = []
    for path in sorted(PACKAGE.rglob("*.py")):
        tree = ast.parse(path.read_text())
        if tree.body:  # the files __init__ of the rooms are empty
            parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
            found += _of_module(".".join(parts), tree)
    return tuple(found)


def _of_module(name: str, tree: ast.Module) -> Iterator[Documented]:
    raised = _raised_by_name(tree)
    yield Documented(name, ast.get_docstring(tree) or "")
    for node in _public(tree.body):
        own_name = f"{name}.{node.name}"
        if isinstance(node, Function):
            yield _of_function(own_name, node, raised, "")
            continue
        yield _of_class(own_name, node, raised)
        context = ast.get_docstring(node) or ""
        for method in _public(node.body):
            if isinstance(method, Function):
                method_name = f"{own_name}.{method.name}"
                yield _of_function(method_name, method, raised, context)


def _public(body: Sequence[ast.stmt]) -> Iterator[Function | ast.ClassDef]:
    for node in body:
        if not isinstance(node, Function | ast.ClassDef):
            continue
        if not node.name.startswith("_"):
            yield node


def _of_function(name: str, node: Function, raised: Raised, context: str) -> Documented:
    return Documented(
        name,
        ast.get_docstring(node) or "",
        node.body[0].col_offset,
        context,
        _annotations(node),
        frozenset(_raised_in(node, raised)),
    )


def _of_class(name: str, node: ast.ClassDef, raised: Raised) -> Documented:
    annotations = []
    errors_raised: set[str] = set()
    for part in node.body:
        if isinstance(part, ast.AnnAssign):
            is_public = not ast.unparse(part.target).startswith("_")
            annotations.append(ast.unparse(part.annotation) if is_public else "")
        if isinstance(part, Function) and part.name in CONSTRUCTORS:
            annotations.append(_annotations(part))
            errors_raised |= _raised_in(part, raised)
    return Documented(
        name,
        ast.get_docstring(node) or "",
        node.body[0].col_offset,
        annotations=" ".join(annotations),
        raised=frozenset(errors_raised),
    )


def _annotations(node: Function) -> str:
    arguments = node.args
    named = arguments.posonlyargs + arguments.args + arguments.kwonlyargs
    nodes = [argument.annotation for argument in named]
    nodes.append(node.returns)
    return " ".join(ast.unparse(part) for part in nodes if part is not None)


def _raised_by_name(tree: ast.Module) -> Raised:
    """Errors that each function of a file raises itself, by the function's name."""
    found: dict[str, set[str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, Function):
            found.setdefault(node.name, set()).update(_raised_in(node, {}))
    return found


def _raised_in(node: Function, raised: Raised) -> set[str]:
    found = set()
    for part in ast.walk(node):
        if isinstance(part, ast.Raise) and isinstance(part.exc, ast.Call):
            found.add(ast.unparse(part.exc.func))
        elif isinstance(part, ast.Call):
            called = ast.unparse(part.func).rsplit(".", 1)[-1]
            if called.startswith("_"):
                found |= raised.get(called, set())
    return found & ERRORS


def test_the_audit_sees_the_package() -> None:
    names = {one.name for one in documented()}
    assert len(names) > 900
    assert "phsi_opt.estimation.identify.identify" in names
    assert "phsi_opt.study.study.Study.compare" in names


def for_users() -> list[Documented]:
    """What users see, each with the methods of its class."""
    exported = [f"{module}.{name}" for name, module in phsi_opt.MODULES.items()]
    exported += ["phsi_opt.baselines", "phsi_opt.learning.hybrid"]
    found = []
    for one in documented():
        if any(f"{one.name}.".startswith(f"{name}.") for name in exported):
            found.append(one)
    assert len(found) > 200
    return found


def test_every_docstring_begins_with_a_sentence_on_one_line() -> None:
    seen = for_users()
    said = [one for one in documented() if one.docstring or one in seen]
    assert [one.name for one in said if not one.has_first_line] == []


def test_docstrings_for_users_say_the_shapes_of_arrays() -> None:
    assert [one.name for one in for_users() if not one.has_shapes] == []


def test_docstrings_for_users_say_which_errors_are_raised() -> None:
    assert [one.name for one in for_users() if not one.has_errors] == []


def test_every_public_name_has_its_place_on_one_page_for_users() -> None:
    pages = PACKAGE.parent / "docs" / "api"
    text = "\n".join(page.read_text() for page in sorted(pages.glob("*.rst")))
    on_pages = re.findall(r"^\.\. auto\w+:: (\w+)$", text, re.MULTILINE)
    assert sorted(on_pages) == sorted(phsi_opt.__all__)


def test_no_first_line_of_a_property_reads_as_a_type_and_its_text():
    """The site takes "A: b." for the type A, and finds none of that name."""
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, Function) and not node.name.startswith("_"):
                first = (ast.get_docstring(node) or "").split("\n")[0]
                is_property = any(
                    "property" in ast.dump(d) for d in node.decorator_list
                )
                assert not (is_property and re.match(r"[^`]*: ", first)), (path, first)
