"""The page of the halves: root mean squares, every parameter, the EMPS drive."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from problems.measured.halves_rows import Run, root_mean_square
from problems.measured.halving import CUTS
from problems.measured.machines import CASES
from problems.measured.published_values import LEVEL, Held
from problems.tools import markdown

ALLOWED = 1.5  # root mean square of z

INTRODUCTION = markdown.paragraph("""
    The training record of every measured set is cut into two disjoint halves, the model
    is fitted to both with the default loss, and every free parameter is compared: z is
    the difference of the two estimates over the standard error of that difference.
    Honest standard errors give a root mean square near 1. First and second: of every
    trajectory; of the battery cell's cycles, the earlier and the later. Alternating and
    dealt: windows with starting states of their own, dealt at random from one fixed
    seed. The halves of the quarter drone are cut into windows always, for its free runs
    drift. n: parameters compared. What ended at a bound in a half, or has no standard
    error, is left out and listed below.
    """)


def page(
    rows: pd.DataFrame, runs: Sequence[Run], held: Sequence[Held], is_white: bool
) -> str:
    """The page in Markdown.

    Args:
        rows: Every parameter of every set and cut, as `Row`.
        runs: Sets and cuts, in the order of the tables.
        held: The EMPS drive's intervals.
        is_white: Whether the distances by plain standard errors are shown too.
    """
    compared = rows[rows["left_out"] == ""]
    parts = ["# Halves of measured records", "", INTRODUCTION, ""]
    parts += [_root_mean_squares(compared, "z"), "", _verdict(compared), ""]
    if is_white:
        parts += ["## By standard errors that take residuals as independent", ""]
        parts += [_root_mean_squares(compared, "z_white"), ""]
    parts += ["## The EMPS drive", "", _holds(held), ""]
    parts += ["## Windows and seconds of the fits", "", _efforts(runs), ""]
    parts += _failures(runs)
    parts += ["## Every parameter", "", _parameters(rows, is_white)]
    return "\n".join(parts)


def _root_mean_squares(compared: pd.DataFrame, column: str) -> str:
    """Sets in rows, cuts in columns, all together at the end."""
    header = ["set, model", *CUTS, "all cuts"]
    lines = []
    for name in CASES:
        lines.append([name, *_cells(compared[compared["set"] == name], column)])
    lines.append(["all", *_cells(compared, column)])
    return markdown.lines(header, lines)


def _cells(compared: pd.DataFrame, column: str) -> list[str]:
    """Root mean square and n per cut and over all cuts."""
    cells = [_size(compared[compared["cut"] == cut][column]) for cut in CUTS]
    return [*cells, _size(compared[column])]


def _size(z: pd.Series) -> str:
    return f"{root_mean_square(z):.2f} (n {len(z)})" if len(z) else "-"


def _verdict(compared: pd.DataFrame) -> str:
    by_case = compared.groupby("set")["z"].apply(root_mean_square)
    n_kept = int(np.sum(by_case <= ALLOWED))
    return markdown.paragraph(f"""
        Asked for: at most {ALLOWED:g}. Over all cuts {n_kept} of {len(by_case)} sets
        with their models keep it; all together
        {root_mean_square(compared["z"]):.2f}.
        """)


def _holds(held: Sequence[Held]) -> str:
    """Published values and intervals of the record of the fit."""
    header = [
        "fitted to",
        "parameter",
        "published",
        "estimate",
        f"interval of {LEVEL:.0%}",
        "published value",
    ]
    lines = []
    for each in held:
        cells = [
            each.record,
            each.parameter,
            f"{each.published:.3f}",
            f"{each.value:.3f} +- {each.std_error:.2g}",
            f"{each.lower:.3f} to {each.upper:.3f}",
            "holds" if each.holds else "does not hold",
        ]
        lines.append(cells)
    return markdown.lines(header, lines)


def _efforts(runs: Sequence[Run]) -> str:
    """Length and number of the windows, seconds of the two fits."""
    header = ["set, model", "window", "cut", "trajectories", "seconds"]
    lines = []
    for run in runs:
        counts = "-"
        if run.rows:
            counts = f"{run.rows[0].n_first} and {run.rows[0].n_second}"
        seconds = ", ".join(f"{each:.1f}" for each in run.seconds)
        lines.append([run.set, CASES[run.set].length, run.cut, counts, seconds])
    return markdown.lines(header, lines)


def _failures(runs: Sequence[Run]) -> list[str]:
    """Fits that failed, with their message; nothing where there is none."""
    failed = [run for run in runs if run.failure]
    if not failed:
        return []
    lines = [[run.set, run.cut, run.failure] for run in failed]
    table = markdown.lines(["set, model", "cut", "message"], lines)
    return ["## Fits that failed", "", table, ""]


def _parameters(rows: pd.DataFrame, is_white: bool) -> str:
    header = ["set, model", "cut", "parameter", "first half", "second half", "z"]
    header += ["z, independent residuals"] if is_white else []
    lines = []
    for row in rows.itertuples(index=False):
        cells = [
            row.set,
            row.cut,
            row.parameter,
            f"{row.first:.5g} +- {row.std_error_first:.2g}",
            f"{row.second:.5g} +- {row.std_error_second:.2g}",
            row.left_out or f"{row.z:.2f}",
        ]
        cells += [row.left_out or f"{row.z_white:.2f}"] if is_white else []
        lines.append(cells)
    return markdown.lines(header, lines)
