"""Every example of the how-to pages runs."""

from inspect import signature
from pathlib import Path

import pytest

from phsi_opt.learning.hybrid_network import NeuralForce
from tests.doc_pages import (
    DOCS,
    HOW_TO,
    name_of,
    pages,
    run_as_shown,
)

LONG = (
    *("without_python", "closed_loop", "many_fits", "dictionary"),
    *("house", "input", "own_effect", "blocks"),
)


def how_tos() -> list[object]:
    """The pages, the long ones marked."""
    found: list[object] = []
    for page in pages():
        if page.parent == DOCS / HOW_TO:
            marks = [pytest.mark.slow] if page.stem in LONG else []
            found.append(pytest.param(page, marks=marks, id=name_of(page)))
    return found


@pytest.mark.parametrize("page", how_tos())
def test_the_examples_of_a_how_to_run_and_print_what_it_shows(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    _, *settings = signature(NeuralForce).parameters.values()
    # A network need not be good here.
    brief = [8 if one.name == "epochs" else one.default for one in settings]
    monkeypatch.setattr(NeuralForce.__init__, "__defaults__", tuple(brief))
    assert run_as_shown(page) > 0
