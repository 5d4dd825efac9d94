"""Are standard errors on measured machines honest? Estimates from halves of a record.

Every measured set (`sets`) is cut into two disjoint halves in three ways: first and
second half, alternating windows, windows dealt at random from a fixed seed. The model
is fitted to both with the default loss. Where the standard errors are right, the
differences of the estimates over their own standard errors,

    z = (theta_A - theta_B) / sqrt(se_A^2 + se_B^2)

have a root mean square near 1; at most 1.5 is asked for. A parameter that ended at a
bound in one of the halves, or got no standard error, is listed and left out. The
published values of the EMPS drive are then looked for in the intervals of its fits.

Words on the command line choose the sets whose name contains one of them; results are
written only where all sets were measured. ``--white`` shows beside z the one by
standard errors that take the residuals as independent.

    python -m problems.measured.halves [WORD ...] [--white] [--data=FOLDER]
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.measured import machines
from problems.measured.sets import CASES, Case, chosen_cases
from problems.tools import markdown
from problems.tools.command_line import chosen, flag
from problems.tools.kept_tables import rewrite
from problems.tools.pages import render
from problems.tools.provenance import RESULTS, write

FIRST_AND_SECOND, ALTERNATING, DEALT = "first and second", "alternating", "dealt"
CUTS = (FIRST_AND_SECOND, ALTERNATING, DEALT)
SEED = 1  # of the dealing
ALLOWED = 1.5  # root mean square of z
LEVEL = 0.95  # of the intervals
AT_BOUND = "at a bound"
NO_ERROR = "no standard error"

Halves = tuple[ph.Measurements, ph.Measurements]  # without a common sample


# --- records cut in two


def halved(
    data: ph.Measurements,
    size: int | None,
    cut: str,
    is_windowed: bool = False,
    seed: int = SEED,
) -> Halves:
    """The halves by one of the `CUTS`.

    Args:
        data: One or several trajectories.
        size: Samples of a window; None: each trajectory is one window.
        cut: One of `CUTS`.
        is_windowed: Whether first and second half are cut into windows too.
        seed: By which windows are dealt.
    """
    if cut == FIRST_AND_SECOND:
        if size is None:  # the trajectories are shared out
            return data.split(0.5)
        pairs = [data[i].split(0.5) for i in range(len(data))]
        first, second = (
            replace(data, trajectories=tuple(t for part in side for t in part))
            for side in zip(*pairs, strict=True)
        )
        if is_windowed:
            return windows(first, size), windows(second, size)
        return first, second
    pieces = data if size is None else windows(data, size)
    order = np.arange(len(pieces))
    if cut == DEALT:
        order = np.random.default_rng(seed).permutation(len(pieces))
    runs = pieces.trajectories
    first, second = (
        replace(pieces, trajectories=tuple(runs[i] for i in sorted(part)))
        for part in (order[::2], order[1::2])
    )
    return first, second


def windows(data: ph.Measurements, size: int) -> ph.Measurements:
    """Pieces of ``size`` samples without a common one, each a trajectory.

    What is left at the end of a trajectory is left out where it is shorter than half of
    a window.
    """
    pieces = []
    for run in data.trajectories:
        for begin in range(0, run.n_samples - size // 2 + 1, size):
            rows = slice(begin, begin + size)
            name = f"{run.name}, window {begin // size + 1}"
            piece = replace(run, name=name, t=run.t[rows], x=run.x[rows], u=run.u[rows])
            pieces.append(piece)
    return replace(data, trajectories=tuple(pieces))


# --- fits of halves


@dataclass(frozen=True, eq=False)
class Run:
    """A case cut in one way: a row for each parameter, the seconds of the fits, what
    failed.
    """

    set: str
    cut: str
    rows: Sequence[dict[str, object]]
    seconds: tuple[float, ...]
    failure: str = ""


def distance(first: float, second: float, error: float, other: float) -> float:
    """By how many standard errors two independent estimates differ.

    To be compared with a normal distribution: the fits have hundreds of degrees of
    freedom.
    """
    return (first - second) / np.hypot(error, other)


def measured_halves(name: str, case: Case, cut: str) -> Run:
    """Both halves of a record fitted, and every free parameter compared."""
    halves = halved(case.load(), case.window, cut, case.is_windowed)
    fits: list[ph.Fit] = []
    for half in halves:
        try:
            fits.append(case.fit(half))
        except ph.PhsiOptError as error:
            return Run(name, cut, (), tuple(fit.seconds for fit in fits), str(error))
    rows = []
    for parameter in fits[0].names:
        values = [fit.values[parameter] for fit in fits]
        errors = [fit.std_errors[parameter] for fit in fits]
        white, degrees = (
            [float(fit.standard_errors[column][parameter]) for fit in fits]
            for column in ("white noise", "freedom")
        )
        row = {
            "set": name,
            "cut": cut,
            "n_first": len(halves[0]),
            "n_second": len(halves[1]),
            "parameter": parameter,
        }
        pairs = {"": values, "std_error_": errors, "degrees_": degrees}
        for what, pair in pairs.items():
            row |= {f"{what}first": pair[0], f"{what}second": pair[1]}
        row["z"] = distance(*values, *errors)
        row["z_white"] = distance(*values, *white)
        row["left_out"] = NO_ERROR if np.isnan(errors).any() else ""
        if any(parameter in fit.outcome.at_bounds for fit in fits):
            row["left_out"] = AT_BOUND
        rows.append(row)
    return Run(name, cut, rows, tuple(fit.seconds for fit in fits))


def root_mean_square(z: np.ndarray | pd.Series) -> float:
    """NaN where there is none."""
    return float(np.sqrt(np.mean(np.square(z)))) if len(z) else np.nan


def held_values() -> str:
    """Published values of the EMPS drive beside the intervals of fits to the whole
    record and to its windows.
    """
    header = ["fitted to", "parameter", "published", "estimate"]
    header += [f"interval of {LEVEL:.0%}", "published value"]
    lines = []
    for record, window in (("whole record", None), ("windows of 1 s", 100)):
        fit = ph.identify(machines.emps_model(), machines.emps(window=window))
        ends = fit.intervals(LEVEL)[["ci_lower", "ci_upper"]]
        for name, published in machines.EMPS_PUBLISHED.items():
            low, high = map(float, ends.loc[name])
            estimate = f"{fit.values[name]:.3f} +- {fit.std_errors[name]:.2g}"
            said = "holds" if low <= published <= high else "does not hold"
            numbers = (f"{published:.3f}", estimate, f"{low:.3f} to {high:.3f}")
            lines.append([record, name, *numbers, said])
            print(*lines[-1], sep=", ", flush=True)
    return markdown.lines(header, lines)


# --- the page


def page(rows: pd.DataFrame, runs: Sequence[Run], held: str, is_white: bool) -> str:
    """The page in Markdown.

    Args:
        rows: Every parameter of every set and cut.
        runs: Sets and cuts, in the order of the tables.
        held: The EMPS drive's intervals.
        is_white: Whether the distances by plain standard errors are shown too.
    """
    compared = rows[rows["left_out"] == ""]
    by_case = compared.groupby("set")["z"].apply(root_mean_square)
    efforts = []
    for run in runs:
        n = (
            f"{run.rows[0]['n_first']} and {run.rows[0]['n_second']}"
            if run.rows
            else "-"
        )
        seconds = ", ".join(f"{each:.1f}" for each in run.seconds)
        efforts.append([run.set, CASES[run.set].length, run.cut, n, seconds])
    failed = [[run.set, run.cut, run.failure] for run in runs if run.failure]
    fits = ["set, model", "window", "cut", "trajectories", "seconds"]
    messages = markdown.lines(["set, model", "cut", "message"], failed)
    white = {"white": _sizes(compared, "z_white")} if is_white else {}
    return render(
        "measured/pages/halves.md",
        allowed=ALLOWED,
        honest=_sizes(compared, "z"),
        n_kept=int(np.sum(by_case <= ALLOWED)),
        n_sets=len(by_case),
        together=root_mean_square(compared["z"]),
        held=held,
        efforts=markdown.lines(fits, efforts),
        failures=messages if failed else "",
        parameters=_parameters(rows, is_white),
        **white,
    )


def _sizes(compared: pd.DataFrame, column: str) -> str:
    """Root mean squares and n: sets in rows, cuts in columns, all at the end."""
    lines = []
    for name in (*CASES, "all"):
        of_set = compared if name == "all" else compared[compared["set"] == name]
        parts = [of_set[of_set["cut"] == cut][column] for cut in CUTS]
        cells = [name]
        for z in (*parts, of_set[column]):
            cells.append(f"{root_mean_square(z):.2f} (n {len(z)})" if len(z) else "-")
        lines.append(cells)
    return markdown.lines(["set, model", *CUTS, "all cuts"], lines)


def _parameters(rows: pd.DataFrame, is_white: bool) -> str:
    header = ["set, model", "cut", "parameter", "first half", "second half", "z"]
    header += ["z, independent residuals"] if is_white else []
    lines = []
    for row in rows.to_dict("records"):
        cells = [row["set"], row["cut"], row["parameter"]]
        for half in ("first", "second"):
            cells.append(f"{row[half]:.5g} +- {row[f'std_error_{half}']:.2g}")
        for column in ("z", "z_white") if is_white else ("z",):
            cells.append(row["left_out"] or f"{row[column]:.2f}")
        lines.append(cells)
    return markdown.lines(header, lines)


def main(words: list[str], is_white: bool = False) -> pd.DataFrame:
    """All rows of the sets whose name contains one of the words; of all by default."""
    runs = []
    for name, case in chosen_cases(words).items():
        for cut in CUTS:
            run = measured_halves(name, case, cut)
            runs.append(run)
            _tell(run, is_white)
    rows = pd.DataFrame([row for run in runs for row in run.rows])
    if {run.set for run in runs} == set(CASES):
        rewrite(RESULTS / "halves.csv", rows, "%.6g")
        write("halves.md", page(rows, runs, held_values(), is_white))
    return rows


def _tell(run: Run, is_white: bool) -> None:
    seconds = ", ".join(f"{each:.1f} s" for each in run.seconds)
    print(f"{run.set}, {run.cut}: {seconds} {run.failure}", flush=True)
    if run.rows:
        rows = pd.DataFrame(run.rows)
        columns = ["parameter", "first", "second", "std_error_first"]
        columns += ["std_error_second", "z", *(["z_white"] if is_white else [])]
        shown = rows[[*columns, "left_out"]]
        print(shown.to_string(index=False, float_format="{:.4g}".format))
        z = rows["z"][rows["left_out"] == ""]
        print(f"root mean square of z: {root_mean_square(z):.2f}, n {len(z)}")


if __name__ == "__main__":
    main(chosen(), flag("white"))
