"""Several laws at once, and laws that only a fit of its own shows."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import phsi_opt as ph
from phsi_opt.comparison.compare import compare
from phsi_opt.diagnosis.ranking import ranked
from phsi_opt.diagnosis.refit import DiagnosedModel
from phsi_opt.diagnosis.search import Search
from phsi_opt.model.catalogue import EffectChoice
from tests.systems import pair, positive


def swing(amplitude: float, seed: int) -> ph.Measurements:
    """A swing with two losses and a stiffening spring; its position is measured."""
    t = np.arange(0, 30, 0.1)

    def rates(_: float, x: np.ndarray) -> list[float]:
        q, v = x
        return [v, -4 * q - 0.02 * v - 0.01 * v * abs(v) - 0.01 * q**3]

    x = solve_ivp(rates, (0, 30), [amplitude, 0.0], t_eval=t, rtol=1e-9, atol=1e-9).y
    q = x[0] + 0.005 * np.random.default_rng(seed).standard_normal(len(t))
    states = np.c_[q, np.full(len(t), np.nan)]
    return ph.Measurements.from_arrays([t], [states], states=["q", "p"])


@pytest.fixture(scope="module")
def base() -> DiagnosedModel:
    model = pair("k*q**2/2 + p**2/2", k=positive(3.0))
    train, test = swing(4.0, 41), swing(5.0, 42)
    fit = ph.identify(model, train)
    return DiagnosedModel.of(compare(fit, train), compare(fit, test), None)


LAWS = ("viscous damping", "quadratic drag", "cubic stiffness", "bouc-wen hysteresis")


def test_a_stand_in_is_given_back_where_the_laws_together_are_likelier(base) -> None:
    """From a first law on, and each is worth what is lost without it."""
    model = base.fit.model
    effects = EffectChoice(LAWS, ()).checked(model, {}).candidates(model, {})
    ranking = ranked(base, base.evidence_record(), effects)
    search = Search(base, ranking, effects)
    single = search.in_order()[0]
    search.run()
    best = search.in_order()[0]
    assert best.key == {f"{name} on p" for name in LAWS[:3]}
    assert best.log_evidence > single.log_evidence + 50
    worth = search.worth(best)
    assert list(worth.values()) == sorted(worth.values(), reverse=True)
    assert min(worth.values()) > 10
    rest = search.known[best.key - {next(iter(worth))}]
    gain = best.log_evidence - rest.log_evidence
    assert worth[next(iter(worth))] == pytest.approx(gain)
    assert search.alike(best, "viscous damping on p") == []
    values = best.values
    assert values["viscous_damping_p"] == pytest.approx(0.02, abs=0.004)
    assert values["quadratic_drag_p"] == pytest.approx(0.01, abs=0.002)


def test_an_input_that_acts_late_is_found_from_a_fit_of_its_own() -> None:
    """Beside a force that does everything neither screening nor weighing sees it."""
    rng = np.random.default_rng(43)
    runs = []
    for length in (31, 23):
        power = 2.0 * (np.arange(240) // length % 2)
        late = np.r_[np.zeros(8), power[:-8]]
        heat = np.zeros(240)
        for k in range(239):
            heat[k + 1] = np.exp(-0.05) * heat[k] + (1 - np.exp(-0.05)) * 5 * late[k]
        runs.append((heat + 0.01 * rng.standard_normal(240), power))
    data = ph.Measurements.from_arrays(
        [np.arange(240.0)] * 2,
        [heat[:, None] for heat, _ in runs],
        [power[:, None] for _, power in runs],
        states=["T"],
        inputs=["P"],
        hold="zero",
    )
    start = {"a": ph.Parameter(0.1, lower=0), "b": ph.Parameter(0.1, lower=0)}
    model = ph.FirstOrder(["T"], {"T": ph.formula("b*P - a*T", **start)}, inputs=["P"])
    fit = ph.identify(model, data[:1])
    effects = ["input delay", "sensor offset", "quadratic drag"]
    found = ph.diagnose(fit, data[:1], held_out=data[1:], effects=effects)
    (finding,) = found.findings
    assert str(finding.effects[0]) == "input delay on T"
    assert finding.coefficient == pytest.approx(8.0, abs=0.1)


def test_laws_named_together_are_added_one_by_one_as_the_error_falls() -> None:
    model = pair("k*q**2/2 + p**2/2", k=positive(3.0))
    train, test = swing(4.0, 41), swing(5.0, 42)
    study = ph.Study(model, train, held_out=test, effects=list(LAWS[:3]))
    found = study.diagnose()
    assert {str(one) for one in found.proposed} == {f"{law} on p" for law in LAWS[:3]}
    study.add()
    history = study.history
    assert list(history["effect"]) == ["base model", *map(str, found.proposed)]
    assert list(history["held_out_rmse"]) == sorted(history["held_out_rmse"])[::-1]
    assert study.fit is found.proposed_fit
    study.undo()
    assert study.added == found.proposed[:2]
