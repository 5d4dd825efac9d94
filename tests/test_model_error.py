"""What acts beside a model: found, counted in standard errors, let into the estimate."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import f as f_distribution
from scipy.stats import t as student_t

import phsi_opt as ph
from phsi_opt.criteria import STRONG_EVIDENCE
from phsi_opt.estimation.estimate import Estimate, Task
from phsi_opt.estimation.identify import estimate_by
from phsi_opt.estimation.likelihood_estimate import (
    DisturbedEstimate,
    LikelihoodEstimate,
)
from phsi_opt.model.terms import Dictionary
from phsi_opt.model_error import ascent
from phsi_opt.model_error.ascent import Evidence
from phsi_opt.model_error.disturbance_search import DisturbanceSearch
from phsi_opt.model_error.disturbances import (
    LENGTH,
    LINEAR_SHARE,
    Disturbances,
    Process,
    StateFunction,
    smooth_functions,
)
from phsi_opt.model_error.marginal_likelihood import Border
from phsi_opt.model_error.standard_errors import Clusters, Source
from phsi_opt.transcription.grid import AlignedData
from problems.benchmarks import chains
from tests.systems import Number, pair, positive

TRUE = {"k": 4.0, "c": 0.3, "g": 1.0}
SIZE = 0.2  # of the hidden force, a tenth of the typical acceleration
TIME = 1.0  # for which it lasts
NOISE = 0.02
DT = 0.1
STEPS = 5  # of the simulation in a sampling interval
WITH_FORCE = ph.MaximumLikelihood(model_error=True)


# --- Simulated records of an oscillator


def simulated(
    seed: int,
    n: int = 300,
    runs: int = 1,
    size: float = SIZE,
    noise: float = NOISE,
    kept: float = 0.0,
    stiffness: Sequence[float] = (TRUE["k"],),
    n_outliers: int = 0,
) -> ph.Measurements:
    """q'' = -k q - c q' + g u + w with a force w that wanders; q is measured."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(n)
    frequency = np.linspace(0.3, 6.0, 30)
    phase = rng.uniform(0, 2 * np.pi, (runs, 1, 30))
    u = np.sin(t[:, None] * frequency + phase).sum(axis=2) / np.sqrt(15)
    x = 0.5 * rng.normal(size=(runs, 2))
    w = size * rng.normal(size=runs)
    q = [x[:, 0]]
    for i in range(n - 1):
        for step in range(STEPS):
            share = (step + 0.5) / STEPS
            at_step = u[:, i] + share * (u[:, i + 1] - u[:, i])
            x = stepped(x, TRUE["g"] * at_step + w, np.array(stiffness))
            new = rng.normal(size=runs)
            w_kept = np.exp(-DT / STEPS / TIME)
            w = w_kept * w + size * np.sqrt(1 - w_kept**2) * new
        q.append(x[:, 0])
    error = rng.normal(size=(runs, n))
    for i in range(1, n):
        error[:, i] = kept * error[:, i - 1] + np.sqrt(1 - kept**2) * error[:, i]
    y = np.array(q).T + noise * error
    for run in y:
        places = rng.choice(n, n_outliers, replace=False)
        run[places] += 15 * noise * rng.choice([-1, 1], n_outliers)
    return ph.Measurements.from_arrays(
        [t] * runs,
        [np.column_stack([run, np.full(n, np.nan)]) for run in y],
        [run[:, None] for run in u],
        states=["q", "v"],
        inputs=["u"],
        hold="linear",
    )


def stepped(x: np.ndarray, force: np.ndarray, k: np.ndarray) -> np.ndarray:
    """A step of Runge and Kutta's method of order four, (n_runs, 2)."""
    h = DT / STEPS

    def rate(x: np.ndarray) -> np.ndarray:
        acceleration = -k * x[:, 0] - TRUE["c"] * x[:, 1] + force
        return np.column_stack([x[:, 1], acceleration])

    first = rate(x)
    second = rate(x + h / 2 * first)
    third = rate(x + h / 2 * second)
    fourth = rate(x + h * third)
    end: np.ndarray = x + h / 6 * (first + 2 * second + 2 * third + fourth)
    return end


