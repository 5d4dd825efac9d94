"""From a CSV file of measurements to a better model: compare, see where it fails, name
what is missing, add it.

The file holds the position of a damped spring in several runs. The model has a spring
and viscous damping; the measurements hold something more.
"""

import time

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import phsi_opt as ph
from phsi_opt.presentation.report import report_text
from problems.examples.friction_spring import CSV, NOISE, TRUTH
from problems.tools.provenance import RESULTS, write


def measurements() -> ph.Measurements:
    """The file that ships with the project."""
    return ph.Measurements.from_csv(
        CSV,
        time="t_s",
        states={"q": "position_m", "p": None},
        trajectory="run",
        units={"t": "s", "q": "m", "p": "kg m/s"},
    )


def model() -> ph.PseudoHamiltonian:
    """Spring, mass and viscous damping; the mass was weighed."""
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula(
            "k*q**2/2 + p**2/(2*m)",
            k=ph.Parameter(10.0, lower=0, unit="N/m"),
            m=TRUTH["m"],
        ),
        R=ph.damping("p"),
    )


def pictures(study: ph.Study, before: ph.Comparison, diagnosis: ph.Diagnosis) -> None:
    """The four pictures of the story, in results/."""
    RESULTS.mkdir(exist_ok=True)
    plots = {
        "demo_1_before": before.plot,
        "demo_2_missing_force": diagnosis.plot,
        "demo_3_after": study.compare().plot,
        "demo_4_history": study.plot_history,
    }
    for name, plot in plots.items():
        figure, ax = plt.subplots(figsize=(8.0, 3.8), layout="constrained")
        plot(ax)
        figure.savefig(RESULTS / f"{name}.png", dpi=110)
        plt.close(figure)


def main() -> ph.Study:
    """Run the story and write it down."""
    began = time.perf_counter()
    data = measurements()
    train, held_out = data.split(0.6)
    print(f"{data}\n")
    study = ph.Study(
        model(), train, held_out, progress=lambda line: print(f"... {line}", flush=True)
    )
    before, first = study.compare(), study.fit
    print(f"\n{first}\n\n{before}\n")
    diagnosis = study.diagnose()
    print(f"\n{diagnosis}\n")
    study.auto()
    print(
        f"\n{study.fit}\n\n{study.history.to_string(index=False)}\n\nstopped: {study.stopped}\n"
    )
    found = study.fit.parameters.set_index("name")
    for name, truth in (
        ("coulomb_friction_p", TRUTH["f"]),
        ("R_p", TRUTH["c"]),
        ("k", TRUTH["k"]),
    ):
        if name in found.index:
            row = found.loc[name]
            print(
                f"{name}: {row.value:.4g} +- {row.std_error:.2g}, true {truth:g}, "
                f"{abs(row.value - truth) / row.std_error:.1f} standard errors away"
            )
    pictures(study, before, diagnosis)
    write("demo.md", f"{report_text(study)}\nTrue noise: {NOISE:.0%} of the range.")
    print(f"report and pictures: results/demo*; {time.perf_counter() - began:.0f} s")
    return study


if __name__ == "__main__":
    main()
