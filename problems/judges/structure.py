"""The place of an entry of S(x), found from data, and how sure its coefficients are.

    python -m problems.judges.structure [--first=SEED] [--cases=N]

A charged particle in a field, whose two momenta exchange energy, and a motor whose
torque per current depends on its angle. All states are measured, without noise and with
1 % of it. All further entries of S are polynomials of degree two in the positions; the
PHSI loss with L1 and pruning finds which of them are there, maximum likelihood their
coefficients. Right: all that is true is kept, and nothing else. Seeds from 87100 on are
reported; 15000 to 15099 were used to build it.

Positions alone, since entries with all states are not unique: S + D gives the same
motion where D grad H = 0, as an entry a_i x_i beside the others of a rigid body does.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.judges.cases import Record
from problems.tools.command_line import option
from problems.tools.intervals import share
from problems.tools.pages import render
from problems.tools.provenance import write

FIRST, N_CASES = 87_100, 30  # of each machine
NOISE = 0.01  # of each channel's standard deviation
T = np.linspace(0.0, 12.0, 241)
SURE = 2.0  # standard errors


@dataclass(frozen=True)
class Case:
    """A machine with its measurements, and the true coefficients of S."""

    model: ph.PseudoHamiltonian
    rates: Callable[[float, np.ndarray], Any]
    starts: np.ndarray
    truth: dict[str, float]

    def measured(self, noise: float, rng: np.random.Generator) -> ph.Measurements:
        """Three runs with a share of noise in each channel."""
        runs = []
        for start in self.starts:
            solved = solve_ivp(
                self.rates, T[[0, -1]], start, t_eval=T, rtol=1e-11, atol=1e-11
            )
            runs.append(solved.y.T)
        sigma = noise * np.std(np.concatenate(runs), axis=0)
        noisy = [x + sigma * rng.normal(size=x.shape) for x in runs]
        return ph.Measurements.from_arrays(
            [T] * len(runs), noisy, states=self.model.states
        )


def particle(rng: np.random.Generator) -> Case:
    """A charged particle in a field B = b (1 + a x^2), on springs."""
    b, a = rng.uniform(0.5, 1.5), rng.uniform(0.2, 0.6)

    def rates(t: float, z: np.ndarray) -> list[float]:
        x, y, p, r = z
        field = b * (1 + a * x**2)
        return [p, r, -x + field * r, -2 * y - field * p]

    model = ph.PseudoHamiltonian(
        states=["x", "y", "p", "r"],
        S=known(("x", "p"), ("y", "r"))
        | unknown(["x", "y"], ("x", "y"), ("x", "r"), ("y", "p"), ("p", "r")),
        H="k1*x**2/2 + k2*y**2/2 + p**2/2 + r**2/2",
    )
    truth = {"S_p_r": b, "S_p_r[x**2]": a * b}
    return Case(model, rates, rng.normal(size=(3, 4)), truth)


def motor(rng: np.random.Generator) -> Case:
    """A motor on a spring, with a torque per current of K (1 - a q^2)."""
    K, a, d, r = *rng.uniform([0.5, 0.1], [1.5, 0.3]), *rng.uniform(0.02, 0.1, 2)

    def rates(t: float, z: np.ndarray) -> list[float]:
        q, p, f = z
        gain = K * (1 - a * q**2)
        return [p, -q - d * p + gain * f, -r * f - gain * p]

    model = ph.PseudoHamiltonian(
        states=["q", "p", "f"],
        S=known(("q", "p")) | unknown(["q"], ("q", "f"), ("p", "f")),
        H="k*q**2/2 + p**2/2 + f**2/2",
        R={"p": "d", "f": "r"},
    )
    truth = {"S_p_f": K, "S_p_f[q**2]": -a * K}
    return Case(model, rates, rng.normal(size=(3, 3)), truth)


def known(*pairs: tuple[str, str]) -> dict[Any, Any]:
    """Entries of one."""
    return dict.fromkeys(pairs, 1)


def unknown(names: list[str], *pairs: tuple[str, str]) -> dict[Any, Any]:
    """Entries that are polynomials of degree two."""
    return {pair: ph.polynomials(names, 2, constant=True) for pair in pairs}


def examined(case: Case, noise: float, rng: np.random.Generator) -> Record:
    """Which entries were kept, and how far their coefficients are from the truth."""
    data = case.measured(noise, rng)
    found = ph.identify(
        case.model, data, ph.PHSILoss(), l1=1e-4, pruning=ph.Pruning(0.05)
    )
    kept = {name for name in found.model.free if name.startswith("S_")}
    record: Record = {"kept": ", ".join(sorted(kept)), "right": kept == set(case.truth)}
    if not record["right"]:
        return record
    loss = ph.MaximumLikelihood() if noise else ph.PHSILoss()
    fit = ph.identify(found.model, data, loss)
    errors = {name: fit.values[name] - true for name, true in case.truth.items()}
    record["largest error"] = max(map(abs, errors.values()))
    if noise:
        std_errors = [fit.std_errors[name] for name in errors]
        z = np.abs(list(errors.values())) / std_errors
        record |= {"inside": int(np.sum(z <= SURE)), "mean z^2": float(np.mean(z**2))}
    return record


MACHINES = {"particle in a field": particle, "motor": motor}


def main() -> None:
    """Examine all, and write the page."""
    first = int(option("first", str(FIRST)))
    n_cases = int(option("cases", str(N_CASES)))
    records = []
    for machine, draw in MACHINES.items():
        for seed in range(first, first + n_cases):
            rng = np.random.default_rng(seed)
            case = draw(rng)
            for sigma in (0.0, NOISE):
                record = {"machine": machine, "seed": seed, "noise": sigma}
                records.append(record | examined(case, sigma, rng))
                print(records[-1], flush=True)
    rows = []
    for (name, noise), of_one in pd.DataFrame(records).groupby(["machine", "noise"]):
        row: Record = {"machine": name, "noise": noise}
        row["right place"] = share(int(of_one["right"].sum()), len(of_one))
        row["largest error"] = f"{of_one['largest error'].max():.1e}"
        if noise:
            n = 2 * int(of_one["right"].sum())
            row["truth within two errors"] = share(int(of_one["inside"].sum()), n)
            row["mean z^2"] = f"{of_one['mean z^2'].mean():.2f}"
        rows.append(row)
    wrong = [one for one in records if not one["right"]]
    page = render("judges/pages/structure.md", rows=rows, wrong=wrong)
    if first == FIRST:
        write("judges/structure.md", page)
    else:
        print(page)


if __name__ == "__main__":
    main()
