"""Parameters that every trajectory has of its own, from the fit to the report."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import phsi_opt as ph
from tests.systems import pair

T = np.arange(0, 8, 0.1)
STARTS = ([1.2, 0.0], [-0.9, 0.4], [0.7, -1.0], [-1.0, 0.2])
NOISE = 0.01  # m
EFFECTS = {"coulomb friction", "quadratic stiffness"}
OFFSETS = (0.1, -0.2, 0.05, 0.4)  # m; the last run is held out


def softening(x: np.ndarray) -> float:
    """A spring that is stiffer on one side, and viscous damping."""
    return 0.8 * x[0] ** 2 - 0.1 * x[1]


def dry(x: np.ndarray) -> float:
    """Dry friction."""
    return -0.4 * np.tanh(x[1] / 0.02)


def recorded(force: Callable[[np.ndarray], float], *offsets: float) -> ph.Measurements:
    """Positions of a mass on a spring of 4 N/m with a force more."""
    rng = np.random.default_rng(3)
    runs = []

    def rates(t: float, x: np.ndarray) -> list[float]:
        return [x[1], -4 * x[0] + force(x)]

    for x0, offset in zip(STARTS, offsets, strict=False):
        q = solve_ivp(rates, (0, T[-1]), x0, t_eval=T, rtol=1e-9, atol=1e-10).y[0]
        position = q + offset + rng.normal(0, NOISE, T.size)
        runs.append(np.column_stack([position, np.full(T.size, np.nan)]))
    times, units = [T] * len(runs), {"t": "s", "q": "m"}
    return ph.Measurements.from_arrays(times, runs, states=["q", "p"], units=units)


# The bounds are above zero, the truth: without what is missing they are not reached.
STIFFNESS = ph.Parameter(4.0, lower=0)
OWN = ph.Parameter(0.3, lower=0.1, per_trajectory=True)
OWN_OFFSET = ph.Parameter(0.3, lower=0.02, per_trajectory=True)
ENERGY = ph.formula("k*q**2/2 + p**2/2", k=STIFFNESS)
WITH_OWN: dict[str, dict[str, Any]] = {
    "R": {"R": {"p": ph.formula("a", a=OWN)}},
    "sensor": {"sensor": {"q": ph.formula("a", a=OWN_OFFSET)}},
}


def spring(**slots: Any) -> ph.PseudoHamiltonian:
    return pair(**{"H": ENERGY, "R": ph.damping("p"), **slots})


@pytest.mark.parametrize("slot", ["R", "sensor"])
def test_a_candidate_drives_parameters_of_trajectories_to_their_bounds(
    slot: str, tmp_path: Path
) -> None:
    model = spring(**WITH_OWN[slot])
    data = recorded(dry if slot == "R" else softening, 0.0, 0.0, 0.0)
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


OFFSET = ph.formula("b", b=ph.Parameter(0.0, per_trajectory=True))


@pytest.mark.parametrize("name", ["run 1", "run 4"])
def test_the_offset_of_a_run_held_out_is_its_own_whatever_its_name(name: str) -> None:
    model = spring(sensor={"q": OFFSET}).add("coulomb friction", "p")
    data = recorded(dry, *OFFSETS)
    fit = ph.identify(model, data[:3])
    last = data.trajectories[3]
    held_out = ph.Measurements.from_arrays(
        [last.t], [last.x], states=["q", "p"], names=[name], units=data.units
    )
    there = ph.compare(fit, held_out)
    assert there.values[name]["b"] == pytest.approx(OFFSETS[3], abs=0.005)
    assert there.values[name]["k"] == pytest.approx(fit.values["k"], rel=1e-14)
    assert there.rmse < 1.1 * NOISE
    here = ph.compare(fit, data[:3])
    assert here.values["run 1"]["b"] == fit.by_trajectory["run 1"]["b"]
