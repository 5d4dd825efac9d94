"""Names that an engineer would believe: small machines whose diagnosis once said what
nobody should.

They are simulated by SciPy, each with what was wrong in its reason.
"""

import re
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from scipy.integrate import solve_ivp

import phsi_opt as ph
from problems.battery.ask import Finding, findings_of
from problems.battery.draw import KINDS, draw
from problems.battery.records import Case
from tests.pushed_mass import pushed_mass

Force = Callable[[float, float], float]  # of position and velocity, at unit mass
GRAVITY = 9.81


def moved(
    force: Force, start: Sequence[float] | np.ndarray, t: np.ndarray
) -> np.ndarray:
    """Position and momentum of a unit mass, (n_samples, 2)."""

    def rates(time: float, x: np.ndarray) -> list[float]:
        return [x[1], force(x[0], x[1])]

    span = (t[0], t[-1])
    solved = solve_ivp(
        rates, span, start, t_eval=t, method="LSODA", rtol=1e-8, atol=1e-10
    )
    return solved.y.T


def seen(
    runs: list[np.ndarray], noise: float, seed: int, has_momentum: bool = False
) -> list[np.ndarray]:
    """Positions, and perhaps momenta, with noise as a share of their deviation."""
    rng = np.random.default_rng(seed)
    deviation = np.concatenate(runs).std(axis=0)
    shown = []
    for x in runs:
        y = x + noise * deviation * rng.normal(size=x.shape)
        if not has_momentum:
            y[:, 1] = np.nan
        shown.append(y)
    return shown


def swings(
    force: Force, noise: float, seed: int, t: np.ndarray
) -> tuple[ph.Measurements, ph.Measurements]:
    """Two runs for training, one held out."""
    starts = ([1.0, 0.0], [-0.8, 0.3], [0.9, -0.2])
    shown = seen([moved(force, start, t) for start in starts], noise, seed)
    data = ph.Measurements.from_arrays([t] * 3, shown, states=["q", "p"])
    return data[:2], data[2:]


def damped_spring(k: float, c: float) -> ph.PseudoHamiltonian:
    """A spring and a damper that begin at these values."""
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(k, lower=0)),
        R={"p": ph.formula("c", c=ph.Parameter(c, lower=0))},
    )


# --- falling bodies: model without inputs, all runs begin at t = 0


@cache
def drops(
    is_quadratic: bool, slowest: float, is_late: bool = False
) -> tuple[ph.Measurements, ph.Measurements]:
    """Three drops whose drag grows with the speed or its square; the height is seen.

    ``slowest``: terminal speed over that of the highest drop without drag; ``is_late``:
    each clock began some time before.
    """
    rng = np.random.default_rng(0)
    clocks = np.random.default_rng(1)
    heights = (10.0, 6.0, 8.0)
    speed = slowest * np.sqrt(2 * GRAVITY * max(heights))
    power = 2 if is_quadratic else 1

    def force(h: float, v: float) -> float:
        return -GRAVITY - GRAVITY * np.sign(v) * abs(v / speed) ** power

    times = []
    shown = []
    for height in heights:
        duration = np.sqrt(2 * height / GRAVITY)
        t = np.linspace(0.0, duration, 60)
        x = moved(force, [height, 0.0], t)
        y = np.full_like(x, np.nan)
        y[:, 0] = x[:, 0] + 0.003 * max(heights) * rng.normal(size=60)
        late = clocks.uniform(1.0, 5.0) * duration if is_late else 0.0
        times.append(t + late)
        shown.append(y)
    data = ph.Measurements.from_arrays(times, shown, states=["h", "p"])
    return data[:2], data[2:]


def falling_body(g: float | ph.Parameter) -> ph.PseudoHamiltonian:
    """A body without drag."""
    return ph.PseudoHamiltonian(
        states=["h", "p"],
        S=ph.canonical(1),
        H=ph.formula("g*h + p**2/2", g=g),
    )


@cache
def diagnosed_drops(is_late: bool) -> ph.Diagnosis:
    """Quadratic drag, missing; gravity is known."""
    train, test = drops(True, 1.0, is_late)
    return ph.diagnose(falling_body(GRAVITY), train, held_out=test)