def oscillator(k: ph.Parameter = ph.Parameter(3.0, lower=0.0)) -> ph.PseudoHamiltonian:  # noqa: B008
    return ph.PseudoHamiltonian(
        states=("q", "v"),
        inputs=("u",),
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + v**2/2", k=k),
        R={"v": ph.formula("c", c=ph.Parameter(0.2, lower=0.0))},
        F={"v": ph.formula("g*u", g=ph.Parameter(0.8))},
    )


def estimated(
    data: ph.Measurements,
    loss: ph.MaximumLikelihood,
    model: ph.PseudoHamiltonian | None = None,
) -> Estimate:
    model = model or oscillator()
    task = Task(model, AlignedData.of(model, data), {}, None, ph.SolverSettings())
    return estimate_by(loss, task, None)


@cache
def record(seed: int) -> ph.Measurements:
    return simulated(seed)


@cache
def plain_fit(seed: int) -> ph.Fit:
    return ph.identify(oscillator(), record(seed))


@cache
def forced_fit(seed: int) -> ph.Fit:
    return ph.identify(oscillator(), record(seed), WITH_FORCE)


@cache
def search_of(seed: int) -> DisturbanceSearch:
    estimate = estimated(record(seed), ph.MaximumLikelihood())
    assert isinstance(estimate, LikelihoodEstimate)
    return estimate.plain_search


def widening(fit: ph.Fit) -> np.ndarray:
    """Standard errors over those of white noise."""
    table = fit.standard_errors
    return (table["std_error"] / table["white noise"]).to_numpy()


def errors_of(fit: ph.Fit) -> np.ndarray:
    return np.array([fit.values[name] - true for name, true in TRUE.items()])


# --- Standard errors of plain fits


def test_a_hidden_force_is_found_in_its_equation_and_widens_the_standard_errors() -> (
    None
):
    fit = plain_fit(0)
    assert fit.std_error_source == Source.DISTURBANCES
    assert str(fit.std_error_source) == "model error"
    (row,) = fit.model_error.to_dict("records")
    assert (row["where"], row["kind"]) == ("dv/dt", "force")
    assert SIZE / 1.5 < row["size"] < 1.5 * SIZE
    # 30 correlation times tell the logarithm of the time to about 0.4.
    assert TIME / 3 < row["time"] < 3 * TIME
    assert row["share"] == pytest.approx(0.1, abs=0.03)
    assert (widening(fit) > 2.5).all()
    assert "standard errors include model error (force in dv/dt" in str(fit)
    # Two of three standard errors, and none that is far off.
    z = errors_of(fit) / np.array([fit.std_errors[name] for name in TRUE])
    assert np.abs(z).max() < 3
    white = fit.standard_errors["white noise"].to_numpy()
    assert np.mean(np.abs(errors_of(fit)) > 3 * white) > 0.3


def test_with_nothing_hidden_white_noise_gives_the_standard_errors() -> None:
    fit = ph.identify(oscillator(), simulated(0, size=0.0))
    assert fit.std_error_source == Source.NOISE
    assert fit.model_error.empty
    np.testing.assert_array_equal(widening(fit), 1.0)
    np.testing.assert_array_equal(fit.degrees_of_freedom, fit.n_values - 3)
    assert fit.independent_share(["k", "c"]) == 1.0


def test_errors_of_a_sensor_that_last_are_told_from_forces() -> None:
    data = simulated(0, size=0.0, noise=0.05, kept=0.9)
    fit = ph.identify(oscillator(), data)
    assert fit.std_error_source == Source.DISTURBANCES
    (row,) = fit.model_error.to_dict("records")
    assert (row["where"], row["kind"]) == ("sensor of q", "sensor error")
    assert row["size"] == pytest.approx(0.05, rel=0.25)
    assert 0.5 < row["time"] < 2.0  # 0.95 makes a tenth of an error go in 0.1
    assert (widening(fit) > 1.5).all()


