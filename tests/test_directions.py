"""Terms along directions: what acts between two states takes from one what it gives."""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import phsi_opt as ph
from phsi_opt.model.parameter_units import parameter_units

TWO_MASSES: dict[str, Any] = {"states": ["q1", "q2", "p1", "p2"], "S": ph.canonical(2)}
ENERGY = "k1*q1**2/2 + k2*q2**2/2 + p1**2/2 + p2**2/4"


def coupled(**parts: Any) -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(**TWO_MASSES, **{"H": ENERGY, **parts})


def rates(model: ph.Model, x: Any, u: Any = (), **values: float) -> np.ndarray:
    theta = [values[name] for name in model.free]
    return model.rhs()(np.array(x), np.array(u), 0.0, theta).full().ravel()


def test_a_loss_and_a_force_along_a_direction_act_in_all_its_equations() -> None:
    model = coupled(
        R={"p1": "c", "p2-p1": "d"},
        F={"p1 - s*p2/2": "a*q1", "p2": "u"},
        inputs=["u"],
    )
    values = {"k1": 1.0, "k2": 2.0, "c": 0.1, "d": 0.3, "s": 0.5, "a": 0.7}
    q1, q2, v1, v2 = 1.0, 2.0, 3.0, 2.0
    found = rates(model, [q1, q2, v1, 2 * v2], [0.2], **values)
    between = 0.3 * (v1 - v2)
    force = 0.7 * q1
    expected = [v1, v2]
    expected += [-q1 - 0.1 * v1 - between + force]
    expected += [-2 * q2 + between - 0.25 * force + 0.2]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    said = str(model)
    assert "dp1/dt = - dH_dq1 - R_p1*dH_dp1 + R_p2_p1*(dH_dp2 - dH_dp1) + F" in said
    assert "dp2/dt = - dH_dq2 - R_p2_p1*(dH_dp2 - dH_dp1) + F_p2 - s/2*F" in said


def test_a_full_matrix_of_losses_is_found_by_its_factors() -> None:
    R = np.array([[0.5, 0.2], [0.2, 0.4]])
    K = np.array([[3.0, -1.0], [-1.0, 2.0]])
    x = solve_ivp(
        lambda _, x: np.r_[x[2:], -K @ x[:2] - R @ x[2:]],
        (0, 10),
        [1.0, -0.5, 0.0, 0.8],
        t_eval=np.linspace(0, 10, 201),
        rtol=1e-9,
        atol=1e-10,
    )
    noise = 0.005 * np.random.default_rng(3).standard_normal((201, 4))
    data = ph.Measurements.from_arrays(
        x.t, x.y.T + noise, states=["q1", "q2", "p1", "p2"]
    )
    model = ph.PseudoHamiltonian(
        states=["q1", "q2", "p1", "p2"],
        S=ph.canonical(2),
        H="k1*q1**2/2 + k2*q2**2/2 + k12*q1*q2 + p1**2/2 + p2**2/2",
        R={
            "p1 + l*p2": ph.formula(
                "d1", d1=ph.Parameter(0.3, lower=0), l=ph.Parameter(0.1)
            ),
            "p2": ph.formula("d2", d2=ph.Parameter(0.3, lower=0)),
        },
    )
    fit = ph.identify(model, data)
    of = fit.estimates
    D = np.diag([of["d1"], of["d2"]])
    L = np.array([[1.0, 0.0], [of["l"], 1.0]])
    assert np.allclose(L @ D @ L.T, R, atol=0.02)


def test_a_factor_that_is_a_sum_is_printed_in_brackets() -> None:
    model = coupled(F={"p1 - (1 + s)*p2": "a*q1"})
    assert "- (1 + s)*F_p1" in str(model)


def test_an_effect_is_told_whatever_its_place() -> None:
    push = ph.formula("c", c=ph.Parameter())
    for place in ("", "q q(", "p1 - p2"):
        assert str(ph.Effect("push", "F", place, push)) == f"push on {place}"
    assert (
        str(ph.Effect("rod from p1 to p2", "F", "p1 - p2", push)) == "rod from p1 to p2"
    )
    with pytest.raises(ph.ModelError, match="equation '' is not a state"):
        coupled().rows("")