@cache
def diagnosed_free_gravity() -> ph.Diagnosis:
    """Linear drag, missing; gravity is free, and a part of the drag is in it."""
    train, test = drops(False, 0.5)
    fit = ph.identify(falling_body(ph.Parameter(9.0, lower=0)), train)
    return ph.diagnose(fit, train, held_out=test)


def names(findings: set[Finding]) -> set[str]:
    """All names in all findings, without their equations."""
    return {name.split(" on ")[0] for one in findings for name in one}


def test_no_force_in_time_is_named_where_all_clocks_begin_at_zero() -> None:
    diagnosis = diagnosed_drops(is_late=False)
    in_time = {"drifting force", "harmonic force", "parametric stiffness"}
    assert findings_of(diagnosis)
    assert not in_time & names(findings_of(diagnosis))


def test_the_same_is_found_whenever_the_clocks_began() -> None:
    at_zero = diagnosed_drops(is_late=False)
    late = diagnosed_drops(is_late=True)
    assert findings_of(at_zero) == findings_of(late)


def test_nothing_is_named_alone_whose_size_the_record_does_not_tell() -> None:
    diagnosis = diagnosed_free_gravity()
    for candidate in diagnosis.ranking:
        is_known = candidate.std_error < 0.5 * abs(candidate.coefficient)
        if not is_known:
            assert frozenset({str(candidate.effect)}) not in findings_of(diagnosis)
    assert "hysteresis" not in names(findings_of(diagnosis))


def test_the_first_row_has_all_its_numbers() -> None:
    first = diagnosed_free_gravity().candidates.iloc[0]
    numbers = ["coefficient", "std_error", "log_bayes", "log_predictive"]
    assert np.isfinite(first[numbers].astype(float)).all()


def test_no_period_is_told_that_is_longer_than_the_record() -> None:
    diagnosis = diagnosed_drops(is_late=False)
    longest = max(np.ptp(run.t) for run in diagnosis.data.trajectories)
    for sentence in diagnosis.sentences:
        for period in re.findall(r"period ([\d.]+\d)", sentence):
            assert float(period) <= longest
        for frequency in re.findall(r"mostly at ([\d.]+\d)", sentence):
            assert float(frequency) >= 1 / longest


# --- parameters that are at a bound, or far off


def test_strong_damping_is_found_beside_a_spring_at_its_bound() -> None:
    """Critically damped; without the damping, all springs are best at zero."""
    train, test = swings(critical, 0.03, 2, np.linspace(0.0, 3.0, 31))
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula(
            "k*q**2/2 + b*q**4/4 + p**2/2",
            k=ph.Parameter(2.0, lower=0),
            b=ph.Parameter(0.5, lower=0),
        ),
    )
    train = train[:1]
    fit = ph.identify(model, train)
    assert fit.values["k"] < 1e-6
    diagnosis = ph.diagnose(fit, train, held_out=test)
    (damping,) = [c for c in diagnosis.ranking if c.effect.name == "viscous damping"]
    assert damping.was_weighed
    assert any("viscous damping on p" in one for one in findings_of(diagnosis))


def critical(q: float, v: float) -> float:
    """A spring of 2 with critical damping."""
    return -2.0 * q - 2.0 * np.sqrt(2.0) * v


def diagnosed_far_off(hidden: Force, factor: float) -> ph.Diagnosis:
    """A machine beside a model that was fitted to one of other stiffness and damping.

    ``factor``: on both of them.
    """
    k, c = 2.0, 0.2
    t = np.linspace(0.0, 20.0, 161)

    def other(q: float, v: float) -> float:
        return -factor * (k * q + c * v)

    def force(q: float, v: float) -> float:
        return -k * q - c * v + hidden(q, v)

    train, test = swings(force, 0.02, 0, t)
    model = damped_spring(factor * k, factor * c)
    elsewhere, _ = swings(other, 0.02, 1, t)
    fit = ph.identify(model, elsewhere)
    return ph.diagnose(fit, train, held_out=test)


def test_what_other_values_of_the_parameters_give_is_not_missing() -> None:
    diagnosis = diagnosed_far_off(lambda q, v: 0.0, 0.5)
    assert diagnosis.verdict == ph.Verdict.NOTHING_MISSING


