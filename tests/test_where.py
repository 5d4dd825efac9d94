"""Where a model fails: in time, states and frequency, and what the force follows."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lombscargle

import phsi_opt as ph
from phsi_opt.data.spectrum import spectrum
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.analysis import ForceAnalysis, where_answer
from phsi_opt.force_analysis.cross_validation import (
    explained_share,
    left_out_error,
)
from phsi_opt.force_analysis.pictures import plot_where
from phsi_opt.force_analysis.waves import _power
from tests import systems
from tests.systems import Number, pair, positive, recorded

M, K, D = 2.5, 40.0, 0.8
UNITS = {"q": "m", "p": "kg m/s", "t": "s", "u": "N"}
Force = Callable[[float, float, float, float], float]  # of t, q, v, u


def spring(k: Number | None = None, c: Number | None = None) -> ph.PseudoHamiltonian:
    """A driven spring whose stiffness and damping are to be found unless given."""
    k = positive(30.0) if k is None else k
    return systems.spring(k, positive(0.5) if c is None else c, M, "u")


def spring_with(
    force: Force,
    even: bool = True,
    model: ph.PseudoHamiltonian | None = None,
    n: int = 121,
) -> Record:
    """A spring fitted to two trajectories of n samples with a hidden force on it."""
    rng = np.random.default_rng(0)
    times, states, inputs = [], [], []
    for start in ([1.0, 0.0], [-0.8, 2.0]):
        t = np.linspace(0, 10, n)
        if not even:
            t = np.sort(np.r_[0.0, 10.0, rng.uniform(0, 10, n - 2)])
        u = 6 * np.sin(1.3 * t) + 5 * np.sin(3.7 * t + 1)

        def hidden(
            time: float, x: np.ndarray, t: np.ndarray = t, u: np.ndarray = u
        ) -> np.ndarray:
            f = force(time, x[0], x[1] / M, float(np.interp(time, t, u)))
            return np.array([0.0, f])

        x = ph.simulate(spring(K, D), t, start, u, force=hidden)
        y = x + np.array([0.01, np.nan]) * rng.normal(size=x.shape)
        states.append(y)
        times.append(t)
        inputs.append(u[:, None])
    data = ph.Measurements.from_arrays(
        times, states, inputs, states=["q", "p"], inputs=["u"], units=UNITS
    )
    return Record.of(ph.identify(model or spring(), data), data)


def friction(t: float, q: float, v: float, u: float) -> float:
    return -3 * float(np.tanh(v / 1e-2))


def wave(t: float, q: float, v: float, u: float) -> float:
    return 3 * float(np.sin(2 * np.pi * 0.4 * t + 0.3))


HIDDEN: dict[str, Force] = {
    "friction": friction,
    "cubic": lambda t, q, v, u: -25 * q**3,
    "wave": wave,
    "dead zone": lambda t, q, v, u: -float(np.clip(u, -3, 3)),
    "constant": lambda t, q, v, u: 4.0,
    "push": lambda t, q, v, u: 6.0 if 4 < t < 5 else 0.0,
    "nothing": lambda t, q, v, u: 0.0,
}


@pytest.fixture(scope="module")
def cases() -> dict[str, ForceAnalysis]:
    return {name: ForceAnalysis.of(spring_with(f)) for name, f in HIDDEN.items()}


def best(found: ForceAnalysis, equation: str = "p") -> tuple[str, float]:
    first = found.follows[found.follows["equation"] == equation].iloc[0]
    return str(first["variable"]), float(first["share"])


# ---- what it follows -----------------------------------------------------------------


@pytest.mark.parametrize(("name", "variable", "cause", "words"), [
    ("friction", "p", "dissipated", "depends on the velocity of q"),
    ("cubic", "q", "conserved", "depends on the position q"),
    ("wave", "t", "time", "depends on time"),
    ("dead zone", "u", "inputs", "depends on the input u"),
    ("constant", "constant", "constant", "is constant at 3.94 N"),
])  # fmt: skip
def test_what_the_hidden_force_follows_and_does_with_energy_is_named(
    cases: dict[str, ForceAnalysis], name: str, variable: str, cause: str, words: str
) -> None:
    found = cases[name]
    followed, share = best(found)
    # A pair with the right variable may predict a hundredth better; the sentences name
    # the single one then.
    assert variable in followed.split(", ")
    assert share > 0.8  # what noise and smoothing leave of the force
    shares = found.energy.drop(columns=["equation", "mean_power", "unit"]).iloc[0]
    assert shares.drop("unexplained").idxmax() == cause
    assert shares.sum() == pytest.approx(1.0, abs=1e-12)
    assert f"It {words}" in where_answer(found.force_in("p")).detail


def test_friction_takes_energy_out_of_a_model_whose_damping_is_known() -> None:
    record = spring_with(friction, model=spring(c=D))
    found = ForceAnalysis.of(record)
    assert "It depends on the velocity of q, which explains" in found.sentences[0]
    speed = np.abs(record.estimate.x[:, 1] / M).mean()
    # Minus friction times speed, but for what smoothing takes off where the velocity
    # turns.
    assert found.energy["mean_power"].iloc[0] == pytest.approx(-3 * speed, rel=0.15)
    assert found.energy["unit"].iloc[0] == "W"


# ---- where and when ------------------------------------------------------------------


def test_a_short_push_is_placed_in_its_time(cases: dict[str, ForceAnalysis]) -> None:
    row = cases["push"].where.iloc[0]
    begin, end = (float(text) for text in row["time_window"].split(" to "))
    assert 4 - 0.1 <= begin < end <= 5 + 0.1  # a tenth of the record, to a sample
    assert row["trajectory"] in cases["push"].record.along.runs


def test_a_stiffening_spring_is_strong_at_both_ends_of_the_positions(cases) -> None:
    region = cases["cubic"].where["state_region"].iloc[0]
    assert region.startswith("q ") and "p" not in region
    bounds = [float(v) for part in region[2:].split(" or ") for v in part.split(" to ")]
    visited = np.abs(cases["cubic"].record.estimate.x[:, 0]).max()
    assert max(abs(v) for v in bounds) > 0.6 * visited


def test_the_frequency_of_a_hidden_wave_is_found_in_even_and_uneven_samples(
    cases: dict[str, ForceAnalysis],
) -> None:
    for found in (cases["wave"], ForceAnalysis.of(spring_with(wave, even=False))):
        # The peak of ten seconds is 0.1 wide; noise moves its top by a fraction.
        frequency = found.where["frequency"].iloc[0]
        assert frequency == pytest.approx(0.4, abs=0.03)
        assert best(found)[0] == "t"


def test_a_force_is_sure_where_one_is_missing_and_not_where_none_is(cases) -> None:
    for name, found in cases.items():
        row = found.where.iloc[0]
        assert row["unit"] == found.forces[0].scale.unit
        assert row["times_noise"] > 1 or name == "nothing"
        typical = float(np.median(found.record.estimate.posterior.deviation))
        # The sizes of force and noise have settled within 2 % per update, and both
        # shift the ratio.
        assert row["times_noise"] == pytest.approx(row["strength"] / typical, rel=0.1)
    assert cases["nothing"].where["times_noise"].iloc[0] < 0.5
    assert "No missing force is significant" in cases["nothing"].sentences[0]


@pytest.mark.parametrize("even", [True, False])
def test_a_sine_has_its_amplitude_in_the_spectrum(even: bool) -> None:
    rng = np.random.default_rng(0)
    one = np.linspace(0, 20, 400) if even else np.sort(rng.uniform(0, 20, 400))
    t = np.r_[one, one]
    run = np.repeat([0, 1], 400)
    found = spectrum(t, run, 2.0 * np.sin(2 * np.pi * 1.5 * t + run))
    assert found.peak == pytest.approx(1.5, abs=0.02)
    # Gaps are bridged by straight lines.
    assert found.amplitudes.max() == pytest.approx(2.0, rel=0.01 if even else 0.1)


# ---- in words ------------------------------------------------------------------------


def test_the_power_of_a_wave_is_the_fall_of_the_squares_by_sine_and_cosine() -> None:
    rng = np.random.default_rng(0)
    z = np.sort(rng.uniform(0, 7, 300))
    y = rng.normal(size=300)
    frequencies = np.array([0.03, 0.2, 1.7, 20.0])
    expected = 2 * lombscargle(z, y, 2 * np.pi * frequencies)
    np.testing.assert_allclose(_power(z, y, frequencies), expected, rtol=1e-9)
    for frequency, fall in zip(frequencies, expected, strict=True):
        phase = 2 * np.pi * frequency * z
        waves = np.column_stack([np.sin(phase), np.cos(phase)])
        left = np.linalg.lstsq(waves, y)[1][0]
        assert y @ y - left == pytest.approx(fall, rel=1e-9)


def test_sentences_say_size_place_and_cause_with_units(cases) -> None:
    (said,) = cases["wave"].sentences
    assert "The equation of p lacks a force of 2." in said
    for part in (" N (rms), ", " Hz", "It depends on time, which explains"):
        assert part in said


# ---- pictures ------------------------------------------------------------------------


@pytest.fixture
def closing() -> Iterator[None]:
    yield
    plt.close("all")


@pytest.mark.usefixtures("closing")
def test_the_panels_name_what_they_show(cases) -> None:
    axes = plot_where(cases["cubic"]).axes
    titles = [" ".join(ax.get_title().split()) for ax in axes if ax.get_title()]
    expected = ["Significant in", "q predicts"]
    for title, part in zip(titles, expected, strict=True):
        assert part in title
    assert "after removing what other parameter values could explain" in titles[-1]
    assert "(N)" in axes[0].get_ylabel()
    with pytest.raises(ph.ModelError, match=r"equation=.q. has no missing force.*of p"):
        plot_where(cases["wave"], "q")


# ---- functions, and the stretches that judge them ------------------------------------


def share(w: np.ndarray, fold: np.ndarray, *bases: np.ndarray) -> float:
    return explained_share(left_out_error(w, fold, bases), float(w @ w))


# ---- forces that repeat along a position: a motor that cogs six times a turn

INERTIA = 0.02  # kg m^2
DAMPING = 0.3  # N m s/rad
TURN = {"rad": 2 * np.pi, "deg": 360.0, "": 2 * np.pi}


def cogging(q: float) -> float:
    return -0.15 * np.sin(6 * q)


def stop(q: float) -> float:
    """A soft stop on either side: a law of the position that does not repeat."""
    return -2.0 * float(np.sign(q) * max(abs(q) - 1.0, 0.0))


@cache
def turned(torque: Callable[[float], float], unit: str) -> ph.Measurements:
    """Angles of two runs under a measured torque, in ``unit``, with noise."""
    rng = np.random.default_rng(3)
    t = np.arange(0, 8, 0.02)
    scale = TURN[unit] / TURN["rad"]
    angles = []
    drives = []
    for _ in range(2):
        phases = rng.uniform(0, 2 * np.pi, size=(4, 1))
        hertz = np.array([[0.15], [0.3], [0.5], [0.8]])
        drive = 0.6 * np.sum(np.sin(2 * np.pi * hertz * t + phases), axis=0)

        def rates(s: float, x: np.ndarray, u: np.ndarray = drive) -> list[float]:
            loss = DAMPING * x[1]
            return [x[1], (np.interp(s, t, u) + torque(x[0]) - loss) / INERTIA]

        x = solve_ivp(rates, (t[0], t[-1]), [0, 0], t_eval=t, rtol=1e-8, max_step=0.02)
        noisy = x.y[0] + 0.002 * rng.normal(size=len(t))
        angles.append(np.column_stack([scale * noisy, np.full(len(t), np.nan)]))
        drives.append(scale * drive[:, None])
    return ph.Measurements.from_arrays(
        [t] * 2,
        angles,
        drives,
        states=["q", "p"],
        inputs=["u"],
        units={"q": unit, "t": "s"},
    )


def motor() -> ph.PseudoHamiltonian:
    return pair("p**2/(2*J)", ph.damping("p"), "u", J=positive(0.03, lower=1e-3))


@cache
def compared(torque: Callable[[float], float], unit: str = "rad") -> ph.Comparison:
    data = turned(torque, unit)
    return ph.compare(ph.identify(motor(), data), data)


@cache
def analysed(torque: Callable[[float], float], unit: str = "rad") -> ForceAnalysis:
    return ForceAnalysis.of(compared(torque, unit).record)


def test_a_force_that_repeats_along_a_position_is_found() -> None:
    data = turned(cogging, "rad")
    fit = ph.identify(motor(), data)
    found = ph.diagnose(fit, data, kinds=["functions"])
    (finding,) = found.findings
    assert list(map(str, finding.effects)) == ["unknown force f(q) that repeats on p"]
    assert found.proposed_fit is not None
    omega = found.proposed_fit.values["F_p.omega_q"]
    assert omega == pytest.approx(6.0, rel=2e-3)
    first = found.candidates.iloc[0]
    assert first["train_rmse"] < 1.1 * found.base.noise_floor


def test_a_law_of_the_position_follows_it() -> None:
    analysis = analysed(stop)
    assert analysis.follows.iloc[0]["variable"] == "q"


def test_a_sentence_tells_a_force_in_the_unit_of_the_table() -> None:
    t = np.arange(0.0, 60.0, 2.0)
    level = 50.0 - 0.2 * t + np.random.default_rng(2).normal(0, 0.1, len(t))
    data = ph.Measurements.from_arrays(
        t, level[:, None], states=["h"], units={"t": "s", "h": "cm"}
    ).in_si()
    model = ph.FirstOrder(["h"], {"h": ph.formula("0*h")})
    found = ForceAnalysis.of(Record.of(ph.identify(model, data), data))
    strength = found.where["strength"][0]
    assert strength == pytest.approx(0.2, rel=0.1)
    assert f" of {strength:.3g} cm/s (rms)," in found.sentences[0]


def test_a_torque_is_told_in_newton_metres_where_the_inertia_is_known() -> None:
    t = np.arange(0.0, 8.0, 0.05)
    u = np.sign(np.sin(2.0 * t))
    inertia, friction = 0.05, 0.12

    def rate(s: float, w: np.ndarray) -> np.ndarray:
        pushed = np.interp(s, t, u) - 0.1 * w - friction * np.tanh(w / 0.01)
        return np.asarray(pushed / inertia)

    w = solve_ivp(rate, (0.0, 8.0), [0.0], t_eval=t, max_step=0.01).y[0]
    w += np.random.default_rng(3).normal(0, 0.02, len(t))
    data = ph.Measurements.from_arrays(
        t,
        w[:, None],
        u[:, None],
        states=["w"],
        inputs=["u"],
        units={"t": "s", "w": "rad/s", "u": "N m"},
    )
    known = {
        "J": ph.Parameter(inertia, fixed=True, unit="kg m^2"),
        "b": ph.Parameter(0.1, fixed=True),
    }
    for law, unit in (("(u - b*w)/J", "N m"), ("20*u - 20*b*w", "rad/s^2")):
        used = {name: known[name] for name in known if name in law}
        model = ph.FirstOrder(["w"], {"w": ph.formula(law, **used)}, inputs=["u"])
        found = ForceAnalysis.of(Record.of(ph.identify(model, data), data))
        strength, told = found.where.loc[0, ["strength", "unit"]]
        assert told == unit
        assert strength == pytest.approx(
            friction if unit == "N m" else friction / inertia, rel=0.1
        )
        missing = "torque" if unit == "N m" else "torque per inertia"
        assert f"lacks a {missing} of {strength:.3g} {unit} (rms)" in found.sentences[0]


def test_time_is_not_drawn_where_a_state_predicts_the_force_as_well() -> None:
    t = np.arange(0.0, 60.0, 1.0)  # a car that rolls out: v falls with time
    v = solve_ivp(lambda t, v: -0.12 - 3e-4 * v**2, (0, 60), [33.0], t_eval=t).y[0]
    v += np.random.default_rng(0).normal(0, 0.05, len(t))
    data = ph.Measurements.from_arrays(t, v, states=["v"], units={"t": "s", "v": "m/s"})
    model = ph.FirstOrder(["v"], {"v": ph.formula("-a", a=ph.Parameter(0.1))})
    found = ForceAnalysis.of(Record.of(ph.identify(model, data), data))
    force = found.force_in()
    assert force.share_of("t") > force.share_of("v") - 0.1
    assert force.single_variable == "v"


def circuit_with(hidden: float) -> ForceAnalysis:
    """A loop of resistor, coil and capacitor, which lacks a voltage."""
    loop = ph.formula("(u - R*i - uC)/L", R=ph.Parameter(4.0), L=0.5)
    model = ph.FirstOrder(
        ["i", "uC"], {"i": loop, "uC": "10*i"}, ["u"], kind="electrical"
    )
    t = np.linspace(0, 6, 201)
    u = np.sin(3 * t) + np.sin(7 * t)

    def lacking(time: float, x: np.ndarray) -> np.ndarray:
        return np.array([hidden * x[1] ** 3, 0.0])

    x = ph.simulate(model, t, [0.0, 0.0], u, force=lacking)
    y = x + np.random.default_rng(0).normal(0, 1e-3, x.shape)
    units = {"t": "s", "i": "A", "uC": "V", "u": "V"}
    data = ph.Measurements.from_arrays(
        t, y, u, states=["i", "uC"], inputs=["u"], units=units
    )
    data = replace(data, labels={"uC": "Capacitor"})
    return ForceAnalysis.of(Record.of(ph.identify(model, data), data))


def test_a_circuit_lacks_a_voltage_and_knows_no_positions() -> None:
    found = circuit_with(-3.0)
    force = found.force_in()
    assert force.equation == "i"
    said = found.sentences[0]
    assert "The equation of i lacks a voltage of" in said
    assert "the voltage Capacitor" in said
    figure = plot_where(found)
    labels = [ax.get_xlabel() + ax.get_ylabel() + ax.get_title() for ax in figure.axes]
    told = " ".join((said, *labels))
    assert "missing voltage (V)" in told and "Capacitor (V)" in told
    assert not re.search(r"force|position|velocity|speed", told)
    assert found.energy["unit"].tolist()[0] == "A^2/s"


def test_a_force_is_no_multiple_of_an_inertia_that_the_data_do_not_determine() -> None:
    t = np.arange(0.0, 20.0, 0.2)
    told = {}
    for power in (0.01, 10.0):
        u = power * np.sign(np.sin(t))[:, None]
        truth = ph.FirstOrder(["T"], {"T": ph.formula("u/2 - T/8")}, ["u"])
        units = {"t": "s", "T": "K", "u": "W"}
        data = recorded(truth, t, [5.0], u=u, seed=1, hold="zero", units=units)
        capacity = ph.Parameter(2.0, lower=0, unit="J/K")
        term = ph.formula("u/C", C=capacity)
        model = ph.FirstOrder(["T"], {"T": term}, ["u"], kind="thermal")
        record = Record.of(ph.identify(model, data), data)
        told[power] = ForceAnalysis.of(record).force_in().quantity
    assert told == {0.01: "heat flow per heat capacity", 10.0: "heat flow"}


def test_a_factor_that_was_estimated_does_not_make_an_equation_kinematics() -> None:
    # dx/dt = s y lacks -x/2. With a known s it would define the velocity y.
    t = np.linspace(0, 6, 61)
    truth = ph.FirstOrder(["x", "y"], {"x": "y - 0.5*x", "y": "-4*x - 0.2*y"})
    data = recorded(truth, t, [1.0, 0.0])
    dx = ph.formula("s*y", s=ph.Parameter(1.0))
    rates = {"x": dx, "y": ph.formula("-4*x - 0.2*y")}
    fit = ph.identify(ph.FirstOrder(["x", "y"], rates), data)
    where = ph.diagnose(fit, data, effects=[]).where
    assert list(where["equation"]) == ["x", "y"]
    # 0.5 x has a root mean square of 0.19; what acts in dy/dt is noise.
    assert where["strength"][0] == pytest.approx(0.19, abs=0.03)
    assert where["strength"][1] < 0.02