def test_what_it_takes_from_one_the_other_gets_and_losses_are_no_supply() -> None:
    rng = np.random.default_rng(66001)
    model = coupled(R={"p1 - p2": "d*(1 + q1**2)"}, F={"p1 - p2": "a*q2"})
    for x in rng.normal(size=(20, 4)):
        values = {"k1": 1.0, "k2": 2.0, "d": 0.4, "a": 0.7}
        without = rates(model, x, **{**values, "d": 0.0, "a": 0.0})
        change = rates(model, x, **values) - without
        np.testing.assert_allclose(change[2:].sum(), 0.0, atol=1e-14)
        loss = rates(model, x, **{**values, "a": 0.0}) - without
        velocities = np.array([x[2], x[3] / 2])
        assert loss[2:] @ velocities <= 0


@pytest.mark.parametrize(("direction", "message"), [
    ("p1 - p9", "'p9' in 'p1 - p9' is neither a state of the model"),
    ("p1*p2", r"'p1 \* p2' in 'p1\*p2' is neither a state"),
    ("p1 - p1", "direction 'p1 - p1' has 'p1' twice"),
    ("(p1 + 1)*2", "nor a multiple of one"),
    ("sin(p1) - p2", "nor a multiple of one"),
    ("p1*q2 - p2", "nor a multiple of one"),
])  # fmt: skip
def test_what_is_no_direction_is_refused(direction: str, message: str) -> None:
    for slot in ("R", "F"):
        with pytest.raises(ph.ModelError, match=message):
            coupled(**{slot: {direction: "d"}})
    with pytest.raises(ph.ModelError, match="is not a state"):
        coupled(sensor={"q1 - q2": "d"})


def test_an_exchange_along_the_efforts_of_each_other_is_one_of_s() -> None:
    gyroscope = coupled(F={"dH_dp2*p1 - dH_dp1*p2": "g*(1 + q1**2)"})
    S = ph.canonical(2)
    rng = np.random.default_rng(66003)
    for x in rng.normal(size=(5, 4)):
        S[2, 3] = 1.2 * (1 + x[0] ** 2)
        S[3, 2] = -S[2, 3]
        values = {"k1": 1.0, "k2": 2.0}
        found = rates(gyroscope, x, **values, g=1.2)
        expected = rates(
            ph.PseudoHamiltonian(**{**TWO_MASSES, "S": S}, H=ENERGY), x, **values
        )
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_an_entry_of_s_is_learned_and_the_others_go() -> None:
    """A charged particle in a field B(x): its two momenta exchange energy."""
    rng = np.random.default_rng(66004)
    names = ["x", "y", "p", "r"]

    def motion(t: float, z: np.ndarray) -> list[float]:
        x, y, p, r = z
        field = 0.8 + 0.3 * x**2
        return [p, r, -x + field * r, -2 * y - field * p]

    t = np.linspace(0.0, 12.0, 241)
    runs = []
    for start in rng.normal(size=(3, 4)):
        runs.append(solve_ivp(motion, (0, 12), start, t_eval=t, rtol=1e-11).y.T)
    data = ph.Measurements.from_arrays([t] * 3, runs, states=names)
    S: dict[Any, Any] = {("x", "p"): 1, ("y", "r"): 1.0}
    S["p", "r"] = ph.polynomials(["x", "y"], 2, constant=True)
    model = ph.PseudoHamiltonian(
        states=names, S=S, H="k1*x**2/2 + k2*y**2/2 + p**2/2 + r**2/2"
    )
    fit = ph.identify(model, data, ph.PHSILoss(), l1=1e-5, pruning=ph.Pruning(0.01))
    assert fit.values["S_p_r"] == pytest.approx(0.8, abs=1e-3)
    assert fit.values["S_p_r[x**2]"] == pytest.approx(0.3, abs=1e-3)
    assert set(fit.model.free) == {"k1", "k2", "S_p_r", "S_p_r[x**2]"}


@pytest.mark.parametrize("S", [
    {("q1", "q9"): 1}, {("q1",): 1}, {"q1": 1}, {("q1", "q1"): 1},
    {("q1", "p1"): 1, ("p1", "q1"): "a"},
])  # fmt: skip
def test_what_is_no_entry_of_s_is_refused(S: Any) -> None:
    with pytest.raises(ph.ModelError, match="S has an entry for"):
        coupled_by(S)


@pytest.mark.parametrize("entry", [None, [1, 2], {}, "a b"])
def test_an_entry_of_s_is_a_number_or_terms(entry: Any) -> None:
    with pytest.raises(ph.ModelError):
        coupled_by({("q1", "p1"): entry})


def coupled_by(S: Any) -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(states=TWO_MASSES["states"], S=S, H=ENERGY)


