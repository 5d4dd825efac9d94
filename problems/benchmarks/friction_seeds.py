"""The demonstration over many noise draws, with the friction and without: what is
named, and how large is it?

    python -m problems.benchmarks.friction_seeds [N]
"""

import pandas as pd

import phsi_opt as ph
from problems.examples.demo import COLUMNS, TRAINING_SHARE, model
from problems.examples.friction_spring import TRUTH, table
from problems.tools import markdown
from problems.tools.command_line import chosen
from problems.tools.provenance import write

N_DRAWS = 10
HIDDEN = "coulomb friction on p"
PARAMETER = "coulomb_friction_p"


def row(seed: int, friction: float) -> dict[str, object]:
    """One draw: verdict, effects added, friction with its distance from the truth in
    standard errors.
    """
    data = ph.Measurements.from_dataframe(table(seed, friction), **COLUMNS)
    study = ph.Study(model(), *data.split(TRAINING_SHARE))
    first = study.diagnose()
    study.auto()
    last = study.history.iloc[-1]
    found = {
        "seed": seed,
        "hidden": friction,
        "verdict": first.verdict,
        "best": str(first.effects[0]),
        "added": ", ".join(study.history["effect"][1:]),
        "held_out_over_floor": last.held_out_rmse / last.noise_floor,
        "stopped": study.stopped.split(": held")[0],
    }
    if PARAMETER not in study.fit.values:
        return found
    value = study.fit.values[PARAMETER]
    error = study.fit.std_errors[PARAMETER]
    z = (value - friction) / error
    return {**found, "coefficient": value, "std_error": error, "z": z}


def reading(frame: pd.DataFrame) -> str:
    """What the table says, in a sentence."""
    with_friction = frame[frame["hidden"] > 0]
    without = frame[frame["hidden"] == 0]
    named = with_friction["added"].eq(HIDDEN).sum()
    quiet = without["verdict"].eq(ph.Verdict.NOTHING_MISSING).sum()
    farthest = with_friction["z"].abs().max()
    return markdown.paragraph(f"""
        With the friction hidden, it alone is added in {named} of {len(with_friction)}
        draws, at most {farthest:.2f} standard errors from the truth; without it,
        {quiet} of {len(without)} verdicts are "{ph.Verdict.NOTHING_MISSING}".
        """)


def page(frame: pd.DataFrame) -> str:
    """The result as Markdown."""
    n_draws = frame["seed"].nunique()
    lines = [f"# The demonstration over {n_draws} noise draws", ""]
    lines += [reading(frame), "", *markdown.frame(frame)]
    return "\n".join(lines)


def main(n: int) -> pd.DataFrame:
    """n draws with the friction, n without."""
    rows = []
    for friction in (TRUTH["f"], 0.0):
        for seed in range(n):
            rows.append(row(seed, friction))
            print(rows[-1], flush=True)
    frame = pd.DataFrame(rows)
    write("friction_seeds.md", page(frame))
    return frame


if __name__ == "__main__":
    given = chosen()
    main(int(given[0]) if given else N_DRAWS)
