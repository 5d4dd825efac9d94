"""IPOPT on the program of a likelihood, and the faster steps: one optimum."""

from dataclasses import replace

import pytest

import phsi_opt as ph
from problems.judges.fit_cases import PROBLEMS

NAMES = (
    "mass-spring, likelihood, free frequency",
    "Duffing, q and p",
    "Duffing, half of the values",
    "Duffing, irregular times",
    "Lorenz, x, y and z",
    "double pendulum",
    "oscillator, half off",
    "pendulum, half off",
    "driven oscillator, random force",
    "a mass for each trajectory",
    "only ratios can be told",
    "demonstration",
    "demonstration, friction",
    "demonstration, stiffness at a bound",
    "hysteresis",
    "sensor offset",
    "sharp friction under control",
    "heated bodies",
)
BY_IPOPT = ph.SolverSettings(solver="ipopt")


@pytest.mark.parametrize("name", NAMES)
def test_ipopt_and_the_faster_steps_agree_in_the_objective(name: str) -> None:
    """With the noise and the steps between samples given: else both are estimated, to
    half a percent and to a tenth of a standard error.
    """
    problem = PROBLEMS[name]()
    first = ph.identify(problem.model, problem.data, **problem.options)
    loss = problem.options.get("loss", ph.MaximumLikelihood())
    loss = replace(loss, noise=first.noise, steps=loss.steps or 2)
    by_steps, by_ipopt = (
        ph.identify(problem.model, problem.data, loss, start=first, settings=settings)
        for settings in (ph.SolverSettings(), BY_IPOPT)
    )
    assert by_ipopt.outcome.solver == "IPOPT"
    expected = by_steps.outcome.objective
    assert by_ipopt.outcome.objective == pytest.approx(expected, rel=1e-8)


def test_the_reference_needs_no_start() -> None:
    problem = PROBLEMS["Duffing, q alone"]()
    by_steps, by_ipopt = (
        ph.identify(problem.model, problem.data, settings=settings)
        for settings in (ph.SolverSettings(), BY_IPOPT)
    )
    assert by_steps.outcome.solver != by_ipopt.outcome.solver == "IPOPT"
    assert "(IPOPT: Solve_Succeeded" in str(by_ipopt)
    for name, error in by_steps.std_errors.items():
        assert by_ipopt.values[name] == pytest.approx(
            by_steps.values[name], abs=1e-3 * error
        )


def test_an_unknown_solver_is_refused_by_name() -> None:
    with pytest.raises(ph.ModelError, match="solver='ipop'"):
        ph.SolverSettings(solver="ipop")
