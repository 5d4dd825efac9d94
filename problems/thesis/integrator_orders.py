"""Order and symmetry of the integrators' defects (thesis Table A.1), measured."""

from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.transcription.integrators import INTEGRATORS
from problems.thesis.systems import SYSTEMS, System, closed_tanks

HALVINGS = (1, 2, 4, 8)
LENGTHS = {"henon_heiles": 1.0, "tanks": 0.5}  # of the exact records


def orders(n: int = 10) -> pd.DataFrame:
    """Rms defect of the true right-hand side on exact data at h, h/2, h/4 and h/8.

    The order is the slope over the last halving.
    """
    closed = replace(SYSTEMS["tanks"], title="Tanks, leak shut", rhs=closed_tanks)
    rows = []
    for system in (SYSTEMS["henon_heiles"], SYSTEMS["tanks"], closed):
        n_steps = round(LENGTHS[system.name] / system.step)
        shortened = replace(system, n_steps=n_steps)
        exact = shortened.data(0, noise=0.0, n=n, refine=HALVINGS[-1])
        rows += [_order_row(system, name, exact) for name in INTEGRATORS]
    return pd.DataFrame(rows)


def _order_row(
    system: System, integrator: str, exact: ph.Measurements
) -> dict[str, object]:
    defects = {
        k: _rms_defect(system, integrator, exact, every=HALVINGS[-1] // k)
        for k in HALVINGS
    }
    row = {"system": system.title, "integrator": integrator, "h": system.step}
    row |= {f"h/{k}": size for k, size in defects.items()}
    order = np.log2(defects[HALVINGS[-2]] / defects[HALVINGS[-1]])
    return row | {"order": order}


def _rms_defect(
    system: System, integrator: str, data: ph.Measurements, every: int
) -> float:
    psi = INTEGRATORS[integrator].psi
    total = 0.0
    count = 0
    for run in data.trajectories:
        t = run.t[::every]
        x = run.x[::every]
        for i in range(len(t) - 1):
            h = t[i + 1] - t[i]
            increment = psi(partial(_at, system, t[i], h), x[i], x[i + 1], h)
            defect = (x[i + 1] - x[i]) / h - increment
            total += float(defect @ defect)
            count += 1
    return float(np.sqrt(total / count))


def _at(system: System, t: float, h: float, x: np.ndarray, c: float) -> np.ndarray:
    return system.rhs(t + c * h, x)


def symmetry(n: int = 20) -> pd.DataFrame:
    """Largest relative change of Psi when the ends are swapped and h -> -h.

    Over the first steps of ``n`` noisy trajectories of all four systems.
    """
    rows = []
    for name, scheme in INTEGRATORS.items():
        changes = [
            _change_when_swapped(system, name, run)
            for system in SYSTEMS.values()
            for run in system.data(0, n=n).trajectories
        ]
        row = {"integrator": name, "symmetric": scheme.symmetric}
        rows.append(row | {"largest change": max(0.0, *changes)})
    return pd.DataFrame(rows)


def _change_when_swapped(system: System, integrator: str, run: ph.Trajectory) -> float:
    psi = INTEGRATORS[integrator].psi
    x0, x1 = run.x[:2]
    t0, t1 = run.t[:2]
    there = psi(partial(_at, system, t0, t1 - t0), x0, x1, t1 - t0)
    back = psi(partial(_at, system, t1, t0 - t1), x1, x0, t0 - t1)
    return float(np.linalg.norm(there - back) / np.linalg.norm(there))
