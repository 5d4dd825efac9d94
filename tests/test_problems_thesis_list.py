"""docs/thesis.md lists everything of the thesis, and what it names is there."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
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


def test_the_numbers_beside_those_of_the_thesis_are_those_of_the_pages() -> None:
    from problems.thesis.side_by_side import main

    made = main(quick=True)
    assert made in TEXT
    for place in ("Figure 5.1", "Table 6.1", "Table 6.2", "Table 6.3"):
        assert f"| {place} |" in made
    for figures in ("6.9, 6.10", "6.15, 6.16", "A.1, A.2", "A.3, A.4"):
        assert f"Figures {figures}" in made
    # 0.124 of q2 p1^2, which is not there in truth; 0.569 for 1
    assert "PHSI 0.124, SSINN 0.431" in made
    assert "H 1.1%, r 18%" in made  # 4.96 for 4.905, 0.041 for 0.05


def test_no_page_says_that_nobody_can_make_it_again() -> None:
    pages = list((ROOT / "results").rglob("*.md"))
    assert len(pages) > 20
    for page in pages:
        assert "python -c" not in page.read_text(encoding="utf-8"), page