def test_a_rigid_body_turns_at_one_energy_and_one_size_of_momentum() -> None:
    """Euler's equations: S(x) of the three momenta, whose norm is a Casimir."""
    H = "x**2/2 + y**2/4 + z**2/6"
    S = {("x", "y"): "-z", ("x", "z"): "y", ("y", "z"): "-x"}
    body = ph.PseudoHamiltonian(states=["x", "y", "z"], S=S, H=H)
    rng = np.random.default_rng(66005)
    for m in rng.normal(size=(5, 3)):
        velocity = m / [1.0, 2.0, 3.0]
        np.testing.assert_allclose(rates(body, m), np.cross(m, velocity), rtol=1e-12)
    assert "dx/dt = dH_dy*S_x_y + dH_dz*S_x_z" in str(body)


def test_kepler_is_the_same_by_the_structure_of_the_thesis() -> None:
    """Thesis Equation 2.29 with H of 2.36: S = (g e' - e g')/|e|^2, e = grad H."""
    states = ["x", "y", "p", "r"]
    cubed = "(x**2 + y**2)**1.5"
    g = ["p", "r", f"-x/{cubed}", f"-y/{cubed}"]
    e = [f"x/{cubed}", f"y/{cubed}", "p", "r"]
    norm = "(1/(x**2 + y**2)**2 + p**2 + r**2)"
    S = {}
    for i, j in combinations(range(4), 2):
        S[states[i], states[j]] = f"(({g[i]})*({e[j]}) - ({e[i]})*({g[j]}))/{norm}"
    H = "(p**2 + r**2)/2 - 1/sqrt(x**2 + y**2)"
    found = ph.PseudoHamiltonian(states=states, S=S, H=H)
    usual = ph.PseudoHamiltonian(states=states, S=ph.canonical(2), H=H)
    rng = np.random.default_rng(66006)
    for x in rng.normal(size=(10, 4)):
        np.testing.assert_allclose(rates(found, x), rates(usual, x), rtol=1e-9)


def test_units_follow_the_direction() -> None:
    model = ph.FirstOrder(
        ["T1", "T2"],
        {
            "T1": ph.formula("P/C1", C1=ph.Parameter(20.0, lower=0, unit="J/K")),
            "T2": ph.formula("Q/C2", C2=ph.Parameter(30.0, lower=0, unit="J/K")),
        },
        inputs=["P", "Q"],
        kind="thermal",
    )
    units = {"T1": "degC", "T2": "degC", "P": "W", "Q": "W", "t": "s"}
    (effect,) = ph.catalogue(model, units, called="thermal bridge")
    assert str(effect) == "exchange of heat between T1 and T2"
    assert effect.equation == "T1/C1 - T2/C2"
    larger = model.add(effect)
    assert parameter_units(larger, units)[larger.free[-1]] == "W/K"
    values = {"C1": 20.0, "C2": 30.0, larger.free[-1]: 1.2}
    found = rates(larger, [40.0, 10.0], [0.0, 0.0], **values)
    np.testing.assert_allclose(found, [-1.2 * 30 / 20, 1.2 * 30 / 30], rtol=1e-12)


def two_bodies(friction: float, damping: float, seed: int) -> ph.Measurements:
    """Positions of two bodies on springs, with what acts between them."""

    def motion(t: float, x: np.ndarray) -> list[float]:
        q1, q2, p1, p2 = x
        v = p1 - p2 / 2
        between = damping * v + friction * np.tanh(v / 0.01)
        stretched = 0.6 * (q1 - q2)
        first = -q1 - 0.05 * p1 - stretched - between
        return [p1, p2 / 2, first, -2 * q2 - 0.025 * p2 + stretched + between]

    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 20.0, 250)
    runs = []
    for start in ([1, 0, 0, 0], [0, 1.2, 0.5, 0], [1, -1, 0, 0.5]):
        x = solve_ivp(motion, (0, 20), start, t_eval=t, rtol=1e-8, atol=1e-9).y.T
        runs.append(x[:, :2] + 0.008 * rng.normal(size=(250, 2)))
    return ph.Measurements.from_arrays([t] * 3, runs, states=["q1", "q2"])


