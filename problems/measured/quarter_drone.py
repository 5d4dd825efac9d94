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

from pathlib import Path

import numpy as np

import phsi_opt as ph
from problems.measured.story import page, told
from problems.measured.windows import Record
from problems.tools import markdown
from problems.tools.data_paths import folder, given, is_present
from problems.tools.provenance import write

FILES = {
    "steps": "sinal2_degraus",
    "swept sine": "sinal3_swept_sine",
    "multisine": "sinal4_multiseno",
}
FLYING = (20.0, 80.0)  # s
SAMPLING = 0.01  # s
THIN = 5  # samples
WINDOW = 5.0  # s
UNITS = {"q": "rad", "p": "rad/s", "u": "%", "t": "s"}
# Simulations fitted by hand to the same windows of the steps, to compare: errors in
# degrees.
BY_HAND = {
    "the base model": 8.57,
    "a thrust offset or a thrust of u squared": 2.85,
    "a lag of the motor of some 0.1 s": 2.46,
    "dry friction": 1.17,
}


def load(
    path: Path, record: str, thin: int = THIN, window: float = WINDOW
) -> ph.Measurements:
    """One record in windows that share their ends: angle q in rad, command u in %."""
    file = path / f"{FILES[record]}_malha_fechada.csv"
    table = np.genfromtxt(file, delimiter=",", names=True)
    t = table["Tempo_s"]
    flying = (t >= FLYING[0] - 1e-6) & (t <= FLYING[1] + 1e-6)
    whole = Record(
        t[flying], np.deg2rad(table["Saida_y"][flying]), table["Controle_u"][flying]
    )
    thinned = whole.thinned(thin)
    step = thinned.t[1] - thinned.t[0]
    return thinned.in_windows(round(window / step), UNITS)


def model() -> ph.PseudoHamiltonian:
    """Gravity, damping, and a thrust in proportion to the command."""
    gravity = ph.Parameter(10.0, lower=0)
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        R=ph.damping("p"),
        H=ph.formula("p**2/2 - g*cos(q)", g=gravity),
        F={"p": ph.formula("b*u", b=ph.Parameter(0.2))},
    )


def main(path: Path) -> dict[str, list[float]]:
    """Errors in windows (degrees) per step of the study, per record."""
    if not is_present(path):
        return {}
    story = told(model(), load(path, "steps"), load(path, "multisine"))
    history = story.study.history
    test = load(path, "swept sine")
    swept = []
    for step in story.study.steps:
        swept.append(float(np.rad2deg(ph.compare(step.fit, test).rmse)))
    print(history.to_string(index=False), swept, sep="\n", flush=True)
    degree = np.rad2deg(1.0)
    tests = {"swept sine": swept}
    told_so = page(story, "quarter_drone", _introduction(), tests, degree, "degrees")
    write("quarter_drone.md", f"# Quarter-drone arm\n\n{told_so}")
    return {
        "steps": list(np.rad2deg(history["train_rmse"])),
        "multisine": list(np.rad2deg(history["held_out_rmse"])),
        "swept sine": swept,
    }


def _introduction() -> str:
    by_hand = [f"{error:g} degrees with {what}" for what, error in BY_HAND.items()]
    return markdown.paragraph(f"""
        The base model is a pendulum with damping and a thrust in proportion to the
        command. Fitted are windows of {WINDOW:g} s of the steps, those of the multisine
        judge, the swept sine is only looked at; all are thinned to every {THIN}th
        sample, {1 / (SAMPLING * THIN):g} Hz. Simulations fitted by hand to the same
        windows of the steps: {", ".join(by_hand)}.
        """)


if __name__ == "__main__":
    found = main(given(folder("quarter_drone")))
    for name, row in found.items():
        assert row[-1] < row[0], f"{name}: the study did not lower the error: {row}"
