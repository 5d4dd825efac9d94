"""Which pages in results/ are out of date (problems/results.py)."""

from pathlib import Path

import pytest

from problems.results import ROOT, Page, pages, sources
from problems.tools.provenance import provenance


def page(commit: str) -> Page:
    command = "python -m problems.examples.demo"
    return Page(Path("page.md"), command, commit, 1.0)


def test_every_page_but_those_of_the_tests_says_what_made_it() -> None:
    named = {one.path for one in pages()}
    assert len(named) > 30
    assert set((ROOT / "results").rglob("*.md")) - named == set()


def test_a_script_needs_what_its_imports_need() -> None:
    names = {str(path.relative_to(ROOT)) for path in sources("problems.examples.demo")}
    assert "phsi_opt/estimation/identify.py" in names  # by phsi_opt/__init__.pyi
    assert "problems/examples/demo.py" in names
    assert not any(name.startswith("problems/thesis") for name in names)


def test_a_module_that_is_not_there_is_named() -> None:
    with pytest.raises(FileNotFoundError, match=r"problems\.nothing"):
        sources("problems.nothing")


def test_a_page_of_an_unknown_commit_is_not_current() -> None:
    assert page("0123456").state == "commit 0123456 is unknown"


def test_a_new_page_has_all_that_its_head_needs() -> None:
    from problems.results import HEAD

    found = HEAD.match(f"<!-- {provenance()} -->".replace("pytest", "python -m x"))
    assert found is not None
    assert found["seconds"] is not None
