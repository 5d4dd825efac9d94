"""The forced, damped mass-spring of the thesis (Section 6.3), found from its dictionary.

    dq/dt = p
    dp/dt = -q - c p + alpha sin(omega t),   c = 0.3, alpha = 2, omega = 0.5;  H = q^2/2 + p^2/2

50 trajectories from 0 to 10 with step 0.1, starts in a ring of radius 1 to 4.5; noise 0.2 in the noisy set. Dictionary:
H all polynomials of degree 3 in q and p, damping on p, F polynomials of degree 3 in t and a wave of free frequency.

    python problems/mass_spring.py [--quick]
"""

import sys

import numpy as np
import pandas as pd
from provenance import write
from scipy.integrate import solve_ivp

import phsi_opt as ph

TRUTH = {"H[q**2]": 0.5, "H[p**2]": 0.5, "R_p": 0.3, "F_p[sin(omega_t*t)]": 2.0, "F_p.omega_t": 0.5}
C, ALPHA, OMEGA = 0.3, 2.0, 0.5
TIMES = np.linspace(0.0, 10.0, 101)
L1 = {"H": 1e-2, "F": 1e-2}
PRUNING = ph.Pruning(threshold=0.05)


def data(seed: int, noise: float, n_trajectories: int = 50) -> ph.Measurements:
    """Measurements of both states."""
    rng = np.random.default_rng(seed)
    radius, angle = 1 + 3.5 * np.sqrt(rng.random(n_trajectories)), 2 * np.pi * rng.random(n_trajectories)
    runs = []
    for r, a in zip(radius, angle, strict=True):
        x0 = [r * np.cos(a), r * np.sin(a)]
        x = solve_ivp(_f, (0.0, 10.0), x0, "DOP853", TIMES, rtol=1e-12, atol=1e-12).y.T
        runs.append(x + noise * rng.normal(size=x.shape))
    return ph.Measurements.from_arrays([TIMES] * n_trajectories, runs, states=["q", "p"])


def _f(t: float, x: np.ndarray) -> list[float]:
    return [x[1], -x[0] - C * x[1] + ALPHA * np.sin(OMEGA * t)]


def model() -> ph.PseudoHamiltonian:
    """The dictionary of the thesis."""
    return ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=ph.polynomials(["q", "p"], degree=3), R=ph.damping("p"),
        F={"p": ph.polynomials(["t"], degree=3) + ph.trigonometric("t")},
    )  # fmt: skip


def errors(fit: ph.Fit) -> pd.DataFrame:
    """Every coefficient, found or true, with its error relative to the truth (absolute where the truth is zero)."""
    found = fit.values
    rows = []
    for name in [*TRUTH, *[n for n in found if n not in TRUTH]]:
        true, value = TRUTH.get(name, 0.0), found.get(name, 0.0)
        kind = "missed" if name not in found else "spurious" if name not in TRUTH else "found"
        rows.append((name, true, value, fit.std_errors.get(name, np.nan), abs(value - true) / (abs(true) or 1.0), kind))
    return pd.DataFrame(rows, columns=["coefficient", "true", "value", "std_error", "error", "kind"])


def main(quick: bool = False) -> dict[str, pd.DataFrame]:
    """Clean and noisy: the PHSI loss, and maximum likelihood started from it."""
    n = 12 if quick else 50
    tables, text = {}, ["# Forced, damped mass-spring from its dictionary", ""]
    for kind, noise in (("clean", 0.0), ("noisy", 0.2)):
        measured = data(seed=1, noise=noise, n_trajectories=n)
        fit = ph.identify(model(), measured, ph.PHSILoss(), L1, PRUNING, progress=_say)
        fits = {f"{kind}, PHSI loss": fit}
        if noise:
            fits[f"{kind}, maximum likelihood on its support"] = ph.identify(fit.model, measured, progress=_say)
        for name, found in fits.items():
            tables[name] = errors(found)
            text += [f"## {name} ({n} trajectories, noise {noise:g})", "", "```text"]
            text += [tables[name].to_string(index=False, float_format=lambda v: f"{v:.6g}"), "", str(found), "```", ""]
    print("\n".join(text))
    if not quick:
        write("mass_spring.md", "\n".join(text))
    return tables


def _say(line: str) -> None:
    print(f"... {line}", flush=True)


if __name__ == "__main__":
    clean = main(quick="--quick" in sys.argv)["clean, PHSI loss"]
    assert list(clean["kind"]) == ["found"] * len(TRUTH), "clean data: the support is not exact"
    assert clean["error"].max() <= 1e-3, f"clean data: largest error {clean['error'].max():.2g}, expected 1e-3 or less"