def test_many_trajectories_say_by_their_scatter_how_uncertain_a_fit_is() -> None:
    fit = ph.identify(oscillator(), simulated(2, n=100, runs=20))
    assert fit.std_error_source == Source.TRAJECTORIES
    assert {*fit.covariances} == {*Source}
    assert (widening(fit) > 2).all()
    # One less than the equal trajectories that they are worth, at least ten.
    assert ((fit.degrees_of_freedom >= 9) & (fit.degrees_of_freedom <= 19)).all()
    table = fit.standard_errors
    ratio = table["std_error"] / table["model error"]
    # 20 trajectories tell a standard error to 16 %.
    assert ratio.between(0.6, 1.6).all()
    few = ph.identify(oscillator(), simulated(2, n=100, runs=6))
    assert Source.TRAJECTORIES not in few.covariances
    assert few.std_error_source == Source.DISTURBANCES


@pytest.mark.parametrize("huber", [None, 1.345])
def test_trajectories_that_differ_by_noise_alone_scatter_as_noise_says(huber) -> None:
    """Residuals that are cut move an estimate no more, and scatter less."""
    ratios = []
    agreement = []
    for seed in range(3):
        data = simulated(seed, n=80, runs=24, size=0.0)
        estimate = estimated(data, ph.MaximumLikelihood(huber=huber))
        assert isinstance(estimate, LikelihoodEstimate)
        clusters = Clusters.of_white(
            estimate.plain_search, estimate.share_within, estimate.score_variance
        )
        agreement.append(clusters.agreement())
        scale = estimate.point.theta_scale
        std_errors = np.sqrt(np.diag(clusters.jackknife())) * scale
        variances = np.diag(estimate.uncertainty.covariance)
        ratios.append(std_errors / np.sqrt(variances))
    # Nine ratios, each known to about 20 %: their mean is known to 7 %.
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.12)
    # Three p-values: their mean is known to 0.17.
    assert np.mean(agreement) == pytest.approx(0.5, abs=0.3)


def test_intervals_use_the_degrees_of_freedom_of_each_standard_error() -> None:
    fit = plain_fit(0)
    freedom = fit.degrees_of_freedom
    # 30 correlation times of the force tell its size: not 297 independent values.
    assert ((freedom > 5) & (freedom < 100)).all()
    table = fit.intervals(0.9)
    half = (table["ci_upper"] - table["ci_lower"]) / 2
    expected = student_t.isf(0.05, freedom) * fit.standard_errors["std_error"]
    np.testing.assert_allclose(half, expected, rtol=1e-12)


def test_the_profile_means_what_the_standard_error_means() -> None:
    fit = plain_fit(0)
    found = ph.profile(fit, record(0), "k")
    freedom = fit.degrees_of_freedom[fit.names.index("k")]
    quantile = f_distribution.isf(0.05, 1, freedom)
    share = fit.independent_share(["k"])
    assert share < 0.1
    assert found.threshold == pytest.approx(quantile / share, rel=1e-9)
    limits = fit.intervals()
    lower = float(limits["ci_lower"]["k"])
    upper = float(limits["ci_upper"]["k"])
    assert found.curvature == pytest.approx((lower, upper), rel=1e-4)
    # The likelihood is nearly a parabola; ends are found to 2 % of the half width.
    half = (upper - lower) / 2
    assert found.ci_lower == pytest.approx(lower, abs=0.1 * half)
    assert found.ci_upper == pytest.approx(upper, abs=0.1 * half)


# --- Estimates with a model error


