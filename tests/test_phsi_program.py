"""The PHSI loss is one symbolic program, and what IPOPT makes of it is the fit."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.initialization.scaling import MOST_RATIO, theta_scale
from phsi_opt.optimization import ipopt
from phsi_opt.optimization.program import Program
from phsi_opt.transcription.defects import KnownDefects
from phsi_opt.transcription.grid import grid_of
from problems.thesis.systems import SYSTEMS, known_leak, tank_model

PRUNING = ph.Pruning(0.05, significance=0.01)


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Program, ipopt.Solution]]:
    """Every program that IPOPT is given, with what it makes of it."""
    kept: list[tuple[Program, ipopt.Solution]] = []
    original = ipopt.Solver.solve

    def solve(self: ipopt.Solver, *args: Any, **kwargs: Any) -> ipopt.Solution:
        solution = original(self, *args, **kwargs)
        kept.append((self.program, solution))
        return solution

    monkeypatch.setattr(ipopt.Solver, "solve", solve)
    return kept


@pytest.mark.parametrize(
    ("name", "n_trajectories"),
    [("henon_heiles", 300), ("mass_spring", 6), ("schrodinger", 6)],
)
def test_every_program_is_symbolic_and_its_answer_is_the_fit(
    name: str,
    n_trajectories: int,
    solved: list[tuple[Program, ipopt.Solution]],
) -> None:
    system = replace(SYSTEMS[name], n_trajectories=n_trajectories)
    data = system.training_data("noisy")
    fit = ph.identify(system.model(), data, ph.PHSILoss(), dict(system.l1), PRUNING)
    # Those of Schroedinger have too many instructions to be written out soon.
    expanded = [] if name == "schrodinger" else [solved[0], solved[-1]]
    for program, _ in expanded:
        # CasADi expands MX to scalar instructions only where no callback is inside.
        whole = ca.Function("f", [program.z, program.settings], [program.objective])
        assert np.isfinite(float(whole.expand()(program.start, program.set_to)))
    assert all(solution.outcome.iterations > 0 for _, solution in solved)
    found = [solution for _, solution in solved if solution.outcome == fit.outcome]
    assert len(found) == 1
    np.testing.assert_array_equal(found[0].values["theta"], list(fit.values.values()))
    said = f"IPOPT: Solve_Succeeded, {fit.outcome.iterations} iterations"
    assert said in str(fit)


def test_defects_and_slopes_in_symbols_are_those_in_numbers(
    solved: list[tuple[Program, ipopt.Solution]],
) -> None:
    data = SYSTEMS["tanks"].data(5, 0.01, n=2)
    model = tank_model(known_leak())
    ph.identify(model, data, ph.PHSILoss(), {"H": 1e-3})
    program, solution = solved[-1]
    known = KnownDefects(model, grid_of(data), "srk4").at(solution.values["theta"])
    in_numbers = known.d.T.ravel()
    share = np.linalg.norm(solution.residual) / np.linalg.norm(in_numbers)
    # Rounding alone: the same operations in the same order, but for the weight.
    np.testing.assert_allclose(solution.residual, share * in_numbers, rtol=1e-9)
    slopes = known.slopes.reshape(-1, model.n_states, len(model.free))
    by_equation = slopes.transpose(1, 0, 2).reshape(-1, len(model.free))
    scale = share * program.scale[: len(model.free)]
    expected = (by_equation * scale).T @ (by_equation * scale)
    no_multipliers = np.zeros(program.g.numel())
    upper = program.hessian()(solution.z, program.set_to, 1.0, no_multipliers)
    upper = np.array(upper)[: len(model.free), : len(model.free)]
    hessian = upper + np.triu(upper, 1).T
    np.testing.assert_allclose(hessian, expected, atol=1e-9 * np.max(expected))


def test_a_coefficient_that_l1_takes_is_zero() -> None:
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
    zeros = [name for name in fit.values if abs(fit.values[name]) < 1e-6]
    assert len(zeros) >= 5
    assert fit.values["H[q**2]"] == pytest.approx(0.5, abs=0.05)


def test_without_l1_it_ends_where_directions_leave_no_trace_and_names_them() -> None:
    """Casimirs of S: any function of the tanks' whole volume adds to H unseen."""
    data = SYSTEMS["tanks"].data(5, 0.0, n=12)
    fit = ph.identify(SYSTEMS["tanks"].model(), data, ph.PHSILoss())
    assert fit.outcome.iterations < 50
    assert np.max(np.abs(list(fit.values.values()))) < 100
    volume = [f"H[mu{i}]" for i in (1, 2, 3, 4)]
    notes = [note for note in fit.warnings if "cannot tell" in note]
    assert any(
        note.startswith(f"the data cannot tell {', '.join(volume)} apart")
        for note in notes
    )
    squared = [note for note in notes if "H[mu1*mu2]" in note and "H[mu4**2]" in note]
    assert len(squared) == 1 and len(notes) == 2
    assert np.isnan(fit.std_errors["H[mu1]"])
    assert fit.std_errors["R_phi3"] > 0


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
    assert sizes[place] == pytest.approx(MOST_RATIO * 0.3)


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
    assert size_of(1e-12) == pytest.approx(MOST_RATIO * 1e-12)
