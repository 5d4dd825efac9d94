"""Chaotic systems over many Lyapunov times: Lorenz and a double pendulum, 10 % noise.

python -m problems.benchmarks.chaos [--quick] [--page] [--seeds=N] [experiment ...]     (rows are
kept in results/chaos.csv)

A trajectory computed from a guessed start leaves the measured one after a few Lyapunov
times, so least squares on simulations has countless local minima. Maximum likelihood
with the states as unknowns has no such trouble; the same sensitivity that spoils a
prediction makes the parameters precise.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.tools.command_line import chosen, flag, option
from problems.tools.provenance import RESULTS, write

N_SEEDS, FIRST_SEED, WITHIN = 20, 7000, 1.959964
TABLE = RESULTS / "chaos.csv"
COLUMNS = [
    "experiment",
    "seed",
    "parameter",
    "truth",
    "estimate",
    "std_error",
    "seconds",
    "iterations",
    "outcome",
]


@dataclass(frozen=True)
class Chaos:
    """A chaotic system, what is measured of it for how long, and the model.
    ``lyapunov``: its largest exponent.

    ``noise`` is relative to each channel's standard deviation, that of ``angles`` after
    full turns are taken off. ``steps``: integration steps between two samples (None:
    chosen by the package).
    """

    title: str
    states: tuple[str, ...]
    rhs: Callable[[float, np.ndarray], np.ndarray]
    start: tuple[float, ...]
    step: float
    n_steps: int
    lyapunov: float
    truth: Mapping[str, float]
    model: Callable[[], ph.Model]
    measured: tuple[str, ...]
    noise: float = 0.1
    angles: tuple[str, ...] = ()
    steps: int | None = None

    @property
    def times(self) -> np.ndarray:
        """The sampling times."""
        return np.linspace(0.0, self.n_steps * self.step, self.n_steps + 1)

    def solve(self) -> np.ndarray:
        """The true states (n_samples, n_states)."""
        t = self.times
        return solve_ivp(
            self.rhs, (t[0], t[-1]), self.start, "DOP853", t, rtol=1e-12, atol=1e-12
        ).y.T

    def spread(self, x: np.ndarray) -> np.ndarray:
        """What the noise is relative to, (n_states,)."""
        turned = np.isin(self.states, self.angles)
        return np.where(turned, np.angle(np.exp(1j * x)), x).std(axis=0)

    def data(self, seed: int) -> ph.Measurements:
        """Measurements of a seed."""
        x = self.solve()
        y = x + self.noise * self.spread(x) * np.random.default_rng(seed).normal(
            size=x.shape
        )
        y[:, ~np.isin(self.states, self.measured)] = np.nan
        return ph.Measurements.from_arrays([self.times], [y], states=self.states)


# --- Lorenz

SIGMA, RHO, BETA = 10.0, 28.0, 8 / 3
LORENZ_TRUTH = {"sigma": SIGMA, "rho": RHO, "beta": BETA}


def _lorenz(t: float, x: np.ndarray) -> np.ndarray:
    return np.array(
        [SIGMA * (x[1] - x[0]), x[0] * (RHO - x[2]) - x[1], x[0] * x[1] - BETA * x[2]]
    )


def lorenz_model() -> ph.FirstOrder:
    """Three numbers unknown, each started at 1."""
    rates = {
        "x": ph.formula("sigma*(y - x)", sigma=ph.Parameter(1.0)),
        "y": ph.formula("x*(rho - z) - y", rho=ph.Parameter(1.0)),
        "z": ph.formula("x*y - beta*z", beta=ph.Parameter(1.0)),
    }
    return ph.FirstOrder(["x", "y", "z"], rates)


def lorenz_dictionary() -> ph.FirstOrder:
    """All polynomials of degree 2 in every equation: 30 numbers unknown, no starts."""
    states = ("x", "y", "z")
    return ph.FirstOrder(
        states,
        {name: ph.polynomials(states, degree=2, constant=True) for name in states},
    )


def _dictionary_truth() -> dict[str, float]:
    truth = dict.fromkeys(lorenz_dictionary().free, 0.0)
    return truth | {
        "F_x[x]": -SIGMA,
        "F_x[y]": SIGMA,
        "F_y[x]": RHO,
        "F_y[y]": -1.0,
        "F_y[x*z]": -1.0,
        "F_z[x*y]": 1.0,
        "F_z[z]": -BETA,
    }


# --- double pendulum: angles a, b from the vertical, momenta pa, pb; both rods of length 1 m, driven at the upper joint

MASS_1, MASS_2, GRAVITY, FRICTION = 1.0, 0.7, 9.81, 0.02
DRIVE, DRIVE_FREQUENCY = 6.0, 2.5
PENDULUM_TRUTH = {"m1": MASS_1, "m2": MASS_2, "R_pa": FRICTION, "R_pb": FRICTION}
PENDULUM_ENERGY = (
    "(m2*pa**2 + (m1 + m2)*pb**2 - 2*m2*pa*pb*cos(a - b))/(2*m2*(m1 + m2*sin(a - b)**2))"
    " - (m1 + m2)*g*cos(a) - m2*g*cos(b)"
)


def _pendulum(t: float, x: np.ndarray) -> np.ndarray:
    a, b, pa, pb = x
    s, c, total = np.sin(a - b), np.cos(a - b), MASS_1 + MASS_2
    size = MASS_1 + MASS_2 * s**2
    va = (pa - pb * c) / size
    vb = (total / MASS_2 * pb - pa * c) / size
    kinetic = (MASS_2 * pa**2 + total * pb**2 - 2 * MASS_2 * pa * pb * c) / (
        2 * MASS_2 * size
    )
    turn = pa * pb * s / size - kinetic * 2 * MASS_2 * s * c / size
    drive = DRIVE * np.sin(DRIVE_FREQUENCY * t)
    pa_rate = -turn - total * GRAVITY * np.sin(a) - FRICTION * va + drive
    return np.array(
        [va, vb, pa_rate, turn - MASS_2 * GRAVITY * np.sin(b) - FRICTION * vb]
    )


def pendulum_model() -> ph.PseudoHamiltonian:
    """Both masses and both dampings unknown; lengths, gravity and drive known."""
    masses = {"m1": ph.Parameter(0.5, lower=0.05), "m2": ph.Parameter(0.5, lower=0.05)}
    return ph.PseudoHamiltonian(
        states=["a", "b", "pa", "pb"],
        S=ph.canonical(2),
        H=ph.formula(PENDULUM_ENERGY, g=GRAVITY, **masses),
        R=ph.damping("pa", "pb"),
        F={"pa": ph.formula(f"{DRIVE}*sin({DRIVE_FREQUENCY}*t)")},
    )


def lorenz(
    title: str,
    measured: tuple[str, ...],
    steps: int | None = 1,
    dictionary: bool = False,
    n_steps: int = 1500,
) -> Chaos:
    """Lorenz sampled every 0.02 s.

    One SRK4 step between the samples is accurate enough: estimates with 2 and 4 differ
    by less than 0.03 standard errors.
    """
    truth, model = (
        (_dictionary_truth(), lorenz_dictionary)
        if dictionary
        else (LORENZ_TRUTH, lorenz_model)
    )
    return Chaos(
        title,
        ("x", "y", "z"),
        _lorenz,
        (-5.0, -6.0, 22.0),
        0.02,
        n_steps,
        0.906,
        truth,
        model,
        measured,
        steps=steps,
    )


EXPERIMENTS = {
    "lorenz_xyz": lorenz("Lorenz, x, y and z measured", ("x", "y", "z")),
    "lorenz_x": lorenz("Lorenz, x alone measured", ("x",)),
    "lorenz_xyz_steps": lorenz(
        "Lorenz, x, y and z measured, integration steps chosen by the package",
        ("x", "y", "z"),
        steps=None,
    ),
    "lorenz_dictionary": lorenz(
        "Lorenz, x, y and z measured, all 30 coefficients of degree 2",
        ("x", "y", "z"),
        dictionary=True,
    ),
    "pendulum": Chaos(
        "Driven double pendulum, angles and momenta measured",
        ("a", "b", "pa", "pb"),
        _pendulum,
        (1.2, 1.9, 0.0, 0.0),
        0.02,
        1500,
        0.8,
        PENDULUM_TRUTH,
        pendulum_model,
        ("a", "b", "pa", "pb"),
        angles=("a", "b"),
        steps=1,
    ),
}


def fits(name: str, seed: int) -> list[tuple[object, ...]]:
    """A row per parameter."""
    case = EXPERIMENTS[name]
    began, values, errors, iterations, outcome = (
        time.perf_counter(),
        {},
        {},
        np.nan,
        "solved",
    )
    try:
        fit = ph.identify(
            case.model(), case.data(seed), ph.MaximumLikelihood(steps=case.steps)
        )
        values, errors, iterations = fit.values, fit.std_errors, fit.outcome.iterations
    except (
        Exception
    ) as error:  # whatever goes wrong is a fit that failed, and is counted
        outcome = f"{type(error).__name__}: {str(error)[:200]}"
    seconds = time.perf_counter() - began
    return [
        (
            name,
            seed,
            key,
            v,
            values.get(key, np.nan),
            errors.get(key, np.nan),
            seconds,
            iterations,
            outcome,
        )
        for key, v in case.truth.items()
    ]


def main(
    names: list[str] | None = None, n_seeds: int = N_SEEDS, keep: bool = True
) -> pd.DataFrame:
    """All seeds of the named experiments that are not in the table yet."""
    table = (
        pd.read_csv(TABLE) if keep and TABLE.exists() else pd.DataFrame(columns=COLUMNS)
    )
    done = set(zip(table["experiment"], table["seed"], strict=True))
    rows: list[Any] = table.values.tolist()
    for name in names or list(EXPERIMENTS):
        for seed in range(FIRST_SEED, FIRST_SEED + n_seeds):
            if (name, seed) not in done:
                rows += fits(name, seed)
                table = pd.DataFrame(rows, columns=COLUMNS)
                if keep:
                    RESULTS.mkdir(exist_ok=True)
                    table.to_csv(TABLE, index=False, float_format="%.10g")
                print(
                    f"... {name}, seed {seed}: {rows[-1][-1]}, {rows[-1][-3]:.1f} s",
                    flush=True,
                )
    if keep:
        page()
    return table


def scores(table: pd.DataFrame) -> pd.DataFrame:
    """A row per parameter: errors over the seeds, in units and in standard errors;
    failed fits have no error.
    """
    error = table["estimate"] - table["truth"]
    table = table.assign(
        error=error,
        z=error / table["std_error"],
        covered=error.abs() <= WITHIN * table["std_error"],
    )
    by = table.groupby("parameter", sort=False)
    rms = by["error"].apply(lambda e: np.sqrt(np.mean(e**2)))
    truth = by["truth"].first()
    return pd.DataFrame(
        {
            "truth": truth,
            "rmse": rms,
            "rmse, relative": rms / truth.abs().where(truth != 0),
            "std_error": by["std_error"].mean(),
            "z, root mean square": by["z"].apply(lambda z: np.sqrt(np.mean(z**2))),
            "z, mean": by["z"].mean(),
            "z, largest": by["z"].apply(lambda z: z.abs().max()),
            "coverage": by["covered"].mean(),
        }
    )


def page() -> None:
    """The page from the table."""
    table = pd.read_csv(TABLE)
    lines = ["# Chaos: parameters from many Lyapunov times", ""]
    lines += [
        "Noise of 10 % of each channel's standard deviation (angles: after full turns are taken off), level unknown.",
        "Every start is generic (1; masses 0.5; dictionary and damping: none). z = (estimate - truth)/std_error. A fit",
        "that failed has no error; it is counted, and its intervals count as not holding the truth.",
        "",
    ]
    for name, case in EXPERIMENTS.items():
        rows = table[table["experiment"] == name]
        if rows.empty:
            continue
        fits_ = rows.groupby("seed").first()
        duration = case.n_steps * case.step
        lines += [
            f"## {case.title}",
            "",
            f"{duration:g} s, {case.n_steps + 1} samples, {duration * case.lyapunov:.0f} Lyapunov times; {len(fits_)} "
            f"seeds, {int((fits_['outcome'] != 'solved').sum())} failed; median {fits_['seconds'].median():.1f} s and "
            f"{fits_['iterations'].median():.0f} iterations of the last program.",
            "",
            "```text",
            scores(rows).to_string(
                float_format=lambda v: f"{v:.4g}", index_names=False, na_rep="-"
            ),
            "```",
            "",
        ]
        failed = fits_[fits_["outcome"] != "solved"]
        lines += [
            f"- seed {seed}: {row.outcome}" for seed, row in failed.iterrows()
        ] + ([""] if len(failed) else [])
    write("chaos.md", "\n".join(lines))


if __name__ == "__main__":
    experiments = chosen() or None
    if flag("page"):
        page()
    elif flag("quick"):
        found = main(experiments or ["lorenz_xyz"], 1, keep=False)
        print(scores(found).to_string())
    else:
        main(experiments, int(option("seeds", str(N_SEEDS))))