def test_an_effect_is_named_from_parameters_that_are_far_off() -> None:
    diagnosis = diagnosed_far_off(lambda q, v: -0.6 * q**3, 1.5)
    assert any("cubic stiffness on p" in one for one in findings_of(diagnosis))


# --- closed loop


def controlled(
    friction: Callable[[float], float],
    frequencies: tuple[float, float],
    seed: int,
    has_momentum: bool = False,
) -> tuple[ph.Measurements, ph.Measurements]:
    """Moves of a unit mass under proportional and differential control.

    The controller's force is measured, and held between samples; the friction is not
    known. ``frequencies``: range of the reference's.
    """
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 30.0, 151)
    moves = []
    forces = []
    for _ in range(3):
        size = rng.uniform(0.7, 1.2)
        slow = rng.uniform(*frequencies)
        phase = rng.uniform(0.0, 6.0)
        wanted = size * np.sin(slow * t + phase) + 0.3 * size * np.sin(2.3 * slow * t)
        x = np.array([wanted[0], 0.0])
        states = [x]
        inputs = []
        for k, reference in enumerate(wanted):
            u = 9.0 * (reference - x[0]) - 4.0 * x[1]
            inputs.append(u)
            if k + 1 < len(t):
                step = moved(_pushed(u, friction), x, t[k : k + 2] - t[k])
                x = step[-1]
                states.append(x)
        moves.append(np.array(states))
        forces.append(np.array(inputs))
    data = ph.Measurements.from_arrays(
        [t] * 3,
        seen(moves, 0.02, seed, has_momentum),
        forces,
        states=["q", "p"],
        inputs=["u"],
        hold="zero",
    )
    return data[:2], data[2:]


def _pushed(u: float, friction: Callable[[float], float]) -> Force:
    return lambda q, v: u - friction(v)


def dry(v: float) -> float:
    """Coulomb friction with a corner of about 0.5 % of the typical speed."""
    return 0.6 * float(np.tanh(v / 0.005))


def test_stribeck_friction_is_not_named_alone_where_it_is_coulombs() -> None:
    train, test = controlled(dry, (0.8, 1.4), 1, has_momentum=True)
    laws = ["coulomb friction", "stribeck friction", "viscous damping"]
    diagnosis = ph.diagnose(pushed_mass(1.0), train, held_out=test, effects=laws)
    (found,) = findings_of(diagnosis)
    assert "coulomb friction on p" in found


def test_in_a_closed_loop_it_says_that_speed_and_input_go_together() -> None:
    train, test = controlled(dry, (0.3, 0.6), 2)
    model = pushed_mass(ph.Parameter(1.2, lower=0))
    fit = ph.identify(model, train)
    diagnosis = ph.diagnose(fit, train, held_out=test, effects=[])
    words = " ".join(diagnosis.sentences)
    together = r"(velocity|speed|dH_dp).*(go together|not told apart)"
    back = r"(go together|not told apart).*(velocity|speed|dH_dp)"
    assert re.search(together, words) or re.search(back, words)


# --- machines with 5 % of model error, of which no law leaves noise alone


def drawn_case(kind: str, seed: int) -> Case:
    """A machine of the battery, by its kind and a seed."""
    return draw(KINDS[kind], seed)


def test_the_simplest_law_that_explains_nearly_all_is_named() -> None:
    case = drawn_case("roll_decay", 107)
    assert case.places == {"viscous damping on p", "linear leak on p"}
    fit = ph.identify(case.model, case.train)
    diagnosis = ph.diagnose(fit, case.train, case.test)
    assert diagnosis.verdict == ph.Verdict.PARTLY_NAMED
    assert names(findings_of(diagnosis)) == {"viscous damping"}


def test_laws_that_one_run_held_out_hardly_tells_apart_are_a_class() -> None:
    case = drawn_case("falling", 106)
    assert case.places == {"quadratic drag on p"}
    fit = ph.identify(case.model, case.train)
    diagnosis = ph.diagnose(fit, case.train, case.test)
    (found,) = diagnosis.findings
    said = {str(effect) for effect in found.effects}
    assert said == {"quadratic drag on p", "cubic drag on p"}
    assert found.family == "a loss that grows with speed"