def test_the_standard_errors_of_estimates_with_a_force_hold() -> None:
    z = []
    for seed in range(6):
        fit = forced_fit(seed)
        z += (errors_of(fit) / fit.standard_errors["std_error"].to_numpy()).tolist()
        assert fit.std_error_source == Source.DISTURBANCES
        assert set(fit.model_error["where"]) == {"dv/dt"}
        assert set(fit.model_error["kind"]) == {"force"}
        assert fit.noise["q"] == pytest.approx(NOISE, rel=0.2)
    # 18 values: their root mean square is known to 17 %.
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.5


def test_what_does_not_go_with_a_model_error_is_refused() -> None:
    with pytest.raises(ph.ModelError, match=r"huber=1\.345 and model_error=True"):
        ph.MaximumLikelihood(huber=1.345, model_error=True)
    with pytest.raises(ph.ModelError, match="a profile is not available for a fit"):
        ph.profile(forced_fit(0), record(0), "k")
    with pytest.raises(ph.ModelError, match=r"and model_error=True .* leave l1 out"):
        ph.identify(oscillator(), record(0), WITH_FORCE, l1=0.01)
    pruned = ph.identify(
        oscillator(), record(0), WITH_FORCE, l1=0.01, pruning=ph.Pruning()
    )
    expected = forced_fit(0)
    for name in TRUE:
        assert pruned.values[name] == pytest.approx(expected.values[name], rel=1e-3)


def test_a_known_model_lets_a_force_in() -> None:
    fit = ph.identify(oscillator().with_fixed(TRUE), record(0), WITH_FORCE)
    assert fit.names == ()
    (row,) = fit.model_error.to_dict("records")
    assert SIZE / 1.5 < row["size"] < 1.5 * SIZE
    assert fit.noise["q"] == pytest.approx(NOISE, rel=0.2)


BESIDE = {
    "force": Disturbances(np.full((1, 2), NOISE), (Process(1, SIZE, TIME),)),
    "two forces": Disturbances(
        np.full((1, 2), NOISE), (Process(1, 0.1, 0.0), Process(1, SIZE, TIME))
    ),
    "force and sensor": Disturbances(
        np.full((1, 2), NOISE), (Process(1, SIZE, TIME),), (Process(0, 0.01, 2.0),)
    ),
    "force and function": Disturbances(
        np.full((1, 2), NOISE),
        (Process(1, SIZE, TIME),),
        functions=(StateFunction(1, 0, 0.1),),
    ),
}


@pytest.mark.parametrize("kind", list(BESIDE))
def test_the_steps_end_where_the_marginal_likelihood_says(kind, monkeypatch) -> None:
    """Linearised at the solution, nothing moves: neither parameters nor forces."""
    evidence = Evidence(BESIDE[kind], 0.0)
    monkeypatch.setattr(DisturbanceSearch, "found", lambda _: evidence)
    estimate = estimated(record(0), WITH_FORCE)
    assert isinstance(estimate, DisturbedEstimate)
    assert estimate.is_success
    d = estimate.disturbances
    places = [process.place for process in d.processes]
    assert places == [process.place for process in BESIDE[kind].processes]
    search = estimate.search
    system = search.likelihood(d).at(d)
    step = system.smoothed()
    std_error = np.sqrt(np.diag(system.covariance))
    limit = 0.1 if d.functions else 1e-3  # functions are those of the states before
    assert np.abs(step.theta / std_error).max() < limit
    largest = max(p.size for p in d.processes)
    found = estimate.joint.point.processes
    np.testing.assert_allclose(found, step.processes, atol=limit * largest)
    assert estimate.misfit == pytest.approx(0.9, abs=0.15)


# --- Parts, against dense algebra and simulation


