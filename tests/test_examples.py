"""Every example in a public docstring runs, and prints what it shows.

In the examples ``ph`` is the package, ``np`` is NumPy, and ``data``, ``train``, ``test``,
``model``, ``fit`` and ``study`` belong to a spring with dry friction (``docs/data/spring.csv``).
"""

import doctest
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from tests.doc_pages import first_difference

SPRING = Path(__file__).parents[1] / "docs" / "data" / "spring.csv"


class Checker(doctest.OutputChecker):
    """Numbers may differ by a unit of the last digit shown."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        return not first_difference(want.replace("<BLANKLINE>", ""), got)


def public_objects() -> Iterator[tuple[str, Any]]:
    """Public functions and classes, and the public methods that the classes define."""
    for name in ph.__all__:
        value = getattr(ph, name)
        yield name, value
        if inspect.isclass(value):
            for method, function in vars(value).items():
                if not method.startswith("_"):
                    yield f"{name}.{method}", getattr(function, "__func__", function)


def examples() -> dict[str, doctest.DocTest]:
    """The docstrings that have an example, by the name of what they describe."""
    parser = doctest.DocTestParser()
    found = {}
    for name, value in public_objects():
        text = inspect.getdoc(value) or ""
        if ">>>" in text:
            found[name] = parser.get_doctest(text, {}, name, None, 0)
    return found


EXAMPLES = examples()


@pytest.fixture(scope="module")
def spring() -> dict[str, Any]:
    data = ph.Measurements.from_csv(
        SPRING,
        time="t_s",
        trajectory="run",
        states={"q": "position_m", "p": None},
        units={"t": "s", "q": "m", "p": "kg m/s"},
    )
    train, test = data.split(0.7)
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/(2*m)", k=ph.Parameter(10.0, lower=0), m=2.5),
        R=ph.damping("p"),
    )
    complete = model.add("coulomb friction", "p")
    fit = ph.identify(complete, train)
    study = ph.Study(complete, train, held_out=test)
    names = {"data": data, "train": train, "test": test, "model": model, "fit": fit}
    return {"ph": ph, "np": np, "study": study, **names}


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_prints_what_it_shows(name, spring, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    example = EXAMPLES[name]
    example.globs = dict(spring)
    report: list[str] = []
    runner = doctest.DocTestRunner(checker=Checker(), verbose=False)
    runner.run(example, out=report.append)
    assert not report, "".join(report)


def test_every_public_function_has_an_example() -> None:
    functions = [name for name in ph.__all__ if inspect.isfunction(getattr(ph, name))]
    assert len(functions) > 10
    assert [name for name in functions if name not in EXAMPLES] == []
