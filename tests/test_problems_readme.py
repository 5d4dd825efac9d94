"""What README and docs say of results stands on the pages in results/, docs/thesis.md
lists all of the thesis, and each page says how it was made.
"""

import re
from pathlib import Path

import pytest

from problems.examples.friction_spring import TRUTH
from problems.results import Page, pages, sources

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"


def words(path: Path) -> str:
    """A text with every run of blanks as one."""
    return " ".join(path.read_text(encoding="utf-8").split())


@pytest.fixture(scope="module")
def readme() -> str:
    return words(ROOT / "README.md") + words(ROOT / "docs" / "evidence.md")


def test_the_story_ends_as_the_demonstration_did(readme: str) -> None:
    text = (RESULTS / "demo.md").read_text("utf-8")
    # step, effect, training error, held-out error, noise floor, ...
    rows = re.findall(
        r"^[ |]+\d .*?((?:[\d.]+[ |]+){3})", text.split("## Errors")[1], re.M
    )
    errors = [[float(cell) for cell in row.replace("|", " ").split()] for row in rows]
    before, after, floor = errors[0][1], errors[-1][1], errors[-1][2]
    assert f"held-out error {before:.4f} -> {after:.4f} m" in readme
    assert f"noise floor {floor:.4f} m" in readme
    assert f"held out: {before:.3f} m, while the noise is {floor:.3f} m" in readme
    friction = re.search(r"equation of p \(([\d.]+) \+- ([\d.]+) N\)", text)
    assert friction is not None
    size, error = float(friction[1]), float(friction[2])
    assert (
        f"equation of p ({size:.2f} +- {error:.2f} N; true: {TRUTH['f']:g} N)" in readme
    )


# ---- claims

PARTS = re.compile(r"\n(?=- |\n|#)")  # begin before points, paragraphs and headings
NUMBER = re.compile(r"(?<![\w./-])\d+(?:\.(\d+))?(?:e(-?\d+))?(?!\w)")


def claims() -> list[tuple[str, str, set[Path]]]:
    """The places of the docs that name pages of results: name, text and pages."""
    found = []
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        if path.name == "thesis.md" or "_build" in path.parts:  # a list of numbers
            continue
        for part in PARTS.split(path.read_text("utf-8")):
            named = re.findall(r"`(?:results/)?([\w/]+\.md)`", part)
            if named:
                beside = (RESULTS, RESULTS / "thesis", RESULTS / "judges")
                paths = [place / name for name in named for place in beside]
                found.append((path.stem, part, set(filter(Path.exists, paths))))
    return found


def numbers(text: str) -> list[re.Match[str]]:
    """The numbers of a text, without those of code; a blank may part thousands."""
    return list(NUMBER.finditer(re.sub(r"`[^`]*`|(?<=\d) (?=\d{3}\b)", "", text)))


def test_every_number_of_a_claim_stands_on_its_page_as_printed_or_rounded() -> None:
    wrong = []
    for name, text, paths in claims():
        printed = [
            float(one[0]) for p in paths for one in NUMBER.finditer(p.read_text())
        ]
        for number in numbers(text):
            digits, power = number[1] or "", int(number[2] or 0)
            is_whole = not digits and not number[2]
            half = 0.0 if is_whole else 0.5001 * 10.0 ** (power - len(digits))
            if not any(abs(float(number[0]) - one) <= half for one in printed):
                wrong.append(f"{name}: {number[0]} in {text[:60]!r}")
    assert not wrong


def test_every_point_of_the_evidence_names_its_page() -> None:
    points = re.findall(r"^- .*", (ROOT / "docs" / "evidence.md").read_text(), re.M)
    without = [one for one in points if ".md" not in one]
    assert len(points) > 20
    assert not without


@pytest.mark.parametrize("path", sorted(RESULTS.rglob("*.md")), ids=lambda p: p.stem)
def test_the_command_at_the_head_of_a_result_is_a_module_of_the_project(path) -> None:
    from importlib.util import find_spec

    head = path.read_text("utf-8").splitlines()[0]
    found = re.match(r"<!-- command: python (-m ([\w.]+)|-c)", head)
    assert found is not None, head
    if found[2]:
        assert find_spec(found[2]) is not None, head


# ---- pages that are out of date


def page(commit: str) -> Page:
    command = "python -m problems.examples.demo"
    return Page(Path("page.md"), command, commit, 1.0)


def test_every_page_but_those_of_the_tests_says_what_made_it() -> None:
    named = {one.path for one in pages()}
    assert len(named) > 20
    assert set((ROOT / "results").rglob("*.md")) - named == set()


def test_a_script_needs_what_its_imports_need() -> None:
    names = {str(path.relative_to(ROOT)) for path in sources("problems.examples.demo")}
    assert "phsi_opt/estimation/identify.py" in names  # by phsi_opt/__init__.pyi
    assert "problems/examples/demo.py" in names
    assert not any(name.startswith("problems/thesis") for name in names)


def test_a_page_of_an_unknown_commit_is_not_current() -> None:
    assert page("0123456").state == "commit 0123456 is unknown"


# ---- the list of the thesis

TEXT = (ROOT / "docs" / "thesis.md").read_text("utf-8")
FIGURES = ["3.1", "5.1", *[f"6.{k}" for k in range(1, 17)]]
FIGURES += [f"A.{k}" for k in range(1, 5)]
TABLES = ["6.1", "6.2", "6.3", "6.4", "A.1"]
LAST_EQUATION = {2: 42, 3: 7, 4: 34, 5: 15, 6: 7}


def section(title: str) -> str:
    return TEXT.split(f"## {title}\n")[1].split("\n## ")[0]


def listed(text: str) -> list[str]:
    """Numbers in the first column, ranges such as 2.1-2.24 written out."""
    found = []
    for cell in re.findall(r"^\| ([\dA][^|]*) \|", text, re.MULTILINE):
        for part in cell.split(", "):
            first, _, last = part.partition("-")
            found.append(first)
            if last:
                chapter, number = first.split(".")
                end = int(last.split(".")[1])
                found += [f"{chapter}.{k}" for k in range(int(number) + 1, end + 1)]
    return found


def test_every_figure_table_and_equation_is_listed_once() -> None:
    assert sorted(listed(section("Figures"))) == sorted(FIGURES)
    assert sorted(listed(section("Tables"))) == sorted(TABLES)
    equations = [f"{c}.{k}" for c, n in LAST_EQUATION.items() for k in range(1, n + 1)]
    algorithms = [str(k) for k in range(1, 7)]
    expected = sorted(equations + algorithms)
    assert sorted(listed(section("Equations and algorithms"))) == expected


def test_scripts_pages_and_modules_that_are_named_exist() -> None:
    names = set(re.findall(r"`([\w/]+\.(?:md|png|py))`", TEXT))
    assert len(names) > 30
    places = [ROOT, ROOT / "results" / "thesis", ROOT / "phsi_opt"]
    places += [ROOT / "problems" / "thesis", ROOT / "phsi_opt" / "learning"]
    assert not [n for n in names if not any((place / n).exists() for place in places)]
    scripts = re.findall(r"\| `(\w+)(?: \w+)?` \|", section("Figures"))
    assert len(scripts) > 10
    for script in scripts:
        assert (ROOT / "problems" / "thesis" / f"{script}.py").exists()