def test_smooth_functions_have_the_correlation_of_their_length() -> None:
    rng = np.random.default_rng(1)
    values = 3 + 2 * rng.uniform(-1.7, 1.7, size=200)
    functions = smooth_functions(values)
    standard = (values - values.mean()) / values.std()
    distance = (standard[:, None] - standard) / LENGTH
    kernel = np.exp(-(distance**2) / 2)
    centred = (
        kernel - kernel.mean(axis=0) - kernel.mean(axis=1)[:, None] + kernel.mean()
    )
    straight = np.outer(standard, standard) / len(values)
    less = np.eye(len(values)) - (1 - LINEAR_SHARE) * straight
    # Ten points, and directions with more than a ten thousandth of the variance.
    np.testing.assert_allclose(
        functions @ functions.T, less @ centred @ less.T, atol=2e-3
    )
    assert functions.shape[1] < 10
    np.testing.assert_allclose(functions.mean(axis=0), 0.0, atol=1e-12)
    assert smooth_functions(np.full(5, 2.0)).shape == (5, 0)


def regressions(
    rng: np.random.Generator, n_runs: int, n: int, prior: np.ndarray | None = None
) -> tuple[Clusters, list[np.ndarray], list[np.ndarray]]:
    """Linear regressions of several runs on the same three coefficients."""
    slopes = [rng.normal(size=(n, 3)) for _ in range(n_runs)]
    values = [a @ [1.0, -1.0, 0.5] + rng.normal(size=n) for a in slopes]
    prior = np.zeros((3, 3)) if prior is None else prior
    estimate = least_squares(slopes, values, prior)
    scores = [a.T @ (y - a @ estimate) for a, y in zip(slopes, values, strict=True)]
    information = [a.T @ a for a in slopes]
    clusters = Clusters(np.array(scores), np.array(information), prior, np.zeros(3), 3)
    return clusters, slopes, values


def least_squares(
    slopes: Sequence[np.ndarray], values: Sequence[np.ndarray], prior: np.ndarray
) -> np.ndarray:
    a = np.vstack(slopes)
    return np.linalg.solve(a.T @ a + prior, a.T @ np.concatenate(values))


def test_the_jackknife_leaves_out_one_trajectory_at_a_time() -> None:
    size = np.array([0.7])  # of the function whose coefficient is the third
    prior = np.diag([0.0, 0.0, 1 / size[0] ** 2])
    rng = np.random.default_rng(2)
    clusters, slopes, values = regressions(rng, 12, 9, prior)
    estimate = least_squares(slopes, values, prior)
    moves = []
    for run in range(12):
        others = [i for i in range(12) if i != run]
        without = least_squares(
            [slopes[i] for i in others], [values[i] for i in others], prior
        )
        moves.append(without - estimate)
    expected = 11 / 12 * np.array(moves).T @ np.array(moves)
    np.testing.assert_allclose(clusters.jackknife(), expected, rtol=1e-9)
    # The coefficient behind the parameters is left out of what is told.
    borders = []
    for a, y in zip(slopes, values, strict=True):
        border = Border(
            a.T @ a, a.T @ y, float(y @ y), 0.0, 2, np.array([0]), size, np.zeros(2)
        )
        borders.append(border)
    step = Border.sum(borders).estimate
    np.testing.assert_allclose(step, estimate, rtol=1e-6)
    two = Clusters.of(borders, step)
    np.testing.assert_allclose(two.jackknife(), expected[:2, :2], rtol=1e-6)


def test_what_is_missing_is_looked_for_without_a_force_that_hides_it() -> None:
    fit = forced_fit(0)
    effects = [e for e in ph.catalogue(fit.model) if e.name == "cubic stiffness"]
    found = ph.diagnose(fit, record(0), effects=effects)
    plain = ph.diagnose(plain_fit(0), record(0), effects=effects)
    assert found.verdict == plain.verdict
    assert not found.record.fit.has_model_error
    assert found.record.fit.values["k"] == pytest.approx(plain_fit(0).values["k"])


def test_noise_that_lasts_from_sample_to_sample_is_not_called_unexplained() -> None:
    data = simulated(0, size=0.0, kept=0.7)
    fit = ph.identify(oscillator(), data)
    assert set(fit.model_error["kind"]) == {"sensor error"}
    found = ph.diagnose(fit, data)
    assert found.verdict == ph.Verdict.NOTHING_MISSING
    assert found.base.rmse < 1.1 * found.base.noise_floor


