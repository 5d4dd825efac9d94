"""The catalogue: every effect does what its name says, lives in a model file, and
remembers what it must.
"""

import pickle

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.laws import effect_words, parameter_words
from phsi_opt.transcription.augmented_states import with_memory
from phsi_opt.transcription.grid import grid_of
from tests import systems
from tests.systems import pair

M, K, X, U, T = 2.0, 3.0, np.array([0.7, -1.2]), np.array([0.9]), 0.4
Q, V = 0.7, -0.6  # of the state X


def spring() -> ph.PseudoHamiltonian:
    return pair("k*q**2/2 + p**2/(2*m)", F="b*u", k=K, m=M, b=5.0)


def tank() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["h"],
        inputs=["u"],
        S=[[0.0]],
        H=ph.formula("a*h**2/2", a=ph.Parameter(1.0)),
        F={"h": "u"},
    )


def change(
    model: ph.PseudoHamiltonian, name: str, equation: str, values: dict[str, float]
) -> np.ndarray:
    """What the effect adds to dx/dt of the model's own states, and to what is shown."""
    x = X[: model.n_states]
    larger = model.add(name, equation)
    larger = larger.with_values(
        {n: v for n, v in values.items() if n not in larger.states}
    )
    extended = np.r_[x, [values.get(z, 0.0) for z in larger.memory]]

    def both(m: ph.Model, at: np.ndarray) -> np.ndarray:
        theta = m.theta
        return np.concatenate(
            [
                np.array(f(at, U, T, theta)).ravel()[: len(x)]
                for f in (m.rhs(), m.output())
            ]
        )

    return both(larger, extended) - both(model, x)


