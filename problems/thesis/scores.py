"""How good a result is: coefficients against the truth, free runs from unseen starts,
the PHSI loss by one function.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

import phsi_opt as ph
from phsi_opt.transcription.grid import grid_of
from phsi_opt.transcription.integrators import integrator
from problems.thesis.systems import System
from problems.tools.intervals import HALF_WIDTH

KNOWN_FORM = ("slope", "limit")  # of the tanks' leak where its form is given; no terms
HINGES = "F_mu4"  # how the names of hinges begin, which stand for a network


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
    """Score of a pseudo-Hamiltonian or a first-order result."""
    first_order = isinstance(result.model, ph.FirstOrder)
    truth = system.truth_first_order if first_order else system.truth
    found = {}
    for name, value in result.values.items():
        if is_coefficient(common_name(name), truth):
            found[common_name(name)] = value
    errors = {}
    for name in {*found, *truth}:
        errors[name] = abs(found.get(name, 0.0) - truth.get(name, 0.0))
    return Score(
        largest=max(errors.values()),
        relative=max(errors[name] / abs(true) for name, true in truth.items()),
        spurious=tuple(n for n, v in found.items() if n not in truth and v != 0),
        missed=tuple(n for n in truth if found.get(n, 0.0) == 0),
    )


def is_coefficient(name: str, truth: Mapping[str, float]) -> bool:
    """Whether a parameter counts: frequencies of waves that are not true do not, nor
    what stands for a force that the truth has not as terms.
    """
    if name in truth:
        return True
    stands_for_force = name.startswith(HINGES) and not any(
        true.startswith(HINGES) for true in truth
    )
    return not (is_frequency(name) or stands_for_force or name in KNOWN_FORM)


def common_name(name: str) -> str:
    """The name in the truth: gradient descent has a frequency each for sine and cosine,
    as the thesis (Eq. 5.5).
    """
    return name.replace("omega_s", "omega_t").replace("omega_c", "omega_cos")


def is_frequency(name: str) -> bool:
    """Whether a parameter is the frequency of a wave, not a coefficient."""
    return "omega" in name.split("[")[0]


def coverage(system: System, result: Any, names: Sequence[str]) -> float:
    """Share of the 95 % intervals of ``names`` that hold the truth; NaN without any."""
    z = [
        abs(result.values[name] - system.truth[name]) / result.std_errors[name]
        for name in names
    ]
    return float(np.mean(np.array(z) < HALF_WIDTH)) if z else np.nan


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


def phsi_loss(result: Any, data: ph.Measurements) -> float:
    """Mean over the intervals of the squared defect (thesis Eq. 5.6 without L1).

    Networks are included. Computed in NumPy alone.
    """
    grid = grid_of(data)
    x0, x1 = grid.y[grid.begin], grid.y[grid.begin + 1]
    t0 = grid.t[grid.begin]
    h = grid.h[:, None]

    def g(x: np.ndarray, c: float) -> np.ndarray:
        return rates(result, x, t0 + c * grid.h)

    defect = (x1 - x0) / h - integrator("srk4").psi(g, x0, x1, h)
    return float(np.mean(np.sum(defect**2, axis=1)))


def rates(result: Any, x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Right-hand side (n, n_states) of a result at states x and times t."""
    dx = model_rates(result.model, x, t)
    force = getattr(result, "force", None)
    if force is None:
        return dx
    dx[:, [result.model.index(name) for name in force.equations]] += force(x)
    return dx


def model_rates(model: ph.Model, x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Right-hand side (n, n_states) of a model without inputs."""
    n = len(t)
    theta = ca.repmat(ca.DM([model.values[name] for name in model.free]), 1, n)
    return np.array(model.rhs().map(n)(x.T, np.zeros((0, n)), t[None, :], theta)).T


def leak_of(result: Any, levels: np.ndarray) -> np.ndarray:
    """The leak that a hybrid or its likelihood found, at levels of tank 4."""
    x = np.zeros((len(levels), 9))
    x[:, 8] = levels
    if hasattr(result, "force"):
        return np.asarray(result.force(x))[:, 0]
    t = np.zeros(len(levels))
    shut = replace(result, model=replace(result.model, F={}))
    return (rates(result, x, t) - rates(shut, x, t))[:, 8]


def attempted(run: Any) -> Any:
    """The result of a call, or the error of the package that it raised."""
    try:
        return run()
    except ph.PhsiOptError as error:
        return error