def spring_data() -> ph.Measurements:
    """The spring of the documentation: three runs, its dry friction not in the model."""
    shipped = Path(__file__).parents[1] / "docs" / "data" / "spring.csv"
    return ph.Measurements.from_csv(
        shipped, time="t_s", trajectory="run", states={"q": "position_m", "p": None}
    )


def spring(
    energy: str = "k*q**2/2 + p**2/(2*m)",
    *,
    sensor: Dictionary | None = None,
    F: Dictionary | None = None,
    **values: ph.Parameter,
) -> ph.PseudoHamiltonian:
    """A damped spring with a known mass, a sensor's formula or a force more."""
    known: dict[str, Number] = {"k": positive(40.0), "m": 2.5}
    shown = {} if sensor is None else {"q": sensor}
    return pair(energy, ph.damping("p"), F, sensor=shown, **(known | values))


ENERGY = "k*q**2/2 + p**2/(2*m)"
OWN = ph.Parameter(0.0, per_trajectory=True)
# What is silent in a model, by the name of an estimate: nothing of the first.
SILENT: dict[str, tuple[ph.PseudoHamiltonian, set[str]]] = {
    "an offset": (spring(sensor=ph.formula("b", b=ph.Parameter(0.0))), set()),
    "offset and force": (
        spring(
            sensor=ph.formula("b", b=ph.Parameter(0.0)),
            F=ph.formula("g", g=ph.Parameter(0.0)),
        ),
        {"b", "g"},
    ),
    "those of every run": (
        spring(sensor=ph.formula("b", b=OWN), F=ph.formula("g", g=OWN)),
        {f"{name}[run {run}]" for name in "bg" for run in (1, 2, 3)},
    ),
    "no trace at all": (spring(f"{ENERGY} + z*(q - q)", z=ph.Parameter(1.0)), {"z"}),
}


@pytest.mark.parametrize(
    ("name", "model_error"),
    [*((name, False) for name in SILENT), ("offset and force", True)],
)
def test_what_the_data_cannot_tell_is_named_and_the_rest_gets_standard_errors(
    name: str, model_error: bool
) -> None:
    model, silent = SILENT[name]
    fit = ph.identify(
        model, spring_data(), ph.MaximumLikelihood(model_error=model_error)
    )
    assert {n for n in fit.names if np.isnan(fit.std_errors[n])} == silent
    told = " ".join(fit.warnings)
    assert all(n in told for n in silent)
    assert fit.std_error_source == Source.DISTURBANCES


def test_the_first_step_of_a_search_promises_what_is_there_and_nothing_else() -> None:
    assert "forces" in search_of(0).promising
    nothing = estimated(simulated(0, size=0.0), ph.MaximumLikelihood())
    assert isinstance(nothing, LikelihoodEstimate)
    assert not nothing.plain_search.is_promising


@cache
def search_of_a_chain() -> DisturbanceSearch:
    """White noise alone, on twenty channels."""
    chain = chains.model(10)
    estimate = estimated(chains.data(10, 200), ph.MaximumLikelihood(), chain)
    assert isinstance(estimate, LikelihoodEstimate)
    return estimate.plain_search


def test_many_channels_promise_nothing_by_their_number() -> None:
    search = search_of_a_chain()
    white = Disturbances(search.plain)
    system = search.likelihood(white).at(white)
    sensors = search._with_kind(white, "sensors", 1.0, search.first_times()[0])
    gains = []
    for is_tied in (False, True):
        found = ascent.first_gains(system, search.channels, sensors, is_tied)
        gains.append(found[1])
    alone, tied = gains
    assert alone > STRONG_EVIDENCE  # by chance, with a size for each
    assert tied < STRONG_EVIDENCE / 2
    assert search.found().disturbances.is_white
