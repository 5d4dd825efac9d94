"""The battery of machines of the field: its motions, its draws, its answers (not the
diagnosis: that is what it examines).
"""

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
from problems.field_machines.cases import draw
from problems.field_machines.disturbances import known_laws
from problems.field_machines.examination import CLASS, FALSE, NAME, SILENT, answer
from problems.field_machines.findings import agree, as_text, of_text
from problems.field_machines.kinds import KINDS
from problems.field_machines.motion import simulate
from problems.field_machines.one_mass import Spring, hidden_in, on_spring
from problems.field_machines.records import Case

# A seed of each kind in which the catalogue's one effect is all that is hidden.
COMPLETED = {
    "short_run": 2,
    "falling": 1,
    "roll_decay": 2,
    "pendulum": 2,
    "closed_loop": 2,
    "circuit": 1,
    "thermal": 2,
    "chamber": 0,
}
SOON_DRAWN = {"roll_decay": 5, "thermal": 7, "starts_off": 7}
OF_ONE_NUMBER = ("short_run", "thermal", "chamber")  # the effects of these


def true_effect(case: Case) -> ph.Effect:
    """The catalogue's effect that was hidden."""
    (truth,) = case.truths
    for name in truth.names:
        for effect in ph.catalogue(case.model):
            if str(effect) == f"{name} on {truth.equation}":
                return effect
    raise AssertionError(f"none of {truth.names} is in the catalogue")


@pytest.mark.parametrize("name", list(KINDS))
def test_a_case_depends_on_kind_and_seed_alone(name: str) -> None:
    seed = SOON_DRAWN.get(name, 4)
    first, again = draw(KINDS[name], seed), draw(KINDS[name], seed)
    assert first.train.digest == again.train.digest
    assert first.test.digest == again.test.digest
    assert first.model.values == again.model.values
    assert (first.truths, first.size) == (again.truths, again.size)
    assert first.train.n_samples < 1000


def test_another_seed_is_another_case() -> None:
    first, other = draw(KINDS["falling"], 4), draw(KINDS["falling"], 7)
    assert first.train.digest != other.train.digest


@pytest.mark.parametrize(("name", "seed"), list(COMPLETED.items()))
def test_with_the_true_effect_added_a_case_reaches_its_floor(
    name: str, seed: int
) -> None:
    case = draw(KINDS[name], seed, model_error=0.0)
    effect = true_effect(case)
    fit = ph.identify(case.model.add(effect), case.train)
    comparison = ph.compare(fit, case.test)
    # 100 values and more that are held out: their noise is known to 7 %.
    assert comparison.rmse < 1.15 * comparison.noise_floor
    base = ph.compare(ph.identify(case.model, case.train), case.train)
    assert base.rmse > 2 * ph.compare(fit, case.train).rmse
    if name in OF_ONE_NUMBER:
        (new,) = [p for p in fit.names if p not in case.model.entries]
        truth = case.size * case.truths[0].coefficient
        # Four standard errors: a chance of one in ten thousand.
        assert abs(fit.values[new] - truth) < 4 * fit.std_errors[new]


def test_a_damped_spring_moves_as_the_closed_form_says() -> None:
    spring = Spring(mass=2.0, stiffness=3.4, damping=0.0, swing=1.0)
    hidden = hidden_in(spring, "viscous damping", 0.3)
    t = np.linspace(0.0, 9.0, 91)
    e = on_spring(spring, hidden, t, np.array([[1.0, 0.0]]), 1)
    decay = 0.3 / 4
    omega = np.sqrt(3.4 / 2 - decay**2)
    envelope = np.exp(-decay * t)
    expected = envelope * (np.cos(omega * t) + decay / omega * np.sin(omega * t))
    found = simulate(e, 0.3).x[:, 0, 0]
    # RTOL = 1e-8 per step, a few hundred steps
    assert found == pytest.approx(expected, abs=1e-5)


def test_noise_and_model_error_are_as_strong_as_they_say() -> None:
    case = draw(KINDS["closed_loop"], 1)
    fit = ph.identify(case.model, case.train, raise_on_failure=False)
    assert case.noise == 0.02
    scatter = ph.compare(fit, case.train).noise_floor
    rms = np.sqrt(
        np.nanmean(np.concatenate([r.x for r in case.train.trajectories]) ** 2)
    )
    # The floor is estimated beside a strong missing force.
    assert scatter == pytest.approx(0.02 * rms, rel=0.2)


def test_a_random_function_has_nothing_in_common_with_known_laws() -> None:
    from problems.field_machines.disturbances import FUNCTION, drawn

    rng = np.random.default_rng(0)
    spring = Spring(mass=1.0, stiffness=2.0, damping=0.1, swing=1.0)
    t = np.linspace(0.0, 20.0, 200)
    starts = np.array([[1.0, 0.0], [-0.5, 0.3]])
    hidden = hidden_in(spring, "cubic stiffness", 0.3)
    e = on_spring(spring, hidden, t, starts, 1)
    motion = simulate(e, 0.0)
    function = drawn(rng, FUNCTION, e, motion)
    x = motion.x.reshape(-1, 2)
    values = function.at(0.0, x)
    laws = known_laws(x / np.sqrt(np.mean(x**2, axis=0)))
    assert np.sqrt(np.mean(values**2)) == pytest.approx(1.0)
    common = laws.T @ values / len(values)
    # Rounding of a least squares with columns as much alike as powers are.
    assert np.abs(common).max() < 1e-6


