"""The demonstration over many noise draws, with the friction and without: what is
named, and how large is it?

python -m problems.benchmarks.friction_seeds [N]
"""

import sys

import pandas as pd

import phsi_opt as ph
from problems.examples.demo import model
from problems.examples.friction_spring import TRUTH, table
from problems.tools.provenance import write


def row(seed: int, friction: float) -> dict[str, object]:
    """One draw: verdict, effects added, friction with its distance from the truth in
    standard errors.
    """
    data = ph.Measurements.from_dataframe(
        table(seed, friction),
        time="t_s",
        states={"q": "position_m", "p": None},
        trajectory="run",
    )
    study = ph.Study(model(), *data.split(0.6))
    first = study.diagnose()
    study.auto()
    last = study.history.iloc[-1]
    result = {
        "seed": seed,
        "hidden": friction,
        "verdict": first.verdict,
        "best": str(first.effects[0]),
        "added": ", ".join(study.history["effect"][1:]),
        "held_out_over_floor": last.held_out_rmse / last.noise_floor,
        "stopped": study.stopped.split(": held")[0],
    }
    if "coulomb_friction_p" in study.fit.values:
        value, error = (
            study.fit.values["coulomb_friction_p"],
            study.fit.std_errors["coulomb_friction_p"],
        )
        result |= {
            "coefficient": value,
            "std_error": error,
            "z": (value - friction) / error,
        }
    return result


def main(n: int) -> pd.DataFrame:
    """n draws with the friction, n without."""
    rows = []
    for friction in (TRUTH["f"], 0.0):
        for seed in range(n):
            rows.append(row(seed, friction))
            print(rows[-1], flush=True)
    frame = pd.DataFrame(rows)
    body = frame.to_string(index=False, float_format=lambda v: f"{v:.3g}")
    write(
        "friction_seeds.md",
        f"# The demonstration over {n} noise draws\n\n```text\n{body}\n```",
    )
    return frame


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