DELAYED_SENSOR = {"sensor_delay_q": 0.1, "q_delayed": 0.5, "q_delayed_bend": 3.0}
RESONANCE = {"resonance_mass_p": 0.3, "q_absorber": 0.5, "q_absorber_rate": 0.1}
RESONANCE |= {"resonance_time_p": 0.2, "resonance_damping_p": 0.4}
CASES = [
    ("viscous damping", "p", {"viscous_damping_p": 0.3}, -0.3 * V, 0),
    ("coulomb friction", "p", {"coulomb_friction_p": 0.3, "coulomb_friction_p.v0": 1e-6}, -0.3 * np.sign(V), 0),
    ("quadratic drag", "p", {"quadratic_drag_p": 0.3}, -0.3 * V * abs(V), 0),
    ("cubic drag", "p", {"cubic_drag_p": 0.3}, -0.3 * V**3, 0),
    ("position-dependent damping", "p", {"position-dependent_damping_p": 0.3}, -0.3 * Q**2 * V, 0),
    ("linear stiffness", "p", {"linear_stiffness_q": 0.3}, -0.3 * Q, 0),
    ("quadratic stiffness", "p", {"quadratic_stiffness_q": 0.3}, -0.3 * Q**2, 0),
    ("cubic stiffness", "p", {"cubic_stiffness_q": 0.3}, -0.3 * Q**3, 0),
    ("gravity torque", "p", {"gravity_torque_q": 0.3}, -0.3 * np.sin(Q), 0),
    ("gap", "p", {"gap_q": 0.3, "gap_q.play": 0.5}, -0.3 * (Q - 0.5), 0),
    ("constant force", "p", {"constant_force_p": 0.3}, 0.3, 0),
    ("drifting force", "p", {"drifting_force_p": 0.3}, 0.3 * T, 0),
    ("harmonic force", "p", {"F_p[sin(omega*t)]": 0.3, "F_p.omega": 2.0}, 0.3 * np.sin(2 * T), 0),
    ("parametric stiffness", "p", {"F_p[-q*cos(omega*t)]": 0.3, "F_p.omega": 2.0}, -0.3 * Q * np.cos(2 * T), 0),
    ("input gain", "p", {"input_gain_u_p": -0.2}, -0.2 * 5 * U[0], 0),
    ("quadratic input", "p", {"quadratic_input_u_p": 0.3}, 0.3 * U[0] ** 2, 0),
    ("odd quadratic input", "p", {"odd_quadratic_input_u_p": -0.3}, -0.3 * abs(U[0]) * U[0], 0),
    ("cubic input", "p", {"cubic_input_u_p": -0.3}, -0.3 * U[0] ** 3, 0),
    ("maxwell element", "p", {"maxwell_element_p": 0.3, "q_relaxed": 0.5}, -0.3 * (Q - 0.5), 0),
    ("resonance", "p", RESONANCE, -0.3 * ((Q - 0.5) / 0.2**2 + 0.4 * (V - 0.1) / 0.2), 0),
    ("input dead zone", "p", {"dead_zone_u_p": 0.25}, -5 * 0.25, 0),
    ("input saturation", "p", {"saturation_u_p": 0.25}, -5 * (U[0] - 0.25), 0),
    ("input lag", "p", {"lag_u_p": 0.1, "u_lagged_p": 0.5}, 5 * (0.5 - U[0]), 0),
    ("hysteresis", "p", {"hysteresis_force_p": 0.3, "hysteresis_p": 0.5}, -0.3 * 0.5, 0),
    ("bouc-wen hysteresis", "p", {"hysteresis_force_p": 0.3, "bouc_wen_p": 0.5}, -0.3 * 0.5, 0),
    ("sensor offset", "q", {"sensor_offset_q": 0.3}, 0, 0.3),
    ("sensor gain", "q", {"sensor_gain_q": 0.3}, 0, 0.3 * Q),
    ("sensor drift", "q", {"sensor_drift_q": 0.3}, 0, 0.3 * T),
    ("sensor clipping", "q", {"clipping_q": 0.5}, 0, 0.5 - Q),
    ("sensor delay", "q", DELAYED_SENSOR, 0, 2 * (0.5 - Q) + 0.1**2 / 5 * 3),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "equation", "values", "force", "shown"),
    CASES,
    ids=[case[0] for case in CASES],
)
def test_an_effect_adds_its_force_or_its_reading_and_nothing_else(
    name: str, equation: str, values: dict[str, float], force: float, shown: float
) -> None:
    model = spring()
    larger = model.add(name, equation)
    scales = {
        n: 1.0
        for n in larger.entries
        if n not in model.entries and "[" not in n and n not in values
    }
    scales = {n: v for n, v in scales.items() if not larger.entries[n].prunable}
    expected = np.array([0.0, force, shown if equation == "q" else 0.0, 0.0])
    np.testing.assert_allclose(
        change(model, name, equation, {**scales, **values}), expected, atol=1e-9
    )


LEAKS = [
    ("linear leak", {"linear_leak_h": 0.3}, -0.3 * Q),
    ("turbulent leak", {"turbulent_leak_h": 0.3, "turbulent_leak_h.e0": 1e-6}, -0.3 * np.sqrt(Q)),
    ("saturating leak", {"saturating_leak_h": 0.3, "saturating_leak_h.half": 0.5}, -0.3 * Q / (1 + Q / 0.5)),
    ("overflow", {"overflow_h": 0.3, "overflow_h.limit": 0.5}, -0.3 * (Q - 0.5)),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "values", "expected"), LEAKS, ids=[case[0] for case in LEAKS]
)
def test_a_leak_takes_what_its_name_says_from_a_tank(name, values, expected) -> None:
    np.testing.assert_allclose(
        change(tank(), name, "h", values), [expected, 0.0], atol=1e-6
    )


def test_stribeck_friction_falls_from_its_static_level_to_that_of_sliding() -> None:
    model = spring()
    larger = model.add("stribeck friction", "p")
    inner = {n: 1e-6 if n.endswith("v0") else 0.5 for n in larger.entries if "." in n}
    larger = larger.with_values(
        {**inner, "coulomb_friction_p": 0.2, "stribeck_friction_p": 0.1}
    )
    theta = larger.theta

    def friction(v: float) -> float:
        return float(larger.rhs()([0.0, M * v], [0.0], 0.0, theta)[1])

    assert friction(-1e-3) == pytest.approx(0.3, rel=1e-3)
    assert friction(-50.0) == pytest.approx(0.2, rel=1e-3)


