"""Which parameters a record can tell, before anything is solved."""

from decimal import Decimal, localcontext
from typing import Any

import numpy as np
import pytest
import scipy

import phsi_opt as ph
from phsi_opt.estimation.identifiability import structural
from phsi_opt.simulation.taylor_series import Motion, sensitivities
from problems.benchmarks.published_models import PUBLISHED, Published
from tests.systems import pair, recorded


def spring(**forces: Any) -> ph.PseudoHamiltonian:
    return pair("k*q**2/2 + p**2/(2*m)", "c", forces, inputs=["u"])


def test_the_series_is_that_of_the_integrated_sensitivities() -> None:
    model = pair(
        "k*q**2/2 + p**2/(2*m) + a*cos(b*q)",
        "c + d*abs(dH_dp)**1.5",
        "u*tanh(e*q) + sqrt(1 + q**2) - min(q, f*t + 9)/exp(q) + q**g",
    )
    n = len(model.free)
    numbers = np.random.default_rng(0).uniform(0.5, 1.5, 60).tolist()
    draw = map(Decimal, numbers).__next__
    with localcontext(prec=50):
        theta = [draw() for _ in range(n)]
        start = [draw(), draw()]
        t0, inputs = numbers[n + 2], numbers[n + 3 :]
        motion = Motion(model, start, theta, draw)
        orders = np.array([motion.order(k) for k in range(14)], dtype=float)
    function = sensitivities(model)

    def rates(s: float, z: np.ndarray) -> np.ndarray:
        u = np.polyval(inputs[13::-1], s)
        x, S = z[:2], z[2:].reshape(2, -1)
        found = function(x, S, u, t0 + s, np.array(theta, dtype=float))
        return np.r_[np.array(found[0]).ravel(), np.array(found[1]).ravel()]

    z0 = np.r_[np.array(start, dtype=float), np.eye(2, n + 2).ravel()]
    s = 0.005  # a tenth of the radius within which the series converges
    done = scipy.integrate.solve_ivp(
        rates, (0, s), z0, "DOP853", rtol=1e-11, atol=1e-13
    )
    series = np.tensordot(s ** np.arange(14), orders, 1)
    np.testing.assert_allclose(series.ravel(), done.y[2:, -1], atol=1e-9)


@pytest.mark.parametrize("case", PUBLISHED, ids=lambda one: one.name)
def test_published_verdicts_are_reproduced(case: Published) -> None:
    found = structural(case.model(), tuple(case.sensors), case.runs)
    assert set(found.unidentifiable) == case.unidentifiable
    combinations = {text for group in found.groups for text in group.combinations}
    assert case.combinations <= combinations


def test_what_to_fix_and_what_to_measure_makes_all_identifiable() -> None:
    model = spring()
    found = ph.identifiability(model, measured=["q"])
    (group,) = found.groups
    assert set(group.combinations) == {"k/c", "m/c"}
    assert "fix one of them to a known value" in str(group)
    assert found.unobservable == ("p",)
    assert found.sensors == {"p": ("k", "m", "c")}
    assert found.known_start == ("k", "m", "c")
    assert "a sensor of p makes all identifiable" in repr(found)
    values = dict.fromkeys(group.fix, 1.0)
    assert not ph.identifiability(model.with_fixed(values), measured=["q"]).groups
    assert not ph.identifiability(spring(p="u"), measured=["q"]).sentences
    assert not ph.identifiability(model.frozen(), measured=["q"]).sentences


def test_a_parameter_behind_a_corner_is_identifiable() -> None:
    tank = ph.FirstOrder(
        ["h"], {"h": "u - a*sqrt(h) - b*max(h - rim, 0)"}, inputs=["u"]
    )
    assert not ph.identifiability(tank).groups
    behind = ph.FirstOrder(["h"], {"h": "-a*h - b*max(-abs(h), 0)"})
    assert ph.identifiability(behind).unidentifiable == ("b",)


def test_a_parameter_of_each_run_is_told_beside_shared_ones() -> None:
    load = ph.formula("f", f=ph.Parameter(1.0, per_trajectory=True))
    model = spring(p=load + ph.formula("g*u", g=ph.Parameter(1.0)))
    for n_runs in (1, 3):
        found = structural(model, ("q",), n_runs)
        assert found.unidentifiable == ("k", "m", "c", "f", "g")
        assert len(found.groups[0].fix) == 1


def test_what_cannot_be_asked_is_refused() -> None:
    with pytest.raises(ph.ModelError, match="measured 'v' is not a state"):
        ph.identifiability(spring(), measured=["v"])
    empty = ph.FirstOrder(["x"], {"x": "a*sqrt(-1 - x**2)"})
    with pytest.raises(ph.ModelError, match="no value at forty random points"):
        ph.identifiability(empty)


# ---- with data


@pytest.fixture(scope="module")
def record() -> ph.Measurements:
    t = np.arange(0.0, 20.0, 0.1)
    u = (np.cos(1.3 * t) + np.sin(0.4 * t))[:, None]
    truth = spring(p="u").with_fixed({"k": 4.0, "m": 1.5, "c": 0.4})
    return recorded(truth, t, [1.0, 0.0], u=u, noise=0.02, seed=1, shown="q")


def test_expected_errors_are_those_of_the_fit(record: ph.Measurements) -> None:
    model = spring(p="u")
    expected = ph.identifiability(model, record).table.set_index("name")
    fit = ph.identify(model, record)
    for name in model.free:
        error = expected["std_error"][name]
        # Three steps of the many that a fit takes.
        assert error == pytest.approx(fit.std_errors[name], rel=0.05)
        share = error / abs(expected["value"][name])
        assert expected["relative_error"][name] == pytest.approx(share)
    with pytest.raises(ph.ModelError, match="beside data"):
        ph.identifiability(model, record, measured=["q"])


def test_a_study_says_it_before_it_fits_and_says_nothing_else(
    record: ph.Measurements,
) -> None:
    told: list[str] = []
    model = spring(p="g*u")
    study = ph.Study(model, record, progress=told.append)
    (said,) = [line for line in told if line.startswith("no record")]
    assert said.startswith("no record can distinguish k, m, c, g: only")
    assert told.index(said) < told.index("fitting the base model")
    assert np.isnan(study.fit.std_errors["k"])
    told.clear()
    ph.Study(spring(p="u"), record, progress=told.append)
    assert not [line for line in told if "record" in line or "sensor" in line]
