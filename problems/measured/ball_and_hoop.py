"""The ball and hoop drive: which effect does a linear model of the hoop's speed lack?

Data: one speed signal (V) and the motor command (-1 to 1), 0.1 s; random steps to fit,
fixed steps and a closed loop to test. Base model: one state, linear loss, input gain.
The last part of the random steps judges the candidates; the two test files are looked
at only to report.

    python -m problems.measured.ball_and_hoop [FOLDER]
"""

from pathlib import Path

import numpy as np
from scipy.io import loadmat

import phsi_opt as ph
from problems.measured.story import page, told
from problems.tools import markdown
from problems.tools.data_paths import folder, given, is_present
from problems.tools.provenance import write

TESTS = ("fixedStepSequence", "closedLoop")
FITTED_SHARE = 0.7  # of the random steps
# Least squares of simulations, set up by hand for these data: errors (V) on the two
# test files.
BY_HAND = {"linear drag": (1.00, 0.96), "quadratic drag": (0.283, 0.267)}
REACHED = 0.30  # V, what the study must come to on both test files


def load(path: Path) -> ph.Measurements:
    """One file of the benchmark: speed y in V, command u held between the samples."""
    content = loadmat(path)
    return ph.Measurements.from_arrays(
        content["time"].ravel(),
        content["y"].ravel()[:, None],
        content["u"].ravel()[:, None],
        states=["y"],
        inputs=["u"],
        hold="zero",
        units={"y": "V", "t": "s"},
    )


def model() -> ph.PseudoHamiltonian:
    """dy/dt = -r y + b u: kinetic energy y^2/2, linear loss, input gain."""
    return ph.PseudoHamiltonian(
        states=["y"],
        inputs=["u"],
        S=[[0.0]],
        H=ph.formula("y**2/2"),
        R=ph.damping("y"),
        F={"y": ph.formula("b*u", b=ph.Parameter(1.0))},
    )


def main(path: Path) -> dict[str, list[float]]:
    """Free-run errors on the test files per step that the study takes on its own."""
    if not is_present(path):
        return {}
    train, held_out = load(path / "randomStepSequence.mat").split(FITTED_SHARE)
    story = told(model(), train, held_out)
    study = story.study
    errors = {}
    for name in TESTS:
        test = load(path / f"{name}.mat")
        errors[name] = [ph.compare(step.fit, test).rmse for step in study.steps]
    print(study.history.to_string(index=False), errors, sep="\n", flush=True)
    told_so = page(story, "ball_and_hoop", _introduction(), errors)
    write("ball_and_hoop.md", f"# Ball and hoop drive\n\n{told_so}")
    return {name: row[: 1 + story.n_own] for name, row in errors.items()}


def _introduction() -> str:
    by_hand = [
        f"{first:.3g} and {second:.3g} V with {drag}"
        for drag, (first, second) in BY_HAND.items()
    ]
    return markdown.paragraph(f"""
        The base model is dy/dt = -r y + b u. The first {FITTED_SHARE:.0%} of the random
        steps are fitted, the last {1 - FITTED_SHARE:.0%} judge, the two test files are
        only looked at. Least squares by hand, to compare, on the two test files:
        {"; ".join(by_hand)}; worse with Coulomb friction added.
        """)


if __name__ == "__main__":
    found = main(given(folder("ball_and_hoop")))
    for name, row in found.items():
        assert row[-1] <= REACHED, f"{name}: {row[-1]:.3f} V, expected {REACHED} V"
        assert np.all(np.diff(row) <= 0), f"{name}: a step raised the error: {row}"