def test_a_larger_law_that_bends_to_the_error_of_the_model_is_not_named() -> None:
    case = drawn_case("chamber", 357)
    assert "linear leak on n" in case.places
    fit = ph.identify(case.model, case.train)
    diagnosis = ph.diagnose(fit, case.train, case.test)
    (found,) = findings_of(diagnosis)
    assert found & case.places
    assert "overflow on n" not in found


def test_a_smaller_law_is_named_where_a_larger_one_is_hardly_ahead() -> None:
    case = drawn_case("chamber", 334)
    assert case.places == {"turbulent leak on n"}
    fit = ph.identify(case.model, case.train)
    diagnosis = ph.diagnose(fit, case.train, case.test)
    (found,) = findings_of(diagnosis)
    assert "turbulent leak on n" in found


def test_hysteresis_is_not_named_where_nothing_turns_back() -> None:
    case = drawn_case("falling", 108)
    fit = ph.identify(case.model, case.train)
    diagnosis = ph.diagnose(fit, case.train, case.test)
    assert findings_of(diagnosis) == {frozenset({"viscous damping on p"})}


def test_a_loss_is_named_where_it_stands() -> None:
    case = drawn_case("circuit", 310)
    fit = ph.identify(case.model, case.train)
    losses = [one for one in ph.catalogue(fit.model) if one.slot == "R"]
    diagnosis = ph.diagnose(fit, case.train, case.test, effects=losses)
    (found,) = diagnosis.findings
    assert "linear resistance on flux" in {str(effect) for effect in found.effects}


def test_a_law_of_one_number_is_named_for_a_small_force_that_it_explains() -> None:
    laws = ("viscous damping", "stribeck friction", "drifting force")
    diagnosis = diagnosed_with("starts_off", 301, *laws)
    (found,) = diagnosis.findings
    assert "viscous damping on p" in {str(effect) for effect in found.effects}
    assert found.share > 0.9


def test_no_error_of_a_sensor_is_named_beside_what_is_missing() -> None:
    case = drawn_case("circuit", 309)
    fit = ph.identify(case.model, case.train)
    sensors = ["sensor offset", "sensor gain", "sensor drift", "sensor clipping"]
    effects = ["coil saturation", "leakage conductance", *sensors]
    diagnosis = ph.diagnose(fit, case.train, case.test, effects=effects)
    (found,) = findings_of(diagnosis)
    assert found == frozenset({"coil saturation on flux"})


@cache
def diagnosed_with(kind: str, seed: int, *names: str) -> ph.Diagnosis:
    """The diagnosis of a field machine with these candidates."""
    case = drawn_case(kind, seed)
    fit = ph.identify(case.model, case.train)
    effects = [f"{name} on p" for name in names]
    return ph.diagnose(fit, case.train, case.test, effects=effects)


def test_what_predicts_the_next_run_is_named() -> None:
    # Others bend to a random force that acted once; a damper is nearer to what the next
    # run did.
    others = ("coulomb friction", "quadratic stiffness")
    diagnosis = diagnosed_with("short_run", 502, "viscous damping", *others)
    (found,) = findings_of(diagnosis)
    assert "viscous damping on p" in found


def test_losses_that_the_evidence_does_not_tell_apart_are_a_class() -> None:
    laws = ("coulomb friction", "viscous damping")
    diagnosis = diagnosed_with("short_run", 511, *laws)
    first, _ = diagnosis.ranking
    assert repr(first) == f"Candidate('{first.name}', lost={first.lost!r})"
    assert repr(diagnosis.findings) == f"(Finding('{diagnosis.findings[0]}'),)"
    (found,) = findings_of(diagnosis)
    assert found == {f"{law} on p" for law in laws}


def test_hysteresis_is_not_named_alone_where_a_damper_is_missing() -> None:
    laws = ("hysteresis", "viscous damping", "quadratic drag", "coulomb friction")
    diagnosis = diagnosed_with("pendulum", 518, *laws)
    (found,) = findings_of(diagnosis)
    assert "viscous damping on p" in found
