"""The cascaded tanks: two levels, of which the lower alone is measured, and what
overflows.

Data: pump voltage u and level of the lower tank (V), every 4 s; one record of 1024
samples to fit, one to test. The level reads 10 V at most, so samples of the fit at 10 V
are taken as missing. That the lower tank overflows there too is this model's
assumption.

    dh1/dt = k4 u - q0 - out1 - c over(h1 - rim1)
    dh2/dt = out1 - out2 + s c over(h1 - rim1) - c2 over(h2 - 10 V)

A part s of what the upper tank spills falls into the lower one. ``over`` is a ramp with
its corner rounded over 0.1 V. The textbook's outflows are square roots of the levels;
the last model has a linear upper outflow (a thin pipe) and a lower outflow that ends at
a level which the sensor does not show as zero. The structure was chosen on the last 30
% of the fit record, the test was looked at only to report. A study then starts from the
textbook's model alone and has to find what it lacks.

    python -m problems.measured.cascaded_tanks [FILE]
"""

import sys
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

import phsi_opt as ph
from problems.measured.story import page, told
from problems.tools.data_paths import folder
from problems.tools.provenance import write

SAMPLING = 4.0  # s
FULL = 10.0  # V
N_FIRST = 50  # samples from which the starting state of the test is estimated
PUBLISHED = "Published test rmse: linear 0.75, Volterra 0.54, neural 0.33 to 0.40, grey box with overflow 0.18 V."
# Rough values: each outflow empties its tank in a few minutes, a rim at the height of
# the sensor's limit.
START = {
    "k1": 0.01,
    "k4": 0.05,
    "q0": 0.05,
    "c": 0.5,
    "rim1": 10.0,
    "k3": 0.03,
    "h0": 2.0,
    "s": 0.5,
    "c2": 0.5,
}
UPPER = {
    "k1": 1,
    "k4": 1,
    "q0": 0.2,
    "c": 2,
    "rim1": 80,
    "k3": 1,
    "h0": 2.9,
    "s": 1,
    "c2": 2,
}
FIRST_LEVELS = (6.0, 5.0)  # V, where the search for the test's starting levels begins
WINDOW = 60.0  # s, the first windows on the way to the whole record


def load(path: Path, record: str, censored: bool = True) -> ph.Measurements:
    """Record 'Est' or 'Val': h1 never measured, h2 in V, missing at the sensor's limit
    if ``censored``; pump u in V.
    """
    table = np.genfromtxt(path, delimiter=",", names=True)
    u, y = table[f"u{record}"], table[f"y{record}"].copy()
    if censored:
        y[y >= FULL - 1e-3] = np.nan
    return ph.Measurements.from_arrays(
        SAMPLING * np.arange(len(y)),
        np.column_stack([np.full(len(y), np.nan), y]),
        u[:, None],
        states=["h1", "h2"],
        inputs=["u"],
        hold="zero",
        units={"h1": "V", "h2": "V", "u": "V", "t": "s"},
    )


def textbook() -> ph.FirstOrder:
    """Pump, two square-root outflows, no overflow."""
    k1, k3, k4 = (
        ph.Parameter(value, lower=0, upper=1) for value in (0.046, 0.03, 0.024)
    )
    return ph.FirstOrder(
        ["h1", "h2"],
        {
            "h1": ph.formula(f"k4*u - k1*{_root('h1')}", k1=k1, k4=k4),
            "h2": ph.formula(f"k1*{_root('h1')} - k3*{_root('h2')}", k1=k1, k3=k3),
        },
        inputs=["u"],
    )


def model() -> ph.FirstOrder:
    """Both overflows, linear upper outflow, square-root lower outflow from the level
    h0, constant loss q0.
    """
    p = {
        name: ph.Parameter(value, lower=0, upper=UPPER[name])
        for name, value in START.items()
    }
    spilled, over = f"c*{_over('h1', 'rim1')}", _over("h2", str(FULL))
    upper = ("k1", "k4", "q0", "c", "rim1")
    lower = ("k1", "k3", "h0", "c", "rim1", "s", "c2")
    return ph.FirstOrder(
        ["h1", "h2"],
        {
            "h1": ph.formula(
                f"k4*u - q0 - k1*h1 - {spilled}", **{name: p[name] for name in upper}
            ),
            "h2": ph.formula(
                f"k1*h1 - k3*{_root('(h2 - h0)')} + s*{spilled} - c2*{over}",
                **{n: p[n] for n in lower},
            ),
        },
        inputs=["u"],
    )


