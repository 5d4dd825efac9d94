"""How good a result is: coefficients against the truth, free runs from unseen starts,
the PHSI loss by one function.
"""

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

import phsi_opt as ph
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.integrators import integrator
from problems.thesis.systems import System, thesis_data_present
from problems.tools.data_paths import folder


@dataclass(frozen=True)
class Score:
    """Coefficients against the truth.

    ``largest`` is the largest absolute error of any coefficient, terms that are missing
    or too many included, ``relative`` the largest relative error of a true coefficient.
    """

    largest: float
    relative: float
    spurious: tuple[str, ...]
    missed: tuple[str, ...]


def score(system: System, result: Any) -> Score:
    """Score of a pseudo-Hamiltonian or a first-order result; the network of a hybrid is
    not a coefficient.
    """
    first_order = isinstance(result.model, ph.FirstOrder)
    truth = dict(system.truth_first_order if first_order else system.truth)
    found = {common_name(name): value for name, value in result.values.items()}
    # Frequencies count where their wave is there; those of waves that are not true have
    # no true value.
    found = {
        n: v for n, v in found.items() if "omega" not in n.split("[")[0] or n in truth
    }
    spurious = tuple(n for n, v in found.items() if n not in truth and v != 0)
    missed = tuple(n for n in truth if found.get(n, 0.0) == 0)
    errors = {n: abs(found.get(n, 0.0) - truth.get(n, 0.0)) for n in {*found, *truth}}
    relative = max(errors[n] / abs(v) for n, v in truth.items())
    return Score(max(errors.values()), relative, spurious, missed)


def common_name(name: str) -> str:
    """The name in the truth: gradient descent has a frequency each for sine and cosine,
    as the thesis (Eq. 5.5).
    """
    return name.replace("omega_s", "omega_t").replace("omega_c", "omega_cos")


def test_set(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Times and true trajectories from unseen starts: those of the thesis where
    present, else newly drawn.
    """
    if thesis_data_present():
        with np.load(folder("thesis") / f"{system.name}.npz") as stored:
            return stored["test_t"], stored["test_x"]
    return system.tests()


def free_run(result: Any, t: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """l2 error over time (n_samples,), mean over the runs; infinite from where a
    simulation ends early.
    """
    errors = np.full((len(truth), len(t)), np.inf)
    for k, x in enumerate(truth):
        try:
            errors[k] = np.linalg.norm(result.simulate(t, x[0]) - x, axis=1)
        except ph.SolveError:
            errors[k, 0] = 0.0
    return errors.mean(axis=0)


def inside_and_beyond(system: System, result: Any) -> tuple[float, float]:
    """Mean l2 error of free runs within the training time, and over the whole test
    time.
    """
    t, truth = test_set(system)
    curve = free_run(result, t, truth)
    trained = t <= system.n_steps * system.step + 1e-9
    return float(curve[trained].mean()), float(curve.mean())


def phsi_loss(result: Any, data: ph.Measurements, scheme: str = "srk4") -> float:
    """Mean over the intervals of the squared defect (thesis Eq. 5.6 without L1),
    networks included, in NumPy alone.
    """
    grid = grid_of(data)
    x0, x1, h = grid.y[grid.begin], grid.y[grid.begin + 1], grid.h[:, None]
    t0 = grid.t[grid.begin]

    def g(x: np.ndarray, c: float) -> np.ndarray:
        return rates(result, x, t0 + c * grid.h)

    d = (x1 - x0) / h - integrator(scheme).psi(g, x0, x1, h)
    return float(np.mean(np.sum(d**2, axis=1)))


def rates(result: Any, x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Right-hand side (n, n_states) of a result at states x and times t."""
    model = result.model
    theta = ca.repmat(ca.DM([model.values[name] for name in model.free]), 1, len(t))
    dx = np.array(
        model.rhs().map(len(t))(x.T, np.zeros((0, len(t))), t[None, :], theta)
    ).T
    force = getattr(result, "force", None)
    if force is not None:
        names = (
            force.equations if hasattr(force, "equations") else result.neural.equations
        )
        dx[:, [model.index(name) for name in names]] += force(x)
    return dx


def leak_of(result: Any, levels: np.ndarray) -> np.ndarray:
    """The leak that a hybrid or its likelihood found, at levels of tank 4."""
    x = np.zeros((len(levels), 9))
    x[:, 8] = levels
    if hasattr(result, "force"):
        return np.asarray(result.force(x))[:, 0]
    t = np.zeros(len(levels))
    return (rates(result, x, t) - rates(without_leak(result), x, t))[:, 8]


def without_leak(result: Any) -> Any:
    """The identified system with the leak shut."""
    if hasattr(result, "without_force"):
        return result.without_force()
    return replace(result, model=replace(result.model, F={}))
