"""Which integrator belongs inside the PHSI loss? (thesis Section 5.1 and Appendix A)

Euler, midpoint, RK4 and SRK4 make the defect (x1 - x0)/h - Psi of the loss. Measured
here: the order of the defect of the true right-hand side, the symmetry (Table A.1), and
what models found with each are worth (Figures A.1 to A.4). The leak of the tanks is a
neural network, as in the thesis, and beside it of known form.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.transcription.integrators import INTEGRATORS
from problems.thesis import figures
from problems.thesis.runs import Done, Setting, done, medians, table
from problems.thesis.systems import (
    LEAK_SLOPE,
    SYSTEMS,
    System,
    closed_tanks,
    known_leak,
    tank_model,
)
from problems.tools.pages import render

# The sum of the levels is a Casimir: c (mu1 + .. + mu4)^2 in H moves nothing, so
# without any L1 the data leave c open.
LEAST = {"H": 1e-3}
PRUNING = ph.Pruning(0.05, significance=0.01)
HALVINGS = (1, 2, 4, 8)
LENGTHS = {"henon_heiles": 1.0, "tanks": 0.5}  # of the exact records
N_DRAWS = 5  # of Henon-Heiles
NEURAL, KNOWN = "Tanks, neural leak", "Tanks, leak of known form"


def orders(n: int = 10) -> pd.DataFrame:
    """Rms defect of the true right-hand side on exact data at h, h/2, h/4 and h/8; the
    order is the slope over the last halving.
    """
    closed = replace(SYSTEMS["tanks"], title="Tanks, leak shut", rhs=closed_tanks)
    rows = []
    for system in (SYSTEMS["henon_heiles"], SYSTEMS["tanks"], closed):
        shortened = replace(system, n_steps=round(LENGTHS[system.name] / system.step))
        exact = shortened.data(0, noise=0.0, n=n, refine=HALVINGS[-1])
        for name in INTEGRATORS:
            sizes = [
                _rms_defect(system, name, exact, HALVINGS[-1] // k) for k in HALVINGS
            ]
            row = {"system": system.title, "integrator": name, "h": system.step}
            row |= {f"h/{k}": size for k, size in zip(HALVINGS, sizes, strict=True)}
            rows.append(row | {"order": np.log2(sizes[-2] / sizes[-1])})
    return pd.DataFrame(rows)


def _rms_defect(
    system: System, integrator: str, data: ph.Measurements, every: int
) -> float:
    psi = INTEGRATORS[integrator].psi
    squares = []
    for run in data.trajectories:
        t, x = run.t[::every], run.x[::every]
        for i, h in enumerate(np.diff(t)):
            increment = psi(partial(_at, system, t[i], h), x[i], x[i + 1], h)
            squares.append(np.sum(((x[i + 1] - x[i]) / h - increment) ** 2))
    return float(np.sqrt(np.mean(squares)))


def _at(system: System, t: float, h: float, x: np.ndarray, c: float) -> np.ndarray:
    return system.rhs(t + c * h, x)


def symmetry(n: int = 20) -> pd.DataFrame:
    """Largest relative change of Psi when the ends are swapped and h -> -h, over the
    first steps of noisy trajectories of all four systems.
    """
    rows = []
    for name, scheme in INTEGRATORS.items():
        changes = [0.0]
        for system in SYSTEMS.values():
            for run in system.data(0, n=n).trajectories:
                (x0, x1), (t0, t1) = run.x[:2], run.t[:2]
                h = t1 - t0
                there = scheme.psi(partial(_at, system, t0, h), x0, x1, h)
                back = scheme.psi(partial(_at, system, t1, -h), x1, x0, -h)
                size = np.linalg.norm(there)
                changes.append(float(np.linalg.norm(there - back) / size))
        row = {"integrator": name, "symmetric": scheme.symmetric}
        rows.append(row | {"largest change": max(changes)})
    return pd.DataFrame(rows)


# --- models found with each integrator


def by_identify(
    model: ph.Model, l1: dict[str, float], data: ph.Measurements, integrator: str
) -> Any:
    """The model that an integrator finds."""
    settings = ph.SolverSettings(max_iterations=100)
    loss = ph.PHSILoss(integrator=integrator)
    return ph.identify(
        model, data, loss, l1, PRUNING, settings=settings, raise_on_failure=False
    )


def by_hybrid(data: ph.Measurements, integrator: str, quick: bool = False) -> Any:
    """The tanks with a network for the leak; ``quick``: a small one, three turns."""
    from phsi_opt.learning.hybrid import hybrid
    from phsi_opt.learning.hybrid_network import NeuralForce

    force = NeuralForce(("mu4",), ("mu4",))
    if quick:
        force = replace(force, hidden=(10,), epochs=10)
    turns = 3 if quick else 20
    parts: dict[str, Any] = {"integrator": integrator, "max_turns": turns}
    return hybrid(tank_model(), data, force, LEAST, PRUNING, **parts)


def runs_of(quick: bool) -> list[Done]:
    """Every integrator on Henon-Heiles and on the tanks, at some noises."""
    tanks = replace(SYSTEMS["tanks"], n_steps=50, test_time=0.5)
    with_slope = replace(tanks, truth={**tanks.truth, "slope": LEAK_SLOPE})
    chain = replace(
        SYSTEMS["henon_heiles"], n_steps=10, n_trajectories=200, test_time=1.0
    )
    known = partial(by_identify, tank_model(known_leak()), LEAST)
    energy = partial(by_identify, chain.model(), {})
    # System, title, noises, seeds, and what makes a model from data by an integrator.
    wanted: list[tuple[System, str, Sequence[float], range, Callable[..., Any]]] = [
        (chain, chain.title, (1e-5, 1e-3, 0.01), range(N_DRAWS), energy),
        (tanks, NEURAL, (0.0, 0.01, 0.05), range(1), by_hybrid),
        (with_slope, KNOWN, (0.0, 0.01, 0.05), range(1), known),
    ]
    if quick:
        chain = replace(chain, n_trajectories=15)
        tanks = replace(tanks, n_trajectories=4)
        small = partial(by_hybrid, quick=True)
        wanted = [
            (chain, chain.title, (1e-5, 0.01), range(1), energy),
            (tanks, NEURAL, (0.0,), range(1), small),
        ]
    found = []
    for system, title, noises, seeds, make in wanted:
        tests = system.tests(3 if quick else 10)
        for noise in noises:
            for seed in seeds:
                data = system.data(seed, noise)
                setting = Setting(system, data, tests)
                for name in INTEGRATORS:
                    keys = {"system": title, "noise": noise, "draw": seed}
                    made = partial(make, data, name)
                    found.append(done(setting, made, **keys, integrator=name))
    return found


def integrators_page(quick: bool) -> str:
    """The page of the integrators; figures are drawn unless ``quick``."""
    found = runs_of(quick)
    rows = table(found)
    if not quick:
        figures.errors_over_noise("integrators", rows, "integrator")
        title = SYSTEMS["henon_heiles"].title
        draw_paths("integrators_henon_heiles", found, title)
        draw_paths("integrators_tanks", found, NEURAL)
    return render(
        "thesis/pages/integrators.md",
        orders=orders(1 if quick else 10),
        symmetry=symmetry(3 if quick else 20),
        medians=medians(rows, ["system", "noise", "integrator"]),
        n_draws=N_DRAWS,
    )


def draw_paths(name: str, found: Sequence[Done], title: str) -> None:
    """Figures A.2, A.4: trajectories of the first draw, a panel per noise."""
    own = [d for d in found if d.row["system"] == title]
    panels: dict[str, dict[str, Any]] = {}
    for one in own:
        if one.row["draw"] == 0:
            panel = panels.setdefault(f"noise {one.row['noise']}", {})
            panel[one.row["integrator"]] = one.result
    figures.trajectories(name, own[0].setting.system, [list(panels.items())])
