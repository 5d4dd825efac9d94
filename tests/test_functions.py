"""Unknown functions of one quantity, formulas that they read like, hidden storages."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import phsi_opt as ph
from phsi_opt.model.catalogue import EffectChoice, effect_kind, effect_named
from phsi_opt.model.functions import (
    along_function,
    formulas_like,
    function_named,
    is_function,
    unknown_functions,
)
from phsi_opt.model.parameter_units import parameter_units
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.model.typeset import typeset_equations
from phsi_opt.screening.effect_size import fitted_size
from tests import systems

BELLS = "unknown loss r(q) of 8 bells from -1 to 2, less a constant"
PUSH = "unknown force f(q) of 8 bells from -1 to 2, less a slope"
UNITS = {"t": "s", "q": "m", "u": "N"}
Law = Callable[..., Any]


MASS = ph.Parameter(1.5, fixed=True, unit="kg")


def spring() -> ph.PseudoHamiltonian:
    """A driven mass of 1.5 kg whose stiffness and damper are not known."""
    return systems.spring(ph.Parameter(), ph.Parameter(lower=0), MASS, "u")


def measured(law: Law, memory: Law | None = None, seed: int = 5) -> ph.Measurements:
    """Three runs of the spring with a further force, 1 % of noise on the position."""
    rng = np.random.default_rng(seed)
    step, n = 0.05, 300
    t = step * np.arange(n)
    runs, inputs = [], []
    for _ in range(3):
        u = np.repeat(rng.uniform(-8, 8, n // 10), 10)

        def rates(now: float, x: np.ndarray, u: np.ndarray = u) -> list[float]:
            push = u[min(int(now / step + 1e-9), n - 1)]
            q, v, *z = x
            force = push - 12 * q - 0.4 * v + law(q, v, *z)
            return [v, force / 1.5, *(memory(q, v, *z) if memory else [])]

        start = [0.4, 0.0] + [0.0] * (2 if memory else 0)
        found = solve_ivp(rates, (0, t[-1]), start, t_eval=t, max_step=step, rtol=1e-7)
        runs.append(found.y[0])
        inputs.append(u)
    noise = 0.01 * np.std(runs)
    noisy = [q + noise * rng.standard_normal(n) for q in runs]
    return ph.Measurements.from_arrays(
        [t] * 3, noisy, inputs, states=["q"], inputs=["u"], hold="zero", units=UNITS
    )


def diagnosed(data: ph.Measurements, **choice: Any) -> ph.Diagnosis:
    fit = ph.identify(spring(), data[:2])
    return ph.diagnose(fit, data[:2], held_out=data[2:], **choice)


# ---- by their names


def test_what_is_proposed_is_known_by_its_name() -> None:
    proposed = []
    for bells in unknown_functions(spring(), lambda _: (-1.5, 2.0)):
        proposed += [bells]
        if " 6 bells " in bells.name:
            proposed += formulas_like(spring(), bells)
    names = [str(one) for one in proposed]
    assert len(set(names)) == len(names) > 20
    of_loss = "unknown loss r(q) of 6 bells from -1.5 to 2, less a constant on p"
    assert of_loss in names
    assert {"unknown force f(dH_dp) like c*max(dH_dp - limit, 0) on p"} < set(names)
    for effect in proposed:
        assert function_named(spring(), effect.name, "p") == effect
        assert effect_kind(effect) == "functions"
    assert spring().add(names[0]) == spring().add(proposed[0])


def test_bells_leave_out_what_the_model_has() -> None:
    loss = function_named(spring(), BELLS, "p")
    force = function_named(spring(), PUSH, "p")
    assert loss is not None and force is not None
    assert is_function(loss) and is_function(force)
    # The damper is a constant loss, and the spring a line; there is no constant force.
    assert (len(loss.term), len(force.term)) == (7, 7)
    z, values = along_function(loss)
    assert (z[0], z[-1]) == (-1.0, 2.0)
    np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=1e-5)
    z, values = along_function(force)
    np.testing.assert_allclose(z @ values, 0.0, atol=1e-4)
    # A smooth function that has no such part is nearly a sum of them.
    shape = np.cos(2 * z)
    shape -= z * (z @ shape) / (z @ z)
    weights = np.linalg.lstsq(values, shape, rcond=None)[0]
    error = np.abs(values @ weights - shape)
    assert np.max(error) < 0.1 and np.mean(error) < 0.03


def test_any_formula_may_stand_in_a_name() -> None:
    larger = spring().add("unknown force f(q) like c*sin(q/width)*q", "p")
    assert {"f_q_on_p", "f_q_on_p.width"} < set(larger.free)
    units = parameter_units(larger, UNITS)
    assert units["f_q_on_p.width"] == "m"
    # Any other name is a parameter, too.
    other = spring().add("unknown loss r(q) like c*sin(q/period)", "p")
    theta = [{"r_q_on_p": 2.0}.get(name, 1.0) for name in other.free]
    rates = other.rhs()([0.5, 3.0], [0.0], 0.0, theta).full().ravel()
    plain = spring().rhs()([0.5, 3.0], [0.0], 0.0, [1.0, 1.0]).full().ravel()
    assert (rates - plain)[1] == pytest.approx(-2 * np.sin(0.5) * 3.0 / 1.5)


def test_bells_are_written_as_a_function() -> None:
    speed = "unknown force f(dH_dp) of 6 bells from -1 to 2"
    larger = spring().add(BELLS, "p").add(speed, "p")
    text = str(larger)
    assert "F_p = u - r_p(q)*dH_dp + f_p(dH_dp)\n" in text
    assert (
        "r_p(q) = a sum of bells, by the parameters r_q_on_p_bell_0 to r_q_on_p_bell_6"
        in text
    )
    *_, rate = typeset_equations(larger, larger.values, "s")
    assert "<msub><mi>r</mi><mi>p</mi></msub><mo>(</mo><mi>q</mi><mo>)</mo>" in rate
    assert "<msub><mi>f</mi><mi>p</mi></msub><mo>(</mo><mover" in rate
    assert "exp" not in text.split("parameters\n")[0] + rate


@pytest.mark.parametrize(("name", "message"), [
    ("unknown loss r(q) of 8 bells from 2 to -1", "8 bells from 2 to -1; expected 4"),
    ("unknown loss r(q) of 2 bells from 0 to 1", "2 bells from 0 to 1; expected 4"),
    ("unknown loss r(q) of 99 bells from 0 to 1", "99 bells from 0 to 1; expected 4"),
    ("unknown loss r(q) of 8 bells from 1 to 1.0000000000000002", "along a range"),
    ("unknown loss r(q) of 8 bells from 1e+300 to 1e+999", "along a range"),
    ("unknown loss r(z) of 8 bells from 0 to 1", "'z' is unknown; expected one of q, p"),
    ("unknown loss r(3) of 8 bells from 0 to 1", "'3' is unknown"),
    ("unknown loss f(q) of 8 bells from 0 to 1", "is called 'unknown force f.q.'"),
    ("unknown force f(q) like c*dH_dz", "name 'dH_dz'"),
    ("unknown force f(q) like c*exec(q)", "function 'exec'"),
])  # fmt: skip
def test_a_name_that_makes_no_sense_is_refused(name: str, message: str) -> None:
    with pytest.raises(ph.ModelError, match=message):
        spring().add(name, "p")


def test_kinds_of_effects_can_be_chosen() -> None:
    data = measured(lambda q, v: 0.0)
    fit = ph.identify(spring(), data[:2])
    found = ph.diagnose(fit, data[:2], kinds=["storages"])
    assert set(found.candidates["effect"]) <= {"maxwell element", "resonance"}
    with pytest.raises(
        ph.ModelError, match=r"kind 'storage' .* Did you mean 'storages'"
    ):
        ph.diagnose(fit, data[:2], kinds=["storage"])


def test_a_function_and_a_formula_of_one_quantity_are_told_apart() -> None:
    larger = spring().add(PUSH, "p").add("unknown force f(q) like c*abs(q)", "p")
    *_, rate = typeset_equations(larger, larger.values, "s")
    assert "<mo>(</mo><mi>q</mi><mo>)</mo>" in rate
    # A state called T_1 makes no bell of a formula.
    rooms = ph.FirstOrder(["T_1"], {"T_1": "P - a*T_1"}, inputs=["P"], kind="thermal")
    rooms = rooms.add("unknown heat input f(P) like c*P**3", "T_1")
    assert "a sum of bells" not in str(rooms)
    # Nor does a name of the user's own.
    tone = ph.Effect(
        "tone", "F", "p", Dictionary((Term("t", ph.Parameter(), name="church_bell_1"),))
    )
    assert "a sum of bells" not in str(spring().add(tone))


def test_a_function_that_a_model_has_is_proposed_no_more() -> None:
    def proposed(model: ph.Model) -> set[str]:
        found = list(unknown_functions(model, lambda _: (-1.0, 2.0)))
        return {one.family for one in found}

    all_of_them = proposed(spring())
    for name in ("unknown loss r(q) like c*abs(q)", BELLS):
        assert all_of_them - proposed(spring().add(name, "p")) == {"unknown loss r(q)"}
    repeats = "unknown force f(q) that repeats"
    larger = spring().add(repeats, "p")
    (bells, *_) = [
        one
        for one in unknown_functions(larger, lambda _: (-1.0, 2.0))
        if one.family == "unknown force f(q)"
    ]
    assert repeats not in [one.name for one in formulas_like(larger, bells)]


def test_what_does_not_change_has_no_function() -> None:
    still = (300.0, 300.00000000000006)
    assert list(unknown_functions(spring(), lambda _: still)) == []


def test_a_loss_that_repeats_is_a_loss() -> None:
    larger = spring().add("unknown loss r(q) that repeats", "p")
    bodies = [term.body for term in larger.F["p"] if not term.is_formula]
    assert bodies == [f"-dH_dp*({one}(omega_q*q))" for one in ("sin", "cos")]


def test_a_function_may_be_asked_for_by_its_name() -> None:
    choice = EffectChoice([f"{BELLS} on p"]).checked(spring())
    assert [str(one) for one in choice.candidates(spring())] == [f"{BELLS} on p"]
    without = EffectChoice(without=["hysteresis"]).checked(spring())
    assert without.has_functions and not choice.has_functions


# ---- found


def test_a_loss_that_depends_on_the_position_reads_like_a_formula(
    tmp_path: Path,
) -> None:
    data = measured(lambda q, v: -2.5 * np.exp(-((q / 0.25) ** 2)) * v)
    found = diagnosed(data)
    (finding,) = found.findings
    assert str(finding.effects[0]) == (
        "unknown loss r(q) like c*exp(-(q/width)**2) on p"
    )
    assert abs(finding.coefficient - 2.5) < 3 * finding.std_error < 0.5
    assert finding.unit == "N s/m"
    fit = found.proposed_fit
    assert fit is not None
    path = tmp_path / "fit.json"
    fit.save(path)
    assert ph.Fit.load(path).estimates == fit.estimates


@pytest.mark.slow
def test_a_function_that_is_no_formula_is_a_sum_of_bells() -> None:
    def loss(q: float, v: float) -> float:
        humps = np.exp(-(((q - 0.5) / 0.3) ** 2)) + np.exp(-(((q + 0.6) / 0.25) ** 2))
        return float(-1.5 * humps * v)

    found = diagnosed(measured(loss), kinds=["functions"])
    (finding,) = found.findings
    (effect,) = finding.effects
    assert effect.name.startswith("unknown loss r(q) of 12 bells")
    fit = found.proposed_fit
    assert fit is not None
    assert found.candidates.iloc[0]["held_out_rmse"] < 1.1 * found.base.noise_floor
    # The curve, but for the constant that the damper has.
    z, shapes = along_function(effect)
    names = [term.name for term in effect.term]
    curve = shapes @ [fit.estimates[name] for name in names]
    true = np.array([loss(q, -1.0) for q in z])
    inside = (z > -1) & (z < 1)
    error = (curve - true)[inside]
    assert np.std(error) < 0.2 * np.std(true[inside])
    size = fitted_size(spring(), fit, effect)
    assert abs(size.z) > 5 and size.unit == "N s/m"


STORAGES: dict[str, tuple[Law, Law, dict[str, float]]] = {
    "maxwell element on p": (
        lambda q, v, z, w: -8 * (q - z),
        lambda q, v, z, w: [(q - z) / 0.25, 0.0],
        {"maxwell_element_p": 8.0, "relaxation_time_p": 0.25},
    ),
    "resonance on p": (
        lambda q, v, z, w: 0.4 * (36 * (z - q) + 2.0 * (w - v)),
        lambda q, v, z, w: [w, 36 * (q - z) + 2.0 * (v - w)],
        {
            "resonance_mass_p": 0.4,
            "resonance_time_p": 1 / 6,
            "resonance_damping_p": 2 / 6,
        },
    ),
}


@pytest.mark.parametrize("name", STORAGES)
def test_a_storage_that_nobody_measures_is_found(name: str) -> None:
    law, memory, expected = STORAGES[name]
    found = diagnosed(measured(law, memory))
    assert [str(one) for finding in found.findings for one in finding.effects] == [name]
    fit = found.proposed_fit
    assert fit is not None
    errors = dict(zip(fit.names, np.sqrt(np.diag(fit.covariance)), strict=True))
    for parameter, true in expected.items():
        assert abs(fit.estimates[parameter] - true) < 4 * errors[parameter] < 0.1 * true


def test_nothing_is_found_where_nothing_is_hidden() -> None:
    found = diagnosed(measured(lambda q, v: 0.0))
    assert found.verdict == ph.Verdict.NOTHING_MISSING
    assert found.candidates["effect"].str.startswith("unknown").sum() == 0


# ---- between two bodies


def test_a_function_of_a_difference_acts_between_two_bodies() -> None:
    model = ph.PseudoHamiltonian(
        states=["q1", "q2", "p1", "p2"],
        S=ph.canonical(2),
        H="k*(q1 - q2)**2/2 + p1**2/2 + p2**2/4",
    )
    proposed = {str(one): one for one in unknown_functions(model, lambda _: (-1.0, 1))}
    name = "unknown force f(q1 - q2) of 6 bells from -1 to 1, less a slope on p1 - p2"
    effect = proposed[name]
    larger = model.add(name)
    assert larger == model.add(effect)
    # The spring is a line; what the first body gets the second one loses.
    assert len(effect.term) == 5
    values = dict.fromkeys(larger.free, 0.0) | {"f_q1_q2_on_p1_p2_bell_2": 0.7}
    theta = [values[one] for one in larger.free]
    rates = larger.rhs()([0.3, -0.1, 0.0, 0.0], [], 0.0, theta).full().ravel()
    z, shapes = along_function(effect)
    force = 0.7 * np.interp(0.4, z, shapes[:, 2])
    np.testing.assert_allclose(rates, [0, 0, force, -force], atol=1e-3)
    formulas = [str(one) for one in formulas_like(model, effect)]
    stop = "unknown force f(q1 - q2) like c*max((q1 - q2) - limit, 0) on p1 - p2"
    assert stop in formulas
    assert model.add(stop).free[-1].endswith(".limit")


def test_a_range_far_from_zero_keeps_its_digits() -> None:
    model = ph.FirstOrder(["T"], {"T": "P/C - a*T"}, inputs=["P"], kind="thermal")
    ranges = {"T": (293.152, 293.418), "P": (0.0, 1e-7)}
    for effect in unknown_functions(model, ranges.__getitem__):
        assert effect_named(model, str(effect)) == effect
    z, shapes = along_function(effect_named(model, str(effect)))
    assert np.isfinite(shapes).all() and np.ptp(z) > 0


def test_names_of_a_model_that_formulas_need_are_left_alone() -> None:
    model = ph.FirstOrder(["width"], {"width": "-a*width"})
    (bells, *_) = unknown_functions(model, lambda _: (0.0, 1.0))
    assert list(formulas_like(model, bells)) == []
