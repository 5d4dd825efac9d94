"""Tables of the coverage benchmark: scenarios in rows, methods in columns."""

from collections.abc import Callable

import pandas as pd

from problems.benchmarks.coverage_fits import MANY, ONE, SCENARIOS, SEVERAL
from problems.benchmarks.coverage_summary import LIMIT, METHODS, PHYSICAL
from problems.benchmarks.disturbed_oscillator import TRUTH
from problems.tools import markdown

LAYOUTS = {"one run": ONE, "4 runs": SEVERAL, "16 runs": MANY}
UNDISTURBED = "none"
# Always the same nonlinearity, so always the same bias: a stress test.
FIXED = [name for name, found in SCENARIOS.items() if found.cubic_share]
ASKED_FOR = [name for name in SCENARIOS if name not in (*FIXED, UNDISTURBED)]

Cell = Callable[[pd.DataFrame], str]


def coverage_table(rows: pd.DataFrame) -> str:
    """Coverages with their numbers of seeds."""
    return _table(rows, _coverage)


def numbers_table(rows: pd.DataFrame, column: str, form: str) -> str:
    """A column's numbers of all parameters."""

    def cell(found: pd.DataFrame) -> str:
        return _numbers(found, column, form)

    return _table(rows, cell)


def _coverage(found: pd.DataFrame) -> str:
    return f"{_numbers(found, 'coverage', '.1f')} (n {found['n'].iloc[0]})"


def _numbers(found: pd.DataFrame, column: str, form: str) -> str:
    by_parameter = found.set_index("parameter")[column]
    if by_parameter.isna().all():
        return "-"
    return " / ".join(format(by_parameter[name], form) for name in TRUTH)


def _table(rows: pd.DataFrame, cell: Cell) -> str:
    """Scenarios and runs in rows; truths too where there are two."""
    has_truth = rows["truth"].nunique() > 1
    header = ["beside the model", "runs", *(["truth"] if has_truth else []), *METHODS]
    lines = []
    for scenario in SCENARIOS:
        for truth in (PHYSICAL, LIMIT):
            for layout in LAYOUTS.values():
                of_line = rows[
                    (rows["scenario"] == scenario)
                    & (rows["truth"] == truth)
                    & (rows["runs"] == layout.runs)
                ]
                if of_line.empty:
                    continue
                head = [scenario, f"{layout.runs} x {layout.samples}"]
                head += [truth] if has_truth else []
                lines.append([*head, *_cells(of_line, cell)])
    return markdown.lines(header, lines)


def _cells(rows: pd.DataFrame, cell: Cell) -> list[str]:
    cells = []
    for method in METHODS:
        found = rows[rows["method"] == method]
        cells.append("-" if found.empty else cell(found))
    return cells