def _root(level: str) -> str:
    return f"{level}*({level}**2 + 0.01)**(-0.25)"


def _over(level: str, rim: str) -> str:
    return f"({level} - {rim} + sqrt(({level} - {rim})**2 + 0.01))/2"


def starting_levels(fit: ph.Fit, run: ph.Trajectory, n_samples: int) -> np.ndarray:
    """The levels from which a free run fits the first ``n_samples`` of a record best."""
    t, y, u = run.t[:n_samples], run.x[:n_samples, 1], run.u[:n_samples]
    seen = y < FULL - 1e-3
    found = least_squares(
        lambda x0: (fit.simulate(t, x0, u)[:, 1] - y)[seen],
        FIRST_LEVELS,
        bounds=(0.1, 20.0),
        diff_step=1e-4,
        max_nfev=12,
    )
    return found.x


def test_error(fit: ph.Fit, run: ph.Trajectory, x0: np.ndarray) -> float:
    """Root mean square error (V) over every sample of a record, the free run cut at the
    sensor's limit.
    """
    h2 = np.minimum(fit.simulate(run.t, x0, run.u)[:, 1], FULL)
    return float(np.sqrt(np.mean((h2 - run.x[:, 1]) ** 2)))


def main(path: Path) -> dict[str, dict[str, float]]:
    """Test errors (V) per model, with the starting state from the first samples and
    from the whole record.
    """
    if not path.exists():
        print(
            f"skipped: the data are not at {path}; give the file, or set PHSI_OPT_DATA"
        )
        return {}
    data = load(path, "Est")
    (test,) = load(path, "Val", censored=False).trajectories
    fits = {
        "textbook": ph.identify(textbook(), data, loss=ph.MaximumLikelihood()),
        "with overflows": ph.identify(
            model(), data, loss=ph.MaximumLikelihood(window=WINDOW)
        ),
    }
    errors: dict[str, dict[str, float]] = {}
    rows = []
    for name, fit in fits.items():
        errors[name] = {
            label: test_error(fit, test, starting_levels(fit, test, n))
            for label, n in (
                (f"first {N_FIRST} samples", N_FIRST),
                ("whole record", test.n_samples),
            )
        }
        numbers = (fit.noise["h2"], *errors[name].values())
        rows.append(f"| {name} | " + " | ".join(f"{e:.3f}" for e in numbers) + " |")
        print(rows[-1], fit, f"{fit.seconds:.0f} s", sep="\n", flush=True)
    story = told(textbook(), *data.split(0.7))
    tests = {
        "test": [
            ph.compare(step.fit, load(path, "Val")).rmse for step in story.study.steps
        ]
    }
    print(story.study.history.to_string(index=False), tests, sep="\n", flush=True)
    text = (
        "The base model is the textbook's: two square-root outflows. The first 70 % of the fit record are fitted, the "
        "last 30 % judge; the test is only looked at, without its samples at 10 V and its starting state estimated "
        "from all of it."
    )
    lines = [
        "# Cascaded tanks",
        "",
        "Root mean square errors in V. Fit: samples at 10 V are missing. Test: every sample, one free run cut at 10 V, "
        f"its starting state estimated from the first {N_FIRST} samples or from the whole record.",
        "",
        "| model | fit | test, start from the first samples | test, start from the whole record |",
        "| --- | --- | --- | --- |",
        *rows,
        "",
        PUBLISHED,
        "",
        f"The last model starts from rough values and goes through windows of {WINDOW:g} s. Its structure was chosen "
        "among some twenty on the last 30 % of the fit record; two of its parts are empirical, the constant loss q0 "
        "and the level h0 at which the lower outflow ends. The published 0.18 V is not reached.",
        "",
        "```text",
        str(fit),
        "```",
        "",
        page(story, "cascaded_tanks", text, tests),
    ]
    write("cascaded_tanks.md", "\n".join(lines))
    return errors


if __name__ == "__main__":
    found = main(
        Path(sys.argv[1])
        if len(sys.argv) > 1
        else folder("cascaded_tanks") / "dataBenchmark.csv"
    )
    if found:
        reached = found["with overflows"][f"first {N_FIRST} samples"]
        assert reached <= 0.33, f"test rmse {reached:.3f} V, expected 0.33 V or less"
