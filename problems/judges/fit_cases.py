"""Forty identification problems, drawn from what the project has: one of each kind that
the README promises. Every problem is the same whenever it is made.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.battery.draw import KINDS, ROWS, draw
from problems.battery.records import Case
from problems.benchmarks import chains, scaling
from problems.benchmarks.chaos import EXPERIMENTS
from problems.benchmarks.efficiency import cases as efficient
from problems.benchmarks.far_starts import draw_case
from problems.benchmarks.oscillator import Disturbance, Layout, records
from problems.benchmarks.oscillator import model as oscillator_model
from problems.examples import demo
from problems.examples.friction_spring import table
from problems.thesis.systems import SYSTEMS, known_leak, tank_model

SEED = 5  # of what is drawn here
ML = ph.MaximumLikelihood


@dataclass(frozen=True, eq=False)
class Problem:
    """A model, measurements, and the further arguments of `ph.identify`."""

    model: ph.Model
    data: ph.Measurements
    options: Mapping[str, Any] = field(default_factory=dict)


# --- the systems of the thesis


def thesis(
    name: str,
    n: int,
    noise: float | None = None,
    model: Callable[[], ph.Model] | None = None,
    l1: Mapping[str, float] | None = None,
    prune: bool = False,
) -> Problem:
    """The PHSI loss on a dictionary; ``noise``: None: that of the thesis."""
    system = SYSTEMS[name]
    options: dict[str, Any] = {"loss": ph.PHSILoss(), "l1": l1}
    if prune:
        options["pruning"] = ph.Pruning(system.threshold, significance=0.01)
    return Problem((model or system.model)(), _drawn(name, n, noise), options)


def leaking_tanks() -> ph.Model:
    """All polynomials of degree 2, and a leak of known form."""
    return tank_model(known_leak())


def likely(name: str, n: int, model: Callable[[], ph.Model]) -> Problem:
    """Maximum likelihood on the true terms of a system."""
    return Problem(model(), _drawn(name, n))


@cache
def _drawn(name: str, n: int, noise: float | None = None) -> ph.Measurements:
    return SYSTEMS[name].data(SEED, noise, n=n)


# --- what is measured of the driven Duffing oscillator


def duffing(n: int, channels: str, kept: float = 1.0, rows: bool = False) -> Problem:
    """A share of the samples kept, by channel or (``rows``: irregular times) whole."""
    data = scaling.data(n, channels)
    (run,) = data.trajectories
    rng = np.random.default_rng(SEED)
    is_kept = rng.random(run.x.shape) < kept
    t, x = run.t, np.where(is_kept, run.x, np.nan)
    if rows:
        t, x = run.t[is_kept[:, 0]], run.x[is_kept[:, 0]]
    thinned = ph.Measurements.from_arrays(t, x, states=data.states)
    return Problem(efficient.duffing_model(), thinned)


# --- the driven oscillator beside which something acts


def oscillator(loss: ph.MaximumLikelihood) -> Problem:
    """Three runs beside a random force."""
    return Problem(oscillator_model(), _disturbed(), {"loss": loss})


@cache
def _disturbed() -> ph.Measurements:
    return records([SEED], Disturbance(force_size=0.2), Layout(3, 150))[0]


# --- damped springs


def spring(effect: str = "") -> Problem:
    """The demonstration."""
    data = demo.measurements().split(demo.TRAINING_SHARE)[0]
    return Problem(demo.model().add(effect, "p") if effect else demo.model(), data)


def outliers() -> Problem:
    """Each 25th position is far off, by Huber's function; no friction."""
    shown = table(SEED, friction=0.0)
    shown.loc[::25, "position_m"] += 0.5
    data = ph.Measurements.from_dataframe(shown, **demo.COLUMNS)
    return Problem(demo.model(), data, {"loss": ML(huber=1.345)})


def bounded() -> Problem:
    """The demonstration with a stiffness of at most 38 N/m; it is 40."""
    k = ph.Parameter(10.0, lower=0.0, upper=38.0)
    return Problem(_spring(k, 2.5), spring().data)


def _spring(
    k: ph.Parameter | float, m: ph.Parameter | float, damping: Any = None
) -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/(2*m)", k=k, m=m),
        R=damping or ph.damping("p"),
    )


def _spring_runs(masses: tuple[float, ...]) -> ph.Measurements:
    """Positions of a spring of 40 N/m with another mass in each run."""
    rng = np.random.default_rng(SEED)
    t = np.linspace(0.0, 5.0, 121)
    c = {"p": ph.formula("c", c=0.8)}
    shown = []
    for m in masses:
        x = ph.simulate(_spring(40.0, m, c), t, [1.0, 0.0])
        x[:, 0] += 0.02 * rng.normal(size=len(t))
        x[:, 1] = np.nan
        shown.append(x)
    return ph.Measurements.from_arrays([t] * len(masses), shown, states=["q", "p"])


def loads() -> Problem:
    """A mass for each trajectory."""
    mass = ph.Parameter(2.0, lower=0.1, per_trajectory=True)
    return Problem(_spring(40.0, mass), _spring_runs((1.5, 2.0, 2.5, 3.5)))