@pytest.mark.parametrize(("friction", "damping", "named", "size"), [
    (0.0, 0.25, "damper between p1 and p2", 0.25),
    (0.15, 0.0, "dry friction between p1 and p2", 0.15),
])  # fmt: skip
def test_what_is_missing_between_two_bodies_is_named_and_is_kept(
    friction: float, damping: float, named: str, size: float, tmp_path: Path
) -> None:
    data = two_bodies(friction, damping, 66002)
    model = coupled(
        H="k1*q1**2/2 + k2*q2**2/2 + k*(q1 - q2)**2/2 + p1**2/2 + p2**2/4",
        R={"p1": "c1", "p2": "c2"},
    )
    study = ph.Study(model, data[:2], held_out=data[2:])
    found = study.diagnose()
    (finding,) = found.findings
    assert [str(one) for one in finding.effects] == [named]
    assert abs(finding.coefficient - size) < 3 * finding.std_error
    study.add(named)
    before, after = (step.held_out for step in study.steps)
    assert before and after and after.rmse < 0.2 * before.rmse
    study.fit.save(tmp_path / "fit.json")
    again = ph.Fit.load(tmp_path / "fit.json")
    assert again.model.free == study.fit.model.free
    assert str(again) == str(study.fit)
    (law,) = study.record.laws()
    assert law.x_label == "velocity of q1 - velocity of q2"
    told = study.fit.sympy()
    assert {"R_p1_p2", "R_p1", "dp2/dt"} <= told.keys()


# ---- what S(x) conserves


def three(S: Any) -> ph.PseudoHamiltonian:
    H = "x**2/2 + y**2/4 + z**2/6"
    return ph.PseudoHamiltonian(states=["x", "y", "z"], S=S, H=H)


def test_the_structure_of_a_rigid_body_is_told() -> None:
    body = three({("x", "y"): "-z", ("x", "z"): "y", ("y", "z"): "-x"})
    assert ph.is_poisson(body)
    assert ph.casimirs(body) == ["x**2 + y**2 + z**2"]
    told = "S(x): the Jacobi identity holds; S(x) conserves x**2 + y**2 + z**2"
    assert told in str(body)
    # A sphere that turns no longer as one: the entries do not belong together.
    broken = three({("x", "y"): "-z", ("x", "z"): "x*y", ("y", "z"): "-x"})
    assert not ph.is_poisson(broken)
    assert "S(x): the Jacobi identity does not hold" in str(broken)
    unknown = three({("x", "y"): "a*z", ("x", "z"): "y", ("y", "z"): "-x"})
    assert "Jacobi" not in str(unknown)
    assert ph.is_poisson(unknown.with_values({"a": -1.0}))


def test_a_matrix_of_numbers_conserves_sums_of_states() -> None:
    tanks = three({("x", "y"): 1.0, ("y", "z"): 2.0})
    assert ph.is_poisson(tanks)
    assert ph.casimirs(tanks) == ["x + 0.5*z"]
    assert "Jacobi" not in str(tanks)
    assert ph.casimirs(coupled_by({("q1", "p1"): 1.0, ("q2", "p2"): 1.0})) == []


def test_a_magnetic_field_is_a_poisson_structure_whatever_it_is() -> None:
    canonical: Any = {("q1", "p1"): 1.0, ("q2", "p2"): 1.0}
    charged = coupled_by({**canonical, ("p1", "p2"): "1 + q1**2 - q2**3"})
    assert ph.is_poisson(charged)
    # Not where the field depends on the velocity.
    assert not ph.is_poisson(coupled_by({**canonical, ("p1", "p2"): "1 + p1"}))


def test_a_structure_of_more_than_the_states_is_not_told() -> None:
    S: Any = {("x", "y"): "u"}
    states = ["x", "y", "z"]
    H = "x**2 + y**2 + z**2"
    driven = ph.PseudoHamiltonian(states=states, S=S, H=H, inputs=["u"])
    assert "Jacobi" not in str(driven)
    with pytest.raises(ph.ModelError, match="S_x_y contains u; expected a function"):
        ph.is_poisson(driven)
    with pytest.raises(ph.ModelError, match="has no finite value"):
        ph.is_poisson(three({("x", "y"): "log(x - 5)"}))
    with pytest.raises(ph.ModelError, match="without an energy has no S"):
        ph.casimirs(ph.FirstOrder(["x"], {"x": "-a*x"}))
    with pytest.raises(ph.ModelError, match="degree=9"):
        ph.casimirs(driven, degree=9)


def test_casimirs_of_mixed_degree_and_of_small_entries() -> None:
    assert ph.casimirs(three({("x", "y"): 1.0, ("y", "z"): "2*x"})) == ["z + x**2"]
    tiny = three({("x", "y"): "-z*1e-9", ("x", "z"): "y*1e-9", ("y", "z"): "-x*1e-9"})
    assert ph.casimirs(tiny) == ["x**2 + y**2 + z**2"]
    assert not ph.is_poisson(
        three({("x", "y"): "-z*1e-9", ("x", "z"): "x*y*1e-9", ("y", "z"): "-x*1e-9"})
    )
