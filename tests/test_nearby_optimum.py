"""The optimum that is found fast is the one that IPOPT finds from further away."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.initialization.scaling import MOST_SHARE, theta_scale
from phsi_opt.optimization import ipopt
from phsi_opt.optimization.nearby_optimum import (
    NearbyOptimum,
    _QuadraticModel,
    nearby_optimum,
)
from phsi_opt.optimization.outcome import Outcome
from phsi_opt.optimization.program import Program
from phsi_opt.optimization.settings import SolverSettings
from phsi_opt.transcription.grid import grid_of
from problems.thesis.systems import SYSTEMS, known_leak, tank_model

AGREE = 1e-8  # relative, of the loss
PRUNING = ph.Pruning(0.05, significance=0.01)
SETTINGS = SolverSettings()


def identified(name: str, n_trajectories: int) -> ph.Fit:
    system = replace(SYSTEMS[name], n_trajectories=n_trajectories)
    data = system.training_data("noisy")
    return ph.identify(system.model(), data, ph.PHSILoss(), dict(system.l1), PRUNING)


class Confirmations:
    """Iterations that IPOPT needs beyond the steps that led near."""

    def __init__(self) -> None:
        self.iterations: list[int] = []
        self.failures = 0

    def watch(self, monkeypatch: pytest.MonkeyPatch) -> None:
        found: list[NearbyOptimum | None] = []

        def nearby(program: Program, settings: SolverSettings) -> NearbyOptimum | None:
            found.append(nearby_optimum(program, settings))
            return found[-1]

        original = ipopt.Solver._run

        def run(
            self: ipopt.Solver,
            ipopt_function: ca.Function,
            begin: dict[str, np.ndarray],
        ) -> tuple[np.ndarray, Outcome]:
            z, outcome = original(self, ipopt_function, begin)
            confirmations.iterations.append(outcome.iterations)
            confirmations.failures += found[-1] is None
            return z, outcome

        confirmations = self
        monkeypatch.setattr(ipopt, "nearby_optimum", nearby)
        monkeypatch.setattr(ipopt.Solver, "_run", run)


@pytest.mark.parametrize(
    ("name", "n_trajectories"),
    [("henon_heiles", 1500), ("mass_spring", 15), ("schrodinger", 15)],
)
def test_fast_and_cold_solves_agree_and_each_is_confirmed_at_once(
    name: str, n_trajectories: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched = Confirmations()
    with monkeypatch.context() as patch:
        watched.watch(patch)
        fast = identified(name, n_trajectories)
    monkeypatch.setattr(ipopt, "nearby_optimum", lambda program, settings: None)
    cold = identified(name, n_trajectories)
    assert fast.loss_value == pytest.approx(cold.loss_value, rel=AGREE)
    assert fast.model.free == cold.model.free
    for parameter, value in cold.values.items():
        error = cold.std_errors[parameter]
        assert fast.values[parameter] == pytest.approx(value, abs=1e-4 * error)
    assert watched.failures == 0
    assert max(watched.iterations) <= 2


def test_each_quadratic_program_begins_at_the_active_set_of_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    changes = []
    original = _QuadraticModel.step

    def step(self: _QuadraticModel, *arguments: np.ndarray) -> object:
        found = original(self, *arguments)
        changes.append(self._solver.stats()["iter_count"])
        return found

    monkeypatch.setattr(_QuadraticModel, "step", step)
    system = SYSTEMS["mass_spring"]
    data = system.data(5, 0.0, n=2)
    ph.identify(system.model(), data, ph.PHSILoss(), {"H": 1e-2, "F": 1e-2})
    # The first begins at no active set; most of the others have nothing to change.
    assert changes[0] > 20
    assert np.median(changes) == 1


def test_with_many_constraints_the_solver_begins_from_the_programs_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found: list[NearbyOptimum | None] = []

    def nearby(program: Program, settings: SolverSettings) -> NearbyOptimum | None:
        found.append(nearby_optimum(program, settings))
        return found[-1]

    monkeypatch.setattr(ipopt, "nearby_optimum", nearby)
    data = SYSTEMS["tanks"].data(5, 0.0, n=2)
    fit = ph.identify(tank_model(known_leak()), data, ph.PHSILoss(), {"H": 1e-3})
    assert fit.outcome.success
    assert found == [None]


def test_a_coefficient_that_l1_takes_is_zero_with_the_multipliers_of_one() -> None:
    rng = np.random.default_rng(3)
    t = np.linspace(0, 8, 81)
    x = np.column_stack([np.cos(t), -np.sin(t)])
    x = x + 0.01 * rng.normal(size=x.shape)
    data = ph.Measurements.from_arrays([t], [x], states=["q", "p"])
    model = ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=ph.polynomials(["q", "p"], degree=4)
    )
    fit = ph.identify(model, data, ph.PHSILoss(), {"H": 0.02})
    assert fit.outcome.success
    zeros = [name for name in fit.values if abs(fit.values[name]) < 1e-9]
    assert len(zeros) >= 5
    assert fit.values["H[q**2]"] == pytest.approx(0.5, abs=0.05)


def test_too_few_iterations_are_told_as_before() -> None:
    t = np.linspace(0, 8, 81)
    x = np.column_stack([np.cos(t), -np.sin(t)])
    data = ph.Measurements.from_arrays([t], [x], states=["q", "p"])
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(3.0)),
        R=ph.damping("p"),
        F={"p": ph.trigonometric("t")},
    )
    with pytest.raises(ph.SolveError, match="allow more iterations"):
        ph.identify(
            model, data, ph.PHSILoss(), settings=ph.SolverSettings(max_iterations=1)
        )


def test_the_size_of_a_frequency_follows_no_vanishing_amplitude() -> None:
    t = np.linspace(0, 8, 81)
    x = np.column_stack([np.cos(t), -np.sin(t)])
    data = ph.Measurements.from_arrays([t], [x], states=["q", "p"])
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.polynomials(["q", "p"], degree=2),
        F={"p": ph.trigonometric("t")},
    )
    grid = grid_of(data)
    theta = np.full(len(model.free), 1.0)
    place = model.free.index("F_p.omega_t")
    theta[place] = 0.3
    for name in ("F_p[sin(omega_t*t)]", "F_p[cos(omega_t*t)]"):
        theta[model.free.index(name)] = 1e-12
    sizes = theta_scale(model, grid, theta, grid.y, np.ones(2))
    assert sizes[place] == pytest.approx(MOST_SHARE * 0.3)


def test_the_size_of_a_parameter_at_its_bound_is_that_of_its_effect() -> None:
    t = np.linspace(0, 8, 81)
    data = ph.Measurements.from_arrays([t], [np.exp(-t)[:, None]], states=["v"])
    a, b = ph.Parameter(3.0, lower=0), ph.Parameter(0.5, lower=0)
    model = ph.FirstOrder(["v"], {"v": ph.formula("-a - b*v", a=a, b=b)})
    grid = grid_of(data)

    def size_of(a: float, *held: str) -> float:
        sizes = theta_scale(model, grid, np.array([a, 0.5]), grid.y, np.ones(1), held)
        return float(sizes[model.free.index("a")])

    assert size_of(1e-12, "a") == pytest.approx(size_of(3.0))
    assert size_of(1e-12) == pytest.approx(MOST_SHARE * 1e-12)