def scale_free() -> Problem:
    """From positions alone the data tell k/m and R/m, and not k, m and R."""
    k, m = ph.Parameter(30.0, lower=1.0), ph.Parameter(2.0, lower=0.1)
    return Problem(_spring(k, m), _spring_runs((2.5, 2.5)))


# --- machines of other benchmarks


def chaotic(name: str, n: int) -> Problem:
    """The first samples of a chaotic motion."""
    case = EXPERIMENTS[name]
    (run,) = case.data(SEED).trajectories
    data = ph.Measurements.from_arrays(run.t[:n], run.x[:n], states=case.states)
    return Problem(case.model(), data, {"loss": ph.MaximumLikelihood(steps=case.steps)})


def chain(n_masses: int, n: int) -> Problem:
    """A chain of masses with cubic springs, of twice as many states."""
    return Problem(chains.model(n_masses), chains.data(n_masses, n))


def far_off(kind: str, seed: int) -> Problem:
    """A machine whose frequencies start half off."""
    case = draw_case(kind, seed)
    return Problem(case.model, case.data)


def hidden(row: str, seed: int, **starts: float) -> Problem:
    """A machine with a hidden effect, which the model has."""
    case = _completed(draw(ROWS[row], seed))
    return replace(case, model=case.model.with_values(starts))


def machine(kind: str, seed: int) -> Problem:
    """A machine of the field with its effect in the model."""
    return _completed(draw(KINDS[kind], seed))


def _completed(case: Case) -> Problem:
    effects = ph.catalogue(case.model)
    added = next(effect for effect in effects if str(effect) in case.places)
    return Problem(case.model.add(added), case.train)


L1 = {"H": 0.01, "F": 0.01}
PROBLEMS: dict[str, Callable[[], Problem]] = {
    "Henon-Heiles, clean": partial(thesis, "henon_heiles", 400, 0.0),
    "Henon-Heiles, noisy, pruned": partial(thesis, "henon_heiles", 1500, prune=True),
    "Schroedinger, clean": partial(thesis, "schrodinger", 20, 0.0),
    "Schroedinger, noisy, pruned": partial(thesis, "schrodinger", 30, prune=True),
    "mass-spring, clean, L1, pruned": partial(
        thesis, "mass_spring", 12, 0.0, l1=L1, prune=True
    ),
    "mass-spring, noisy, L1": partial(thesis, "mass_spring", 30, l1=L1),
    "mass-spring, noisy, L1, pruned": partial(
        thesis, "mass_spring", 30, l1=L1, prune=True
    ),
    "mass-spring, right-hand sides": partial(
        thesis, "mass_spring", 30, model=SYSTEMS["mass_spring"].first_order, prune=True
    ),
    "tanks, noisy, L1, pruned": partial(
        thesis, "tanks", 20, model=leaking_tanks, l1={"H": 1e-3}, prune=True
    ),
    "Henon-Heiles, likelihood": partial(
        likely, "henon_heiles", 1500, efficient.henon_heiles_model
    ),
    "Schroedinger, likelihood": partial(
        likely, "schrodinger", 25, efficient.schrodinger_model
    ),
    "mass-spring, likelihood, free frequency": partial(
        likely, "mass_spring", 25, efficient.mass_spring_model
    ),
    "tanks, likelihood, leak with corners": partial(
        likely, "tanks", 20, efficient.tanks_leak_model
    ),
    "Duffing, q and p": partial(duffing, 1001, "qp"),
    "Duffing, q alone": partial(duffing, 1001, "q"),
    "Duffing, half of the values": partial(duffing, 501, "qp", kept=0.5),
    "Duffing, irregular times": partial(duffing, 501, "q", kept=0.6, rows=True),
    "Lorenz, x, y and z": partial(chaotic, "lorenz_xyz", 1501),
    "Lorenz, x alone": partial(chaotic, "lorenz_x", 1501),
    "Lorenz, 30 coefficients": partial(chaotic, "lorenz_dictionary", 1501),
    "double pendulum": partial(chaotic, "pendulum", 1501),
    "chain of 20 states": partial(chain, 10, 600),
    "oscillator, half off": partial(far_off, "oscillator", 3),
    "pendulum, half off": partial(far_off, "pendulum", 3),
    "two masses, half off": partial(far_off, "two masses", 3),
    "driven oscillator, random force": partial(oscillator, ML()),
    "driven oscillator, model_error=True": partial(oscillator, ML(model_error=True)),
    "spring with outliers, Huber": outliers,
    "a mass for each trajectory": loads,
    "only ratios can be told": scale_free,
    "demonstration": spring,
    "demonstration, friction": partial(spring, "coulomb friction"),
    "demonstration, stiffness at a bound": bounded,
    "input lag": partial(hidden, "input_lag_0.03", 0),
    "input delay": partial(hidden, "input_delay_0.03", 0),
    # From zero its memory acts on nothing, and nothing tells it.
    "hysteresis": partial(hidden, "hysteresis_0.03", 0, hysteresis_force_p=0.01),
    "Stribeck friction": partial(hidden, "stribeck_friction_0.01", 0),
    "sensor offset": partial(hidden, "sensor_offset", 0),
    "sharp friction under control": partial(machine, "closed_loop", 1),
    "heated bodies": partial(machine, "thermal", 3),
}
