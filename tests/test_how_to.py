"""Every example of the how-to pages and of the README runs."""

import shutil
from inspect import signature
from pathlib import Path

import pytest

from phsi_opt.learning.hybrid_network import NeuralForce
from phsi_opt.model.catalogue import EffectChoice
from tests.doc_pages import (
    DEMO_DATA,
    DOCS,
    HOW_TO,
    ROOT,
    name_of,
    pages,
    run_as_shown,
    run_page,
)
from tests.page_tools import spring_table

LONG = (
    *("without_python", "closed_loop", "many_fits", "dictionary"),
    *("house", "input", "own_effect"),
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


@pytest.mark.slow
def test_the_examples_of_the_readme_run_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "problems" / "examples" / "data" / "friction_spring.csv"
    data.parent.mkdir(parents=True)
    data.write_bytes(spring_table())
    shipped = tmp_path / DEMO_DATA.relative_to(ROOT)
    shutil.copytree(DEMO_DATA, shipped)
    (shipped / data.name).write_bytes(spring_table())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    all_of_them = EffectChoice.candidates
    monkeypatch.setattr(  # the first is the friction, a few others lose to it
        EffectChoice, "candidates", lambda *given: all_of_them(*given)[:4]
    )
    run_page(ROOT / "README.md")
    assert (tmp_path / "report.html").exists()