def test_two_coupled_positions_pull_each_other() -> None:
    model = ph.PseudoHamiltonian(
        states=["a", "b", "pa", "pb"],
        S=ph.canonical(2),
        H=ph.formula("(a**2 + b**2)/2 + (pa**2 + pb**2)/(2*m)", m=ph.Parameter(1.0)),
    )
    (effect,) = (e for e in ph.catalogue(model) if e.name == "coupling stiffness")
    larger = model.add(effect).with_values({"coupling_stiffness_a_b": 0.3})
    rate = np.array(larger.rhs()([0.7, 0.2, 0.0, 0.0], [], 0.0, larger.theta)).ravel()
    np.testing.assert_allclose(
        rate, [0, 0, -0.7 - 0.3 * 0.5, -0.2 + 0.3 * 0.5], atol=1e-12
    )


def test_a_delayed_input_arrives_late_and_a_lagged_one_smoothed() -> None:
    t = np.linspace(0.0, 20.0, 801)
    u = np.sin(1.3 * t)[:, None]
    data = ph.Measurements.from_arrays(
        t, np.zeros((801, 2)), u, states=["q", "p"], inputs=["u"]
    )
    grid, model = grid_of(data), spring()
    late = model.add("input delay", "p").with_values({"delay_u_p": 0.4})
    now, value, slope = grid.driven(late, late.theta).u[200:].T
    exact = np.sin(1.3 * (t[200:] - 0.4))
    np.testing.assert_allclose(value + 0.4 * slope, exact, atol=2e-4)
    np.testing.assert_allclose(slope, -1.3 * np.cos(1.3 * (t[200:] - 0.4)), atol=0.03)
    force = late.rhs()(X[:2], [now[0], value[0], slope[0]], T, late.theta)
    force -= model.rhs()(X[:2], [now[0]], T, model.theta)
    np.testing.assert_allclose(float(force[1]), 5 * (exact[0] - now[0]), atol=1e-3)
    lagged = model.add("input lag", "p").with_values({"lag_u_p": 0.4})
    z = with_memory(lagged, grid, np.zeros((801, 2)), lagged.theta)[200:, 2]
    gain = 1 / np.sqrt(1 + (0.4 * 1.3) ** 2)
    np.testing.assert_allclose(
        z, gain * np.sin(1.3 * t[200:] - np.arctan(0.4 * 1.3)), atol=0.002
    )


def test_effects_can_be_sent_to_other_processes_and_refuse_an_unknown_slot() -> None:
    for effect in ph.catalogue(spring()):
        assert pickle.loads(pickle.dumps(effect)) == effect
    with pytest.raises(
        ph.ModelError, match="slot 'G' is unknown; expected one of H, R, F, sensor"
    ):
        ph.Effect("odd", "G", "p", ph.formula("1"))


def test_parameters_of_effects_are_told_in_words_and_others_by_their_names() -> None:
    force = ph.formula("u") + ph.trigonometric("t")
    model = systems.spring(1.0, F=force, inputs=["u"])
    for name in ("coulomb friction", "gap", "input delay", "constant force"):
        model = model.add(effect_named(model, name, "p"))
    told = {name: parameter_words(model, name) for name in model.entries}
    assert told["coulomb_friction_p"] == "coulomb friction in the equation of p"
    assert told["coulomb_friction_p.v0"] == (
        "coulomb friction in the equation of p, speed of transition v0"
    )
    assert told["gap_q.play"] == "gap of q, play"
    assert told["delay_u_p"] == "delay of u in the equation of p"
    assert told["constant_force_p"] == "constant force in the equation of p"
    assert told["k"] == "k" and told["R_p"] == "R_p"
    driven = pair("p**2/2", F="force", inputs=["force"])
    driven = driven.add(effect_named(driven, "constant force", "p"))
    assert parameter_words(driven, "constant_force_p").startswith("constant force in")
    (wave,) = [one for name, one in told.items() if name.startswith("F_p[sin")]
    assert wave.startswith("coefficient of sin(") and wave.endswith(" in F_p")
    assert parameter_words(model, "k[run 3]") == "k[run 3]"


