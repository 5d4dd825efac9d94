"""Parameters that every trajectory has of its own, from the fit to the report."""

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import phsi_opt as ph

T = np.arange(0, 8, 0.05)
STARTS = ([1.2, 0.0], [-0.9, 0.4], [0.7, -1.0])
EFFECTS = {"coulomb friction", "quadratic stiffness"}


def softening(x: np.ndarray) -> float:
    """A spring that is stiffer on one side, and viscous damping."""
    return 0.8 * x[0] ** 2 - 0.1 * x[1]


def dry(x: np.ndarray) -> float:
    """Dry friction."""
    return -0.4 * np.tanh(x[1] / 0.02)


def recorded(force: Callable[[np.ndarray], float]) -> ph.Measurements:
    """Positions of a mass on a spring of 4 N/m with a force more."""
    rng = np.random.default_rng(3)
    runs = []
    for x0 in STARTS:
        motion = solve_ivp(
            lambda t, x: [x[1], -4 * x[0] + force(x)],
            (0, T[-1]),
            x0,
            t_eval=T,
            rtol=1e-9,
            atol=1e-10,
        )
        position = motion.y[0] + rng.normal(0, 0.01, T.size)
        runs.append(np.column_stack([position, np.full(T.size, np.nan)]))
    return ph.Measurements.from_arrays(
        [T] * len(runs), runs, states=["q", "p"], units={"t": "s", "q": "m"}
    )


# The bounds are above zero, the truth: beside what is missing they are reached.
STIFFNESS = ph.Parameter(4.0, lower=0)
OWN = ph.Parameter(0.3, lower=0.1, per_trajectory=True)
OWN_OFFSET = ph.Parameter(0.3, lower=0.02, per_trajectory=True)
ENERGY = ph.formula("k*q**2/2 + p**2/2", k=STIFFNESS)
WITH_OWN = {
    "H": {"H": ph.formula("k*q**2/2 + p**2/2 - a*q", k=STIFFNESS, a=OWN)},
    "R": {"R": {"p": ph.formula("a", a=OWN)}},
    "F": {"F": {"p": ph.formula("a", a=OWN)}},
    "sensor": {"sensor": {"q": ph.formula("a", a=OWN_OFFSET)}},
}


@pytest.mark.parametrize("slot", WITH_OWN)
def test_a_candidate_drives_parameters_of_trajectories_to_their_bounds(
    slot: str, tmp_path: Path
) -> None:
    slots = {"H": ENERGY, "R": ph.damping("p"), **WITH_OWN[slot]}
    model = ph.PseudoHamiltonian(states=["q", "p"], S=ph.canonical(1), **slots)
    data = recorded(dry if slot == "R" else softening)
    study = ph.Study(model, data)
    assert not study.fit.outcome.at_bounds
    effects = [one for one in ph.catalogue(model) if one.name in EFFECTS]
    missing = next(e for e in effects if (e.slot == "R") == (slot == "R"))
    found = ph.diagnose(study.fit, data, effects=effects)
    assert str(found.candidates["effect"][0]).startswith(missing.name)
    study.add(missing)
    driven = {f"a[run {number}]" for number in (1, 2, 3)}
    assert driven & set(study.fit.outcome.at_bounds)
    study.report(tmp_path / "report.html")
    assert "at its bound" in (tmp_path / "report.html").read_text("utf-8")