def test_some_pendulums_stick_before_the_end_and_all_go_over_the_top() -> None:
    n_stuck = 0
    for seed in range(2):
        case = draw(KINDS["pendulum"], seed, model_error=0.0)
        for run in case.train.trajectories:
            assert np.ptp(run.x[:, 0]) > np.pi
            end = run.x[-15:, 0]
            sigma = case.noise * np.sqrt(np.mean(run.x[:, 0] ** 2))
            n_stuck += bool(np.ptp(end) < 6 * sigma and "coulomb" in case.hidden)
    assert n_stuck > 0


def test_answers_are_right_false_or_silent() -> None:
    right = {"viscous damping on p", "linear leak on p"}
    one = frozenset({"viscous damping on p"})
    several = frozenset({"linear leak on p", "cubic drag on p"})
    wrong = frozenset({"hysteresis on p"})
    assert answer(right, {one}) == NAME
    assert answer(right, {several}) == CLASS
    assert answer(right, {one, wrong}) == FALSE
    assert answer(set(), {one}) == FALSE
    assert answer(right, set()) == SILENT


def test_preparations_agree_where_a_class_holds_the_name() -> None:
    drag = {frozenset({"drag on p"})}
    either = {frozenset({"drag on p", "friction on p"})}
    both = {frozenset({"drag on p"}), frozenset({"gap on p"})}
    assert of_text(as_text(either | both)) == either | both
    assert agree(drag, either) and agree(either, drag) and agree(set(), set())
    assert not agree(drag, set()) and not agree(set(), drag)
    assert not agree(drag, both)  # the gap is not borne out
    assert not agree(drag, {frozenset({"friction on p"})})


def test_the_page_counts_preparations_that_agree(
    monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    from problems.field_machines import store
    from problems.field_machines.page import page
    from problems.tools import provenance

    monkeypatch.setattr(provenance, "RESULTS", tmp_path)
    place = {"kind": "falling", "seed": 8700, "outcome": "examined", "commit": "x"}
    said = {"as_drawn": "drag on p", "shifted": "drag on p", "same": False}
    said |= {"thinned": "drag on p or friction on p", "exchanged": ""}
    store.append(place | said, is_prepared=True)
    answered = {"answer": NAME, "findings": "drag on p", "listed": True}
    store.append(place | answered | {"noise": 0.02, "seconds": 1.0, "hidden": "drag"})
    whole, none = "100% (21% to 100%)", "0% (0% to 79%)"
    counted = f"| 1 | {whole} | {whole} | {none} | {whole} | {none} | {none} |"
    written = page()
    assert f"| falling bodies {counted}" in written
    assert "67% (21% to 94%) of 3 agree. Of the others 1 are silent" in written
    assert "0 find something where it is silent, and 0 say something else" in written
    assert "that do not count: 0." in written


def test_a_record_prepared_in_another_way_is_the_same_motion() -> None:
    from problems.field_machines.preparation import Split, prepared

    case = draw(KINDS["circuit"], 1)
    ways = prepared(Split(case.train, case.test), seed=1)
    run = case.train.trajectories[0]
    shifted = ways["shifted"].train.trajectories[0]
    assert np.array_equal(shifted.x, run.x, equal_nan=True)
    assert shifted.t - shifted.t[0] == pytest.approx(run.t - run.t[0])
    assert shifted.t[0] > 0
    thinned = ways["thinned"].train.trajectories[0]
    assert np.array_equal(thinned.x, run.x[::2], equal_nan=True)
    exchanged = ways["exchanged"]
    held_out = case.test.trajectories[0]
    assert np.array_equal(exchanged.train.trajectories[0].x, held_out.x, equal_nan=True)
    assert np.array_equal(exchanged.test.trajectories[0].x, run.x, equal_nan=True)


def test_a_run_goes_on_where_it_stopped_and_its_page_counts_what_it_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    from problems.field_machines import run, store
    from problems.field_machines.page import page
    from problems.tools import provenance

    monkeypatch.setattr(provenance, "RESULTS", tmp_path)
    asked = []

    def examined(kind: object, seed: int) -> dict[str, object]:
        asked.append(seed)
        said = {"answer": FALSE, "findings": "drag on p"}
        place = {"kind": "falling", "seed": seed, "noise": 0.02, "hidden": "drag"}
        kept = {"listed": True, "outcome": "examined", "seconds": 2.0, "commit": "x"}
        return {**place, **said, **kept}

    monkeypatch.setattr(run, "examine", examined)
    run.main(["falling"], range(8000, 8002), is_prepared=False, jobs=1)
    run.main(["falling"], range(8000, 8004), is_prepared=False, jobs=1)
    assert asked == [8000, 8001, 8002, 8003]
    table = store.table("falling")
    assert list(table["seed"]) == asked
    assert isinstance(table, pd.DataFrame)
    text = page()
    none = "0% (0% to 49%)"
    all_false = f"| {none} | {none} | 100% (51% to 100%) | {none} |"
    assert f"| falling bodies | 4 {all_false}" in text
    assert "Seeds from 8000 on, of each kind as many as n says; " in text
