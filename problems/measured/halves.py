"""Are standard errors on measured machines honest? Estimates from halves of a record.

Every measured set (`machines`) is cut into two disjoint halves in three ways: first
and second half, alternating windows, windows dealt at random from a fixed seed. The
model is fitted to both with the default loss. Where the standard errors are right, the
differences of the estimates over their own standard errors,

    z = (theta_A - theta_B) / sqrt(se_A^2 + se_B^2)

have a root mean square near 1; at most 1.5 is asked for. A parameter that ended at a
bound in one of the halves, or got no standard error, is listed and left out. The
published values of the EMPS drive are then looked for in the intervals of its fits.

Names on the command line choose the sets whose name contains one of them; results are
written only where all sets were measured. ``--white`` shows beside z the one by
standard errors that take the residuals as independent.

    python -m problems.measured.halves [SET ...] [--white]
"""

from collections.abc import Sequence
from dataclasses import asdict

import pandas as pd

from problems.measured.halves_page import page
from problems.measured.halves_rows import Run, measured_halves, root_mean_square
from problems.measured.halving import CUTS
from problems.measured.machines import CASES
from problems.measured.published_values import held_values
from problems.tools.command_line import chosen, flag
from problems.tools.data_paths import is_present
from problems.tools.kept_tables import rewrite
from problems.tools.provenance import RESULTS, write


def main(names: Sequence[str], is_white: bool = False) -> pd.DataFrame:
    """All rows of the sets whose name contains one of ``names``; of all by default."""
    runs = []
    for name, case in CASES.items():
        is_wanted = any(word.lower() in name.lower() for word in names) or not names
        if not is_wanted or not is_present(case.path):
            continue
        for cut in CUTS:
            run = measured_halves(name, case, cut)
            runs.append(run)
            _tell(run, is_white)
    rows = pd.DataFrame([asdict(row) for run in runs for row in run.rows])
    is_whole = {run.set for run in runs} == set(CASES)
    if is_whole:
        rewrite(RESULTS / "halves.csv", rows, "%.6g")
        write("halves.md", page(rows, runs, held_values(), is_white))
    return rows


def _tell(run: Run, is_white: bool) -> None:
    seconds = ", ".join(f"{each:.1f} s" for each in run.seconds)
    print(f"{run.set}, {run.cut}: {seconds} {run.failure}", flush=True)
    if not run.rows:
        return
    rows = pd.DataFrame([asdict(row) for row in run.rows])
    columns = ["parameter", "first", "second", "std_error_first", "std_error_second"]
    columns += ["z", "z_white", "left_out"] if is_white else ["z", "left_out"]
    print(rows[columns].to_string(index=False, float_format="{:.4g}".format))
    z = rows["z"][rows["left_out"] == ""]
    print(f"root mean square of z: {root_mean_square(z):.2f}, n {len(z)}", flush=True)


if __name__ == "__main__":
    main(chosen(), flag("white"))
