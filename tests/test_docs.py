"""Every example of the README and docs/ runs, and prints what its page shows.

Those of the how-to pages are tested in `test_how_to`.
"""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from phsi_opt.model.catalogue import EffectChoice
from problems.examples.docs_data import FILES, FOLDER
from tests.doc_pages import (
    DEMO_DATA,
    DOCS,
    HOW_TO,
    ROOT,
    agree,
    first_difference,
    name_of,
    pages,
    run_as_shown,
    run_page,
)
from tests.page_tools import spring_table

RESULT = re.compile(r"`results/(\w+)\.md`")
LINKED = re.compile(r"\]\(measured/(\w+)\.md")
NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?")


@pytest.mark.parametrize(
    "page", [one for one in pages() if one.parent.name != HOW_TO], ids=name_of
)
def test_the_examples_of_a_page_run_and_print_what_it_shows(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
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


def test_every_page_for_users_has_examples() -> None:
    names = {name_of(page) for page in pages()}
    expected = {"index", "tutorial"}
    for folder in ("how_to", "explained"):
        for page in (DOCS / folder).glob("*.md"):
            if page.stem != "index":
                expected.add(name_of(page))
    assert expected <= names
    assert len(expected) >= 20


def test_the_data_of_the_pages_are_what_their_script_writes() -> None:
    for name, table in FILES.items():
        kept = pd.read_csv(FOLDER / name)
        again = table().reset_index(drop=True)
        assert list(kept.columns) == list(again.columns)
        for column in kept.columns:
            if column == "run":
                assert list(kept[column]) == list(again[column])
            else:  # a unit of the last digit written, by rounding
                np.testing.assert_allclose(kept[column], again[column], atol=2e-3)


def text_of_results(names: list[str]) -> str:
    texts = []
    for name in names:
        texts.append((ROOT / "results" / f"{name}.md").read_text("utf-8"))
    return "\n".join(texts)


def test_the_numbers_of_the_gallery_are_those_of_the_pages_it_links() -> None:
    text = (DOCS / "gallery.md").read_text("utf-8")
    sections = text.split("\n## ")[1:]
    n_numbers = 0
    for section in sections:
        known = set(NUMBER.findall(text_of_results(LINKED.findall(section))))
        said = re.sub(r"\]\([^)]*\)", "]", section)  # not the paths of links
        numbers = NUMBER.findall(said)
        assert not set(numbers) - known, section.splitlines()[0]
        n_numbers += len(numbers)
    assert n_numbers > 20


def test_the_files_that_contributors_are_told_of_exist() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    paths = re.findall(r"`([\w./]+/[\w./]*)`", text)
    assert len(paths) > 8
    for path in paths:
        assert (ROOT / path).exists(), path
    for module in re.findall(r"python -m ([\w.]+)", text):
        assert (ROOT / module.replace(".", "/")).with_suffix(".py").exists(), module


def test_the_files_that_the_design_names_exist() -> None:
    text = (DOCS / "design.md").read_text("utf-8")
    assert len(text.splitlines()) <= 150
    paths = re.findall(r"`((?:\w+/)*\w+\.(?:py|md|jinja))`", text)
    assert len(paths) > 12
    for path in paths:
        places = (ROOT, ROOT / "phsi_opt")
        assert any((place / path).exists() for place in places), path


def test_numbers_beside_the_name_of_a_result_stand_there() -> None:
    # Its numbers are tested too.
    evidence = (DOCS / "evidence.md").read_text("utf-8")
    n_numbers = 0
    for page in sorted((DOCS / "explained").glob("*.md")):
        for paragraph in page.read_text("utf-8").split("\n\n"):
            for line in re.split(r"\n- ", paragraph):
                names = RESULT.findall(line)
                numbers = NUMBER.findall(line) if names else []
                known = set(NUMBER.findall(evidence + text_of_results(names)))
                assert not set(numbers) - known, line
                n_numbers += len(numbers)
    assert n_numbers >= 1


@pytest.mark.parametrize(("shown", "printed", "right"), [
    ("k = 1.23", "k = 1.23", True),
    ("k = 1.23", "k = 1.24", False),
    ("k = 1.23", "k = 1.2349", True),
    ("k = 1.23", "k = 1.2351", False),
    ("the error falls", "the error rises", False),
    ("2 runs ...", "2 runs and more", True),
    ("3.0 m ...", "2.98 m and more", True),
    ("3.0 m ...", "2.9 m and more", False),
    ("3 runs ...", "2 runs and more", False),
    ("hysteresis | ...", "hysteresis | lost", True),
    ("hysteresis | ...", "gap | lost", False),
    ("1e-05", "1.4e-05", True),
    ("1e-05", "2e-05", False),
])  # fmt: skip
def test_lines_agree_in_words_and_in_numbers_as_they_are_printed(
    shown: str, printed: str, right: bool
) -> None:
    assert agree(shown, printed) is right


@pytest.mark.parametrize(("shown", "right"), [
    ("one\ntwo\nthree", True),
    ("one\n...\nthree", True),
    ("...\ntwo\n...", True),
    ("one\nthree", False),
    ("one\ntwo", False),
    ("two\none\n...", False),
])  # fmt: skip
def test_shown_lines_must_be_printed_in_their_order(shown: str, right: bool) -> None:
    difference = first_difference(shown, "one\n\ntwo\nthree\n")
    assert (difference == "") is right
