"""Where a model fails: in time, states and frequency, and what the force follows."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError
from phsi_opt.estimation.identify import identify
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.analysis import (
    ForceAnalysis,
    _said,
    place_answer,
    place_words,
    plain_name,
    range_words,
    sentence,
)
from phsi_opt.force_analysis.dependence import Causes
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import Pace, StrongRange
from phsi_opt.force_analysis.pictures import plot_where
from phsi_opt.force_analysis.waves import spectrum
from phsi_opt.model.model import FirstOrder, PseudoHamiltonian
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.structure import canonical
from phsi_opt.model.terms import formula
from phsi_opt.simulation.simulate import simulate

M, K, D = 2.5, 40.0, 0.8
MAP = 1  # place of the map among the panels of a figure
UNITS = {"q": "m", "p": "kg m/s", "t": "s", "u": "N"}
Force = Callable[[float, float, float, float], float]  # of t, q, v, u
Number = Parameter | float
Case = Record


def cause_of(force: EquationForce) -> str:
    """What the force does: the end of a sentence that begins with "It"."""
    return _said(force, "cause").lead


def spring(c: Number | None = None) -> PseudoHamiltonian:
    """A driven spring whose stiffness, and damping unless given, are to be found."""
    k = Parameter(30.0, lower=0)
    c = Parameter(0.5, lower=0) if c is None else c
    return PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=canonical(1),
        H=formula("k*q**2/2 + p**2/(2*m)", k=k, m=M),
        R={"p": formula("c", c=c)},
        F={"p": formula("u")},
    )


def on_momentum(
    force: Force | None, t: np.ndarray, u: np.ndarray
) -> Callable[[float, np.ndarray], np.ndarray]:
    """What a force adds to dq/dt and dp/dt; input u (n,) at the times t (n,)."""

    def hidden(time: float, x: np.ndarray) -> np.ndarray:
        if force is None:
            return np.zeros(2)
        u_then = float(np.interp(time, t, u))
        return np.array([0.0, force(time, x[0], x[1] / M, u_then)])

    return hidden


def spring_with(
    force: Force | None,
    p_seen: bool = False,
    even: bool = True,
    model: PseudoHamiltonian | None = None,
    n: int = 121,
) -> Case:
    """A spring fitted to two trajectories of itself with a hidden force.

    Args:
        force: on the momentum; None: nothing is missing.
        p_seen: whether the momentum is measured beside the position.
        even: whether samples are evenly spaced.
        model: fitted; None: the spring with unknown stiffness and damping.
        n: samples of each trajectory.
    """
    rng = np.random.default_rng(0)
    true = spring().with_values({"k": K, "c": D})
    times, states, inputs = [], [], []
    for start in ([1.0, 0.0], [-0.8, 2.0]):
        t = np.linspace(0, 10, n)
        if not even:
            t = np.sort(np.r_[0.0, 10.0, rng.uniform(0, 10, n - 2)])
        u = 6 * np.sin(1.3 * t) + 5 * np.sin(3.7 * t + 1)
        x = simulate(true, t, start, u, force=on_momentum(force, t, u))
        y = x + np.array([0.01, 0.1]) * rng.normal(size=x.shape)
        if not p_seen:
            y[:, 1] = np.nan
        states.append(y)
        times.append(t)
        inputs.append(u[:, None])
    data = Measurements.from_arrays(
        times, states, inputs, states=["q", "p"], inputs=["u"], units=UNITS
    )
    fit = identify(model or spring(), data)
    return Record.of(fit, data)


def friction(t: float, q: float, v: float, u: float) -> float:
    return -3 * float(np.tanh(v / 1e-2))


def cubic(t: float, q: float, v: float, u: float) -> float:
    return -25 * q**3


def wave(t: float, q: float, v: float, u: float) -> float:
    return 3 * float(np.sin(2 * np.pi * 0.4 * t + 0.3))


def dead_zone(t: float, q: float, v: float, u: float) -> float:
    return -float(np.clip(u, -3, 3))


def constant(t: float, q: float, v: float, u: float) -> float:
    return 4.0


def push(t: float, q: float, v: float, u: float) -> float:
    return 6.0 if 4 < t < 5 else 0.0


HIDDEN: dict[str, Force] = {
    "friction": friction,
    "cubic": cubic,
    "wave": wave,
    "dead zone": dead_zone,
    "constant": constant,
    "push": push,
}


@pytest.fixture(scope="module")
def cases() -> dict[str, Case]:
    found = {name: spring_with(force) for name, force in HIDDEN.items()}
    found["friction, both"] = spring_with(friction, p_seen=True)
    found["nothing"] = spring_with(None)
    return found


@pytest.fixture(scope="module")
def tanks() -> Case:
    """Two tanks, the upper with a hidden leak.

    Both levels are measured, outlets and pump are to be found.
    """

    def model(b: Number, a1: Number, a2: Number, leak: str = "0") -> FirstOrder:
        out1 = "sqrt(h1**2 + 0.01)**0.5"
        out2 = "sqrt(h2**2 + 0.01)**0.5"
        upper = formula(f"b*u - a1*{out1} - {leak}", b=b, a1=a1)
        lower = formula(f"a1*{out1} - a2*{out2}", a1=a1, a2=a2)
        return FirstOrder(["h1", "h2"], {"h1": upper, "h2": lower}, ["u"])

    rng = np.random.default_rng(5)
    t = 4.0 * np.arange(300)
    u = np.repeat(rng.uniform(0.5, 4.0, 30), 10)[:, None]
    x = simulate(model(0.06, 0.07, 0.06, "0.005*h1**2"), t, [2.0, 2.0], u, hold="zero")
    y = x + 0.01 * rng.normal(size=x.shape)
    data = Measurements.from_arrays(
        t, y, u, states=["h1", "h2"], inputs=["u"], hold="zero"
    )
    b, a1, a2 = (Parameter(0.05, lower=0, upper=1) for _ in range(3))
    fit = identify(model(b, a1, a2), data)
    return Record.of(fit, data)


def best(case: Case, equation: str = "p") -> tuple[str, float]:
    found = ForceAnalysis.of(case).follows
    first = found[found["equation"] == equation].iloc[0]
    return str(first["variable"]), float(first["share"])


@pytest.mark.parametrize(
    ("name", "variable"),
    [
        ("friction", "p"),
        ("friction, both", "p"),
        ("cubic", "q"),
        ("wave", "t"),
        ("dead zone", "u"),
        ("constant", "constant"),
    ],
)
def test_the_variable_that_the_hidden_force_follows_is_named(
    cases: dict[str, Case], name: str, variable: str
) -> None:
    found, share = best(cases[name])
    # A pair with the right variable may predict a hundredth better; the sentences name
    # the single one then.
    assert variable in found.split(", ")
    assert share > 0.8  # what noise and smoothing leave of the force


@pytest.mark.parametrize(
    ("name", "cause", "words"),
    [
        ("friction", "dissipated", "changes how energy is lost"),
        ("cubic", "conserved", "stores and returns energy"),
        ("wave", "time", "period 2.5"),
        ("dead zone", "inputs", "follows the input u"),
        ("constant", "constant", "is constant at 3.9"),
    ],
)
def test_what_the_hidden_force_does_with_energy_is_named(
    cases: dict[str, Case], name: str, cause: str, words: str
) -> None:
    found = ForceAnalysis.of(cases[name])
    shares = found.energy.drop(columns=["equation", "mean_power"]).iloc[0]
    assert shares.drop("unexplained").idxmax() == cause
    assert shares.sum() == pytest.approx(1.0, abs=1e-12)
    assert words in cause_of(found.force_in("p"))


def test_friction_takes_energy_out_of_a_model_whose_damping_is_known() -> None:
    case = spring_with(friction, model=spring(D))
    found = ForceAnalysis.of(case)
    assert "takes energy out (it opposes the velocity of q)" in found.sentences[0]
    speed = np.abs(case.estimate.x[:, 1] / M).mean()
    # Minus friction times speed, but for what smoothing takes off where the velocity
    # turns.
    assert found.energy["mean_power"].iloc[0] == pytest.approx(-3 * speed, rel=0.15)


def test_a_short_push_is_placed_in_its_time(cases: dict[str, Case]) -> None:
    row = ForceAnalysis.of(cases["push"]).where.iloc[0]
    begin, end = (float(text) for text in row["time_window"].split(" to "))
    assert 4 - 0.1 <= begin < end <= 5 + 0.1  # a tenth of the record, to a sample
    assert row["trajectory"] in cases["push"].trajectories


def test_a_stiffening_spring_is_strong_at_both_ends_of_the_positions(
    cases: dict[str, Case],
) -> None:
    case = cases["cubic"]
    region = ForceAnalysis.of(case).where["state_region"].iloc[0]
    assert region.startswith("q ")
    assert "p" not in region.replace("positions", "")
    bounds = [float(v) for part in region[2:].split(" or ") for v in part.split(" to ")]
    assert max(abs(v) for v in bounds) > 0.6 * np.abs(case.estimate.x[:, 0]).max()


def test_the_frequency_of_a_hidden_wave_is_found_in_even_and_uneven_samples(
    cases: dict[str, Case],
) -> None:
    for case in (cases["wave"], spring_with(wave, even=False)):
        # The peak of ten seconds is 0.1 wide; noise moves its top by a fraction of
        # that.
        frequency = ForceAnalysis.of(case).where["frequency"].iloc[0]
        assert frequency == pytest.approx(0.4, abs=0.03)
        assert best(case)[0] == "t"


def test_where_nothing_is_missing_no_force_is_called_sure(
    cases: dict[str, Case],
) -> None:
    found = ForceAnalysis.of(cases["nothing"])
    assert found.where["times_noise"].iloc[0] < 0.5
    assert "no missing force is sure" in found.sentences[0]


def test_every_hidden_force_is_surer_than_its_standard_deviation(
    cases: dict[str, Case],
) -> None:
    for name in HIDDEN:
        row = ForceAnalysis.of(cases[name]).where.iloc[0]
        assert row["times_noise"] > 1
        typical = float(np.median(cases[name].estimate.posterior.deviation))
        # The sizes of force and noise have settled within 2 % per update, and both
        # shift the ratio.
        assert row["times_noise"] == pytest.approx(row["strength"] / typical, rel=0.1)


def test_a_leak_follows_its_own_level_and_the_rest_is_laid_to_the_parameters(
    tanks: Case,
) -> None:
    found = ForceAnalysis.of(tanks)
    assert list(found.where["equation"]) == ["h1", "h2"]  # the strongest first
    assert best(tanks, "h1")[0] == "h1"
    upper, lower = found.energy.to_dict("records")
    assert upper["dissipated"] > 0.8
    # The outlets of the second tank are right but for a1 and a2, which the leak has
    # moved.
    assert lower["parameters"] > 0.8
    assert "other values of the model's own parameters" in found.sentences[1]


def test_a_parameter_of_small_numbers_is_not_taken_for_one_at_its_bound() -> None:
    small = PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=canonical(1),
        H=formula("1e9*k*q**2/2 + p**2/(2*m)", k=Parameter(3e-8, lower=0), m=M),
        F={"p": formula("u")},
    )
    force = ForceAnalysis.of(spring_with(cubic, model=small, n=41)).force_in("p")
    assert force.by_parameters.shape[1] == 1


def test_noise_without_a_pattern_earns_no_share(cases: dict[str, Case]) -> None:
    case = cases["constant"]
    rng = np.random.default_rng(1)
    noise = rng.normal(size=case.estimate.w.shape)
    analysis = ForceAnalysis.of(replace(case, estimate=replace(case.estimate, w=noise)))
    found = analysis.follows
    # 2 to 49 coefficients for 400 values, none of them earned.
    assert found["share"].max() < 0.1
    assert cause_of(analysis.force_in("p")) == "no clear pattern"


def test_shares_do_not_depend_on_the_unit_of_the_force(cases: dict[str, Case]) -> None:
    case = cases["cubic"]
    larger = replace(case.estimate, w=1e3 * case.estimate.w)
    scaled = ForceAnalysis.of(replace(case, estimate=larger)).follows
    plain = ForceAnalysis.of(case).follows
    np.testing.assert_allclose(scaled["share"], plain["share"], atol=1e-9)


@pytest.mark.parametrize("even", [True, False])
def test_a_sine_has_its_amplitude_in_the_spectrum(even: bool) -> None:
    rng = np.random.default_rng(0)
    one = np.linspace(0, 20, 400) if even else np.sort(rng.uniform(0, 20, 400))
    t = np.r_[one, one]
    run = np.repeat([0, 1], 400)
    found = spectrum(t, run, 2.0 * np.sin(2 * np.pi * 1.5 * t + run))
    assert found.peak == pytest.approx(1.5, abs=0.02)
    # Gaps are bridged by straight lines.
    tolerance = 0.01 if even else 0.1
    assert found.amplitudes.max() == pytest.approx(2.0, rel=tolerance)


def test_the_draws_of_the_error_have_the_standard_deviation_of_the_force(
    cases: dict[str, Case],
) -> None:
    estimate = cases["cubic"].estimate
    draws = estimate.posterior.error_draws(n_draws=400)
    # 400 draws tell each standard deviation to 3.5 %; the mean over all intervals
    # better than that.
    ratio = draws.std(axis=2) / estimate.posterior.deviation
    assert ratio.mean() == pytest.approx(1.0, abs=0.03)
    assert np.ptp(ratio) < 0.4


def test_sentences_say_size_place_and_cause_with_units(cases: dict[str, Case]) -> None:
    (said,) = ForceAnalysis.of(cases["wave"]).sentences
    for part in (
        "dp/dt lacks a force of rms 2.",
        " N, ",
        " Hz",
        "period 2.5",
        "Best predicted from t",
    ):
        assert part in said


def test_a_place_is_told_as_people_say_it(cases: dict[str, Case]) -> None:
    force = ForceAnalysis.of(cases["cubic"]).force_in()
    assert re.search(r"where q is highest \(above 0\.\d+ m\)", place_words(force))
    assert plain_name(force, "dH_dp") == "the velocity of q"
    ends = [StrongRange(-2.0, -1.0, True, False), StrongRange(1.0, 2.0, False, True)]
    assert range_words(force, "dH_dp", ends) == (
        "at high speed, either way (the velocity of q below -1 or above 1 m/s)"
    )
    assert range_words(force, "q", ends[:1]) == "where q is lowest (below -1 m)"
    assert range_words(force, "q", ends[1:]) == "where q is highest (above 1 m)"
    inside = StrongRange(0.1, 0.2, False, False)
    assert range_words(force, "q", [inside]) == "where q is 0.1 to 0.2 m"


def with_found(force: EquationForce, **found: object) -> EquationForce:
    """The force, of which something else was found."""
    other = replace(force)
    other.__dict__.update(found)
    return other


def test_a_place_never_contradicts_what_the_force_follows(
    cases: dict[str, Case],
) -> None:
    told = {}
    for name in ("friction", "wave", "cubic"):
        force = ForceAnalysis.of(cases[name]).force_in()
        told[name] = str(place_answer(force, is_named=False, is_known=False))
    assert told["friction"].startswith(
        "In dp/dt, the force on q. It depends on the velocity of q. It changes how "
        "energy is lost"
    )
    on = "In dp/dt, the force on q"
    assert told["wave"].startswith(f"{on}. It depends on the time, not on a place.")
    assert told["cubic"].startswith(
        f"{on}. It depends on the position q; largest where q is highest"
    )
    force = ForceAnalysis.of(cases["cubic"]).force_in()
    nothing = with_found(force, causes=Causes({}, {}))
    told["nothing"] = str(place_answer(nothing, is_named=False, is_known=False))
    assert re.fullmatch(
        r"In dp/dt, the force on q; no state, input or time explains it\. "
        r"It is largest where q is highest \(above [\d.]+ m\).*",
        told["nothing"],
    )
    assert "alike" not in " ".join(told.values())


def test_what_moves_together_is_said_not_to_be_separable(
    cases: dict[str, Case],
) -> None:
    force = ForceAnalysis.of(cases["friction"]).force_in()
    driven = Causes({"inputs": 0.82}, {"inputs": 0.82}, goes_together=True)
    closed_loop = with_found(force, causes=driven)
    assert cause_of(closed_loop) == (
        "follows the input u, which explains 82 % of it; not told apart from the "
        "velocity of q, which moves together with the input here"
    )
    said = str(place_answer(closed_loop, is_named=True, is_known=False))
    assert "It depends on the velocity of q or on the input u" in said
    assert (
        "82 % of it is explained by the velocity of q or by the input u; these data "
        "cannot separate the two."
    ) in said


def test_a_force_far_faster_than_the_motion_is_called_a_vibration(
    cases: dict[str, Case],
) -> None:
    force = ForceAnalysis.of(cases["wave"]).force_in("p")
    assert not force.pace.is_vibration
    pace = replace(force.pace, frequency=20 * force.pace.motion)
    assert pace.is_vibration
    assert "20 times as fast as the motion" in pace.speed_words({"t": "s"})
    assert pace.samples_per_cycle >= 2
    said = sentence(with_found(force, pace=pace))
    assert "a vibration or an error of a sensor" in said


def test_what_follows_the_quick_parts_of_a_slow_motion_is_no_vibration(
    cases: dict[str, Case],
) -> None:
    # A lag in steps that are held for minutes: it moves within four seconds.
    stepped = Pace(0.08, 0.002, 4.0, 0.1, 0.6, 1.4)
    assert not stepped.is_vibration
    assert replace(stepped, time=20.0).is_vibration
    pace = ForceAnalysis.of(cases["wave"]).force_in("p").pace
    # Of a sine, the deviation over that of its rate is a period over two pi.
    assert pace.time == pytest.approx(1 / (2 * np.pi * pace.motion), rel=0.3)


def test_a_force_is_told_beside_the_models_own_rate() -> None:
    assert Pace(1.0, 1.0, 0.2, 0.1, 5.0, 2.0).size_words("dp/dt") == (
        "2.5 times the size of the model's own dp/dt"
    )
    assert (
        Pace(1.0, 1.0, 0.2, 0.1, 1.0, 2.0).size_words("dp/dt")
        == "50 % of the model's own dp/dt"
    )
    assert Pace(1.0, 1.0, 0.2, 0.1, 1.0, 0.0).size_words("dp/dt") == ""


@pytest.fixture
def closing() -> Iterator[None]:
    yield
    plt.close("all")


@pytest.mark.usefixtures("closing")
def test_the_four_panels_name_what_they_show(cases: dict[str, Case]) -> None:
    figure = plot_where(ForceAnalysis.of(cases["cubic"]))
    assert isinstance(figure, Figure)
    titles = [" ".join(ax.get_title().split()) for ax in figure.axes if ax.get_title()]
    assert len(titles) == 4
    assert "surely lacks a force" in titles[0]
    assert "strong where q" in titles[1]
    assert "follows q" in titles[2]
    assert "strongest at" in titles[3]
    assert "(N)" in figure.axes[0].get_ylabel()


@pytest.mark.usefixtures("closing")
def test_cells_that_were_not_visited_are_blank_and_colours_are_symmetric(
    cases: dict[str, Case],
) -> None:
    ax = plot_where(ForceAnalysis.of(cases["friction"])).axes[MAP]
    (mesh,) = ax.collections
    values: np.ma.MaskedArray = np.ma.asarray(mesh.get_array())
    assert 0 < np.ma.count_masked(values) < values.size
    low, high = mesh.get_clim()
    assert low == -high == -np.ma.max(np.ma.abs(values))
    assert ax.get_ylabel() == "velocity dH_dp = dq/dt (m/s)"


@pytest.mark.usefixtures("closing")
def test_a_force_between_two_masses_is_mapped_over_both_positions() -> None:
    rng = np.random.default_rng(0)
    t = np.linspace(0, 20, 201)
    c = Parameter(0.1, lower=0)
    k = Parameter(5.0, lower=0)
    model = PseudoHamiltonian(
        states=["q1", "q2", "p1", "p2"],
        S=canonical(2),
        R={"p1": formula("c", c=c), "p2": formula("c", c=c)},
        H=formula("k*(q1**2 + q2**2)/2 + p1**2/2 + p2**2/4", k=k),
    )

    def between(at: float, x: np.ndarray) -> np.ndarray:
        f = 2 * (x[0] - x[1]) ** 3
        return np.array([0.0, 0.0, -f, f])

    x = simulate(model, t, [1.0, -0.5, 0.0, 1.0], force=between)
    y = x + 0.01 * rng.normal(size=x.shape)
    data = Measurements.from_arrays(t, y, states=["q1", "q2", "p1", "p2"])
    fit = identify(model, data)
    case = Record.of(fit, data)
    assert best(case, "p1")[0] == "q1, q2"
    analysis = ForceAnalysis.of(case)
    assert "positions q1, q2" in cause_of(analysis.force_in("p1"))
    ax = plot_where(analysis, "p1").axes[MAP]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("q1", "q2")


@pytest.mark.usefixtures("closing")
def test_tanks_are_drawn_over_the_states_that_matter(tanks: Case) -> None:
    analysis = ForceAnalysis.of(tanks)
    over_time, over_states, beside, spectrum, *_ = plot_where(analysis, "h1").axes
    assert {over_states.get_xlabel(), over_states.get_ylabel()} == {"h1", "h2"}
    assert "follows h1" in beside.get_title()
    assert spectrum.get_xlabel() == "frequency (cycles per unit of time)"
    assert over_time.get_ylabel() == "missing force"


@pytest.mark.usefixtures("closing")
def test_a_model_of_one_state_has_the_force_over_it_in_place_of_a_map() -> None:
    rng = np.random.default_rng(6)
    t = np.linspace(0, 20, 200)
    u = 1 + np.sin(0.7 * t)
    true = FirstOrder(["h"], {"h": formula("u - 0.5*h - 0.1*h**2")}, ["u"])
    x = simulate(true, t, [0.5], u)
    y = x + 0.005 * rng.normal(size=x.shape)
    data = Measurements.from_arrays(t, y, u[:, None], states=["h"], inputs=["u"])
    outlet = formula("u - a*h", a=Parameter(0.4, lower=0))
    fit = identify(FirstOrder(["h"], {"h": outlet}, ["u"]), data)
    ax = plot_where(ForceAnalysis.of(Record.of(fit, data))).axes[MAP]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("h", "missing force")
    labels = ax.get_legend_handles_labels()[1]
    assert set(labels) == {"force", "mean in bins", "std. deviation"}


@pytest.mark.usefixtures("closing")
def test_an_equation_that_is_not_there_is_refused_by_name(
    cases: dict[str, Case],
) -> None:
    analysis = ForceAnalysis.of(cases["wave"])
    with pytest.raises(
        ModelError, match=r"equation='q' has no missing force.*one of p\."
    ):
        plot_where(analysis, "q")
