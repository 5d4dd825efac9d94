"""How good a result is: coefficients against the truth, free runs from unseen starts,
the PHSI loss by one function.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

import phsi_opt as ph
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.integrators import integrator
from problems.thesis.systems import System, thesis_data_present
from problems.tools.data_paths import folder

HALF_WIDTH = 1.96  # of a normal 95 % interval, in standard errors


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
    """Score of a pseudo-Hamiltonian or a first-order result.

    The network of a hybrid is not a coefficient.
    """
    first_order = isinstance(result.model, ph.FirstOrder)
    truth = system.truth_first_order if first_order else system.truth
    found = _coefficients(result, truth)
    errors = {}
    for name in {*found, *truth}:
        errors[name] = abs(found.get(name, 0.0) - truth.get(name, 0.0))
    return Score(
        largest=max(errors.values()),
        relative=max(errors[name] / abs(true) for name, true in truth.items()),
        spurious=tuple(n for n, v in found.items() if n not in truth and v != 0),
        missed=tuple(n for n in truth if found.get(n, 0.0) == 0),
    )


def _coefficients(result: Any, truth: Mapping[str, float]) -> dict[str, float]:
    """Values by common name.

    Frequencies count where their wave is there; those of waves that are not true have
    no true value.
    """
    found = {}
    for name, value in result.values.items():
        known_as = common_name(name)
        if known_as in truth or not is_frequency(known_as):
            found[known_as] = value
    return found


def common_name(name: str) -> str:
    """The name in the truth: gradient descent has a frequency each for sine and cosine,
    as the thesis (Eq. 5.5).
    """
    return name.replace("omega_s", "omega_t").replace("omega_c", "omega_cos")


def is_frequency(name: str) -> bool:
    """Whether a parameter is the frequency of a wave, not a coefficient."""
    return "omega" in name.split("[")[0]


def distilled(names: Iterable[str]) -> list[str]:
    """The hinges that stand for the network of the tanks, which are no coefficients."""
    return [name for name in names if name.startswith("F_mu4")]


def coverage(system: System, result: Any, names: Sequence[str]) -> float:
    """Share of the 95 % intervals of ``names`` that hold the truth; NaN without any."""
    if not names:
        return np.nan
    z = []
    for name in names:
        error = result.values[name] - system.truth[name]
        z.append(abs(error) / result.std_errors[name])
    return float(np.mean(np.array(z) < HALF_WIDTH))


def test_set(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Times and true trajectories from unseen starts: those of the thesis where
    present, else newly drawn.
    """
    if not thesis_data_present():
        return system.tests()
    with np.load(folder("thesis") / f"{system.name}.npz") as stored:
        return stored["test_t"], stored["test_x"]


def free_run(result: Any, t: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """l2 error over time (n_samples,), mean over the runs.

    Infinite from where a simulation ends early.
    """
    errors = np.full((len(truth), len(t)), np.inf)
    for k, x in enumerate(truth):
        try:
            errors[k] = np.linalg.norm(result.simulate(t, x[0]) - x, axis=1)
        except ph.SolveError:
            errors[k, 0] = 0.0
    return errors.mean(axis=0)


def trained(system: System, t: np.ndarray) -> np.ndarray:
    """Which of the times lie within the time of the training trajectories."""
    return t <= system.n_steps * system.step + 1e-9


def inside_and_beyond(system: System, result: Any) -> tuple[float, float]:
    """Mean l2 error of free runs within the training time, and over the whole test
    time.
    """
    t, truth = test_set(system)
    curve = free_run(result, t, truth)
    return float(curve[trained(system, t)].mean()), float(curve.mean())


def phsi_loss(result: Any, data: ph.Measurements, scheme: str = "srk4") -> float:
    """Mean over the intervals of the squared defect (thesis Eq. 5.6 without L1).

    Networks are included. Computed in NumPy alone.
    """
    grid = grid_of(data)
    x0 = grid.y[grid.begin]
    x1 = grid.y[grid.begin + 1]
    t0 = grid.t[grid.begin]
    h = grid.h[:, None]

    def g(x: np.ndarray, c: float) -> np.ndarray:
        return rates(result, x, t0 + c * grid.h)

    defect = (x1 - x0) / h - integrator(scheme).psi(g, x0, x1, h)
    return float(np.mean(np.sum(defect**2, axis=1)))


def rates(result: Any, x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Right-hand side (n, n_states) of a result at states x and times t."""
    model = result.model
    n = len(t)
    values = [model.values[name] for name in model.free]
    theta = ca.repmat(ca.DM(values), 1, n)
    no_inputs = np.zeros((0, n))
    dx = np.array(model.rhs().map(n)(x.T, no_inputs, t[None, :], theta)).T
    force = getattr(result, "force", None)
    if force is None:
        return dx
    of_force = force if hasattr(force, "equations") else result.neural
    equations = [model.index(name) for name in of_force.equations]
    dx[:, equations] += force(x)
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
