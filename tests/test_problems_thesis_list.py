"""docs/thesis.md lists everything of the thesis, and what it names is there; the grids'
question is answered by their numbers.
"""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs" / "thesis.md").read_text("utf-8")
FIGURES = ["3.1", "5.1", *[f"6.{k}" for k in range(1, 17)]]
FIGURES += [f"A.{k}" for k in range(1, 5)]
TABLES = ["6.1", "6.2", "6.3", "6.4", "A.1"]
LAST_EQUATION = {2: 42, 3: 7, 4: 34, 5: 15, 6: 7}


def section(title: str) -> str:
    return TEXT.split(f"## {title}\n")[1].split("\n## ")[0]


def first_cells(text: str) -> list[str]:
    cells = re.findall(r"^\| ([^|]+) \|", text, re.MULTILINE)
    return [cell for cell in cells if re.match(r"[\dA]", cell)]


def listed(text: str) -> list[str]:
    """Numbers in the first column, ranges such as 2.1-2.24 written out."""
    found = []
    for cell in first_cells(text):
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
    missing = [
        name for name in names if not any((place / name).exists() for place in places)
    ]
    assert not missing
    for line in section("Figures").splitlines():
        for script in re.findall(r"\| `(\w+)(?: \w+)?` \|", line):
            assert (ROOT / "problems" / "thesis" / f"{script}.py").exists()


def test_the_numbers_beside_those_of_the_thesis_cover_its_tables_and_pages() -> None:
    from problems.thesis.side_by_side import main

    made = main(quick=True)
    for place in ("Figure 5.1", "Table 6.1", "Table 6.2", "Table 6.3"):
        assert f"| {place} |" in made
    for figures in ("6.9, 6.10", "6.15, 6.16", "A.1, A.2", "A.3, A.4"):
        assert f"Figures {figures}" in made
    # 0.124 of q2 p1^2, which is not there in truth; 0.569 for 1
    assert "PHSI 0.124, SSINN 0.431" in made
    assert "H 1.1%, r 18%" in made  # 4.96 for 4.905, 0.041 for 0.05


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ((1.0, 0.9, 0.8), "neither"),
        ((1.0, 0.9, 0.01), "helps (100 times)"),
        ((1.0, 5.0, np.inf), "hurts (5 times)"),
        ((1.0, np.inf, np.inf), "hurts"),
        ((np.inf, 2.0, np.inf), "helps (alone gives a model)"),
        ((np.inf, np.inf, np.inf), "no model"),
    ],
)
def test_whether_sparsity_helps_follows_from_the_errors(
    errors: tuple[float, ...], expected: str
) -> None:
    from problems.thesis.grid_verdicts import verdict

    assert verdict(pd.Series(errors, ["least", "middle", "most"])) == expected


def test_the_price_of_l1_is_that_of_the_truth_over_that_of_nothing() -> None:
    from problems.thesis.grid_readings import READINGS, mean_square_rate, price
    from problems.thesis.systems import SYSTEMS

    system = SYSTEMS["schrodinger"]
    data = system.data(3, 0.0, n=2)
    here, _, summed = READINGS
    rates = [np.diff(run.x, axis=0) / system.step for run in data.trajectories]
    nothing = np.mean(np.sum(np.concatenate(rates) ** 2, axis=1))
    assert mean_square_rate(data) == pytest.approx(nothing)
    # |xi| of H sums to 10; the code's mean over four states
    assert price(system, data, 0.5, here) == pytest.approx(0.5 * 4 * 10 / nothing)
    ratio = price(system, data, 0.5, here) / price(system, data, 0.5, summed)
    assert ratio == pytest.approx(4 * 32)
