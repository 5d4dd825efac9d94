"""The quarter-drone arm, a pendulum with a propeller: what does the simplest model of
it lack?

Data: angle (degrees) and command to the motor (%), 100 Hz, in a closed loop; steps to
fit, multisines to judge, a swept sine to test. Used are 20 to 80 s, where the arm
flies. Only the angle is measured:

    dq/dt = p
    dp/dt = -g sin(q) - d p + b u

The states are in radians, their scale is that of a unit inertia. A study starts from
this model and has to find what it lacks. The arm is nearly undamped beside its
controller and free runs drift, so the records are cut into windows of `WINDOW` seconds
with free starting states. They are thinned to every `THIN`-th sample, the command to
its mean in between.

    python -m problems.measured.quarter_drone [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

import phsi_opt as ph
from problems.measured.story import page, told
from problems.tools.data_paths import folder
from problems.tools.provenance import write

FILES = {
    "steps": "sinal2_degraus",
    "swept sine": "sinal3_swept_sine",
    "multisine": "sinal4_multiseno",
}
FLYING = (20.0, 80.0)  # s
THIN = 5  # samples of 0.01 s
WINDOW = 5.0  # s
REFERENCE = (
    "Simulations fitted by hand to 5-second windows of the steps: 8.57 degrees for the base model, 2.85 with a thrust "
    "offset or a thrust of u squared, 2.46 with a lag of the motor of some 0.1 s, 1.17 with dry friction."
)


def load(
    path: Path, record: str, thin: int = THIN, window: float = WINDOW
) -> ph.Measurements:
    """One record in windows that share their ends: angle q in rad, command u in %."""
    table = np.genfromtxt(
        path / f"{FILES[record]}_malha_fechada.csv", delimiter=",", names=True
    )
    flying = (table["Tempo_s"] >= FLYING[0] - 1e-6) & (
        table["Tempo_s"] <= FLYING[1] + 1e-6
    )
    t, q, u = (table[name][flying] for name in ("Tempo_s", "Saida_y", "Controle_u"))
    n = (len(t) - 1) // thin
    u = u[: n * thin].reshape(n, thin).mean(axis=1)
    u, t, q = (
        np.r_[u, u[-1]],
        t[: n * thin + 1 : thin],
        np.deg2rad(q[: n * thin + 1 : thin]),
    )
    x = np.column_stack([q, np.full(len(q), np.nan)])
    size = round(window / (t[1] - t[0]))
    pieces = [slice(i, i + size + 1) for i in range(0, n - size // 2, size)]
    return ph.Measurements.from_arrays(
        [t[p] for p in pieces],
        [x[p] for p in pieces],
        [u[p][:, None] for p in pieces],
        states=["q", "p"],
        inputs=["u"],
        hold="zero",
        units={"q": "rad", "u": "%", "t": "s"},
    )


def model() -> ph.PseudoHamiltonian:
    """Gravity, damping, and a thrust in proportion to the command."""
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        R=ph.damping("p"),
        H=ph.formula("p**2/2 - g*cos(q)", g=ph.Parameter(10.0, lower=0, unit="1/s^2")),
        F={"p": ph.formula("b*u", b=ph.Parameter(0.2))},
    )


def main(path: Path) -> dict[str, list[float]]:
    """Errors in windows (degrees) per step of the study, per record."""
    if not path.exists():
        print(
            f"skipped: the data are not at {path}; give their folder, or set PHSI_OPT_DATA"
        )
        return {}
    story = told(model(), load(path, "steps"), load(path, "multisine"))
    steps = story.study.steps
    swept = [
        float(np.rad2deg(ph.compare(step.fit, load(path, "swept sine")).rmse))
        for step in steps
    ]
    print(story.study.history.to_string(index=False), swept, sep="\n", flush=True)
    text = (
        f"The base model is a pendulum with damping and a thrust in proportion to the command. Fitted are windows of "
        f"{WINDOW:g} s of the steps, those of the multisine judge, the swept sine is only looked at; all are thinned "
        f"to every {THIN}th sample, {100 / THIN:g} Hz. {REFERENCE}"
    )
    told_so = page(
        story, "quarter_drone", text, {"swept sine": swept}, np.rad2deg(1.0), "degrees"
    )
    write("quarter_drone.md", f"# Quarter-drone arm\n\n{told_so}")
    history = story.study.history
    return {
        "steps": list(np.rad2deg(history["train_rmse"])),
        "multisine": list(np.rad2deg(history["held_out_rmse"])),
        "swept sine": swept,
    }


if __name__ == "__main__":
    found = main(Path(sys.argv[1]) if len(sys.argv) > 1 else folder("quarter_drone"))
    for name, row in found.items():
        assert row[-1] < row[0], f"{name}: the study did not lower the error: {row}"
