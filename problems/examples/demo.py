"""From a CSV file of measurements to a better model: compare, see where it fails, name
what is missing, add it.

The file holds the position of a damped spring in several runs. The model has a spring
and viscous damping; the measurements hold something more.

    python -m problems.examples.demo
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

import phsi_opt as ph
from phsi_opt.presentation.html_report import markdown_report
from problems.examples.friction_spring import CSV, NOISE, TRUTH
from problems.tools.pictures import plt, save
from problems.tools.provenance import RESULTS, write

TRAINING_SHARE = 0.6  # of the runs
# How the columns of the file are to be read; nobody measured p.
COLUMNS: dict[str, Any] = {
    "time": "t_s",
    "states": {"q": "position_m", "p": None},
    "trajectory": "run",
}
# Parameters of the last model by the names of the truth.
TRUE_NAMES = {"coulomb_friction_p": "f", "R_p": "c", "k": "k"}


def measurements(path: Path = CSV) -> ph.Measurements:
    """The file that ships with the project, or another."""
    units = {"t": "s", "q": "m", "p": "kg m/s"}
    return ph.Measurements.from_csv(path, **COLUMNS, units=units)


def model() -> ph.PseudoHamiltonian:
    """Spring, mass and viscous damping; the mass was weighed."""
    stiffness = ph.Parameter(10.0, lower=0, unit="N/m")
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/(2*m)", k=stiffness, m=TRUTH["m"]),
        R=ph.damping("p"),
    )


def pictures(study: ph.Study, before: ph.Comparison, diagnosis: ph.Diagnosis) -> None:
    """The pictures of the story, in results/."""
    plots: dict[str, Callable[[Axes], object]] = {
        "demo_1_before": before.plot,
        "demo_2_missing_force": diagnosis.plot,
        "demo_3_after": study.compare().plot,
        "demo_4_history": study.plot_history,
        "demo_5_friction": partial(study.plot_effect, study.added[0], None),
    }
    for name, plot in plots.items():
        figure, ax = plt.subplots(figsize=(8.0, 3.8), layout="constrained")
        plot(ax)
        save(figure, f"{name}.png", dpi=110)


def beside_the_truth(fit: ph.Fit) -> list[str]:
    """The parameters that were found, with their distance from the truth."""
    said = []
    for name, symbol in TRUE_NAMES.items():
        if name in fit.values:
            value = fit.values[name]
            error = fit.std_errors[name]
            distance = abs(value - TRUTH[symbol]) / error
            said.append(
                f"{name}: {value:.4g} +- {error:.2g}, true {TRUTH[symbol]:g}, "
                f"{distance:.1f} standard errors away"
            )
    return said


def main() -> ph.Study:
    """Run the story and write it down."""
    began = time.perf_counter()
    data = measurements()
    train, held_out = data.split(TRAINING_SHARE)
    print(f"{data}\n")
    title = "Damped spring with hidden friction"
    say = partial(print, "...", flush=True)
    study = ph.Study(model(), train, held_out, progress=say, title=title)
    before = study.compare()
    print(f"\n{study.fit}\n\n{before}\n")
    diagnosis = study.diagnose()
    print(f"\n{diagnosis}\n")
    study.auto()
    print(f"\n{study.fit}\n\n{study.history.to_string(index=False)}\n")
    print(f"stopped: {study.stopped}\n")
    print(*beside_the_truth(study.fit), sep="\n")
    pictures(study, before, diagnosis)
    report = markdown_report(study.content())
    write("demo.md", f"{report}\nTrue noise: {NOISE:.0%} of the range.")
    study.report(RESULTS / "demo.html")
    print(f"report and pictures: results/demo*; {time.perf_counter() - began:.0f} s")
    return study


if __name__ == "__main__":
    main()