def test_effects_are_told_in_the_names_of_channels() -> None:
    labels = {"q": "Position", "force": "Load"}
    model = ph.mechanical(
        ["q"], mass=2.5, forces="-k*q + force", k=1.0, inputs=["force"]
    )
    told = {str(one): effect_words(one, labels) for one in ph.catalogue(model)}
    assert told["coulomb friction on p"] == "coulomb friction in the equation of p"
    assert told["constant force on p"] == "constant force in the equation of p"
    assert told["sensor offset on q"] == "sensor offset of Position"
    late = ph.Effect("input delay of force", "F", "p", ph.formula("1"))
    assert effect_words(late, labels) == "input delay of Load in the equation of p"
    clutch = ph.Effect("clutch", "R", "p - q", ph.formula("1"))
    assert effect_words(clutch, labels) == "clutch along p - Position"


@pytest.mark.parametrize(
    ("shape", "expected"), [(1.0, -0.3), (-1.375, -0.4425), (0, -0.36)]
)
def test_the_shape_of_a_hysteresis_tells_how_its_force_returns(shape, expected) -> None:
    """w dz/dt = v - (|v| z + s v |z|)/2, at v = -0.3 and z = 0.4, without rounding."""
    larger = spring().add("bouc-wen hysteresis", "p")
    inner = {"hysteresis_slow_p": 1e-9, "hysteresis_width_p": 2.0}
    larger = larger.with_values({**inner, "bouc_wen_shape_p": shape})
    rate = larger.rhs()(np.array([0.0, -0.3 * M, 0.4]), U, T, larger.theta)
    rounded = np.hypot(0.4, 0.05) - 0.4
    expected -= shape * -0.3 * rounded / 2
    assert 2.0 * float(rate[2]) == pytest.approx(expected)


def test_a_hysteresis_that_hardens_is_named_with_its_shape() -> None:
    """Its force is nearly that of a cubic spring with a damper."""
    t = np.arange(0, 40, 0.1)
    u = np.sin(0.9 * t) + np.sin(2.3 * t) + np.sin(0.31 * t)
    truth = spring().add("bouc-wen hysteresis", "p")
    shape = {"bouc_wen_shape_p": -1.4, "hysteresis_width_p": 0.8}
    known = {"hysteresis_force_p": 1.0, "hysteresis_slow_p": 1e-3}
    x = ph.simulate(truth.with_values({**shape, **known}), t, [0.0, 0.0, 0.0], u)
    q = x[:, 0] + np.random.default_rng(0).normal(0, 0.01, len(t))
    y = np.c_[q, np.full(len(t), np.nan)]
    data = ph.Measurements.from_arrays(
        t, y, u[:, None], states=["q", "p"], inputs=["u"]
    )
    energy = "k*q**2/2 + p**2/(2*m)"
    base = pair(energy, ph.damping("p"), "b*u", k=ph.Parameter(K), m=M, b=5.0)
    effects = ["cubic stiffness", "hysteresis", "bouc-wen hysteresis"]
    found = ph.diagnose(ph.identify(base, data), data, effects=effects)
    assert found.verdict is ph.Verdict.NAMED
    assert [str(one) for one in found.findings[0].effects] == [
        "bouc-wen hysteresis on p"
    ]
    for name, value in shape.items():
        refit = found.established[0].fit
        assert refit is not None
        row = refit.parameters.set_index("name").loc[name]
        assert abs(row["value"] - value) < 3 * row["std_error"]
