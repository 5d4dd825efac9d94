"""The loop, from a hidden effect to a better model: comparison, diagnosis, study,
effects, pictures.
"""

import io
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from rich.console import Console

import phsi_opt as ph
from phsi_opt.presentation.charts import draw, errors_chart
from phsi_opt.presentation.content import ErrorStep
from phsi_opt.presentation.numbers import number
from phsi_opt.study import record
from problems.examples.demo import model as spring
from problems.examples.friction_spring import CSV, TIMES, simulated, table

HISTORY = [
    "step",
    "effect",
    "train_rmse",
    "held_out_rmse",
    "noise_floor",
    "unit",
    "bic",
]
CANDIDATES = [
    *("effect", "slot", "equation", "coefficient", "std_error", "unit", "log_bayes"),
    *("log_predictive", "probability", "grade", "force_left", "share", "train_rmse"),
    *("held_out_rmse", "confusable_with", "lost"),
]


def measurements(friction: float, seed: int) -> ph.Measurements:
    frame = table(seed, friction)
    kept = frame[frame["run"].isin([f"run {i}" for i in (1, 2, 3, 4, 5)])]
    return ph.Measurements.from_dataframe(
        kept,
        time="t_s",
        states={"q": "position_m", "p": None},
        trajectory="run",
        units={"q": "m", "t": "s"},
    )


@pytest.fixture(scope="module")
def hidden() -> ph.Study:
    study = ph.Study(spring(), *measurements(2.0, seed=3).split(0.6))
    study.auto()
    return study


@pytest.fixture(scope="module")
def complete() -> ph.Study:
    study = ph.Study(spring(), *measurements(0.0, seed=4).split(0.6))
    study.auto()
    return study


def test_the_csv_file_of_the_demonstration_is_what_its_script_writes() -> None:
    # 1e-6: the file is rounded to six digits
    pd.testing.assert_frame_equal(
        pd.read_csv(CSV), table(seed=0).round(6), atol=2e-6, rtol=0
    )


def test_a_hidden_friction_is_named_added_and_brings_the_held_out_error_to_the_noise_floor(
    hidden: ph.Study,
) -> None:
    friction = "coulomb friction on p"
    assert list(hidden.history["effect"]) == ["base model", friction]
    assert list(hidden.history.columns) == HISTORY
    assert repr(hidden.added) == f"(Effect('{friction}'),)"
    assert repr(hidden.steps) == f"[Step('base model'), Step('{friction}')]"
    first, last = hidden.history.iloc[0], hidden.history.iloc[-1]
    assert first["held_out_rmse"] > 1.2 * first["noise_floor"]
    # 1.1: two held-out runs of 201 samples know an error to 1/sqrt(2*402) = 3.5 %, so
    # this is three standard errors
    assert last["held_out_rmse"] < 1.1 * last["noise_floor"]
    row = hidden.fit.parameters.set_index("name").loc["coulomb_friction_p"]
    assert abs(row["value"] - 2.0) < 3 * row["std_error"]
    # A tenth of the friction: far below what would hide a wrong value.
    assert 0 < row["std_error"] < 0.2


def test_with_nothing_hidden_the_study_says_nothing_missing_and_shows_the_noise(
    complete: ph.Study,
) -> None:
    assert complete.diagnose().verdict == "nothing missing"
    assert list(complete.history["effect"]) == ["base model"]
    assert complete.stopped.startswith("nothing missing")
    comparison = complete.compare()
    noise = 0.02 * np.ptp(np.concatenate([x[:, 0] for x in simulated(0.0)]))
    row = comparison.table.iloc[0]
    # 10 %: the error of 402 samples is known to 3.5 %
    assert comparison.rmse == pytest.approx(noise, rel=0.1)
    assert row["noise_floor"] == pytest.approx(noise, rel=0.1)
    assert row["horizon"] == pytest.approx(TIMES[-1])
    assert row["whiteness"] > 0.001


def test_the_diagnosis_tells_where_and_ranks_candidates(hidden: ph.Study) -> None:
    found = hidden.record.diagnoses[0]
    assert found.verdict == "missing: named"
    assert found.effects[0].name == "coulomb friction"
    assert list(found.candidates.columns) == CANDIDATES
    assert list(found.where["equation"]) == ["p"]
    assert set(found.missing_force.columns) == {"trajectory", "t", "p", "std_p"}
    assert (found.missing_force["std_p"] > 0).all()
    base = ph.Study(spring(), hidden.train, hidden.held_out)
    before = base.fit
    base.add(found.effects[0])
    assert base.fit is not before and "coulomb_friction_p" in base.fit.values
    assert base.undo() is before
    with pytest.raises(ph.ModelError, match="nothing to undo"):
        base.undo()


def ended_by(final: ph.Measurements) -> ph.Study:
    data = measurements(2.0, seed=3).thinned(2, by="picking")
    effects = ["coulomb friction"]
    study = ph.Study(spring(), data[:1], data[1:2], final=final, effects=effects)
    assert "final test" not in study.content().headline.sentence
    study.auto(max_steps=1)
    return study


def test_data_for_the_end_choose_nothing_and_tell_the_error() -> None:
    final = measurements(2.0, seed=3)[4:].thinned(2, by="picking")
    (run,) = final
    other = replace(final, trajectories=(replace(run, x=1.3 * run.x[::-1]),))
    study, changed = ended_by(final), ended_by(other)
    pd.testing.assert_frame_equal(study.history, changed.history, check_exact=True)
    assert study.fit.values == changed.fit.values
    for of_study, of_changed in zip(
        study.record.diagnoses.values(), changed.record.diagnoses.values(), strict=True
    ):
        found, same = of_study.candidates, of_changed.candidates
        pd.testing.assert_frame_equal(found, same, check_exact=True)
        assert of_study.reason == of_changed.reason
    base, last = (ph.compare(step.fit, final).rmse for step in study.steps)
    assert base > 1.2 * last
    fall = f"{number(base, 3)} to {number(last, 3)} m"
    told = f"In the final test (run 5), the error falls from {fall} (noise 0.0"
    content = study.content()
    assert told in content.headline.sentence and told in content.errors
    assert content.subtitle.startswith(
        "Position measured in 1 run for fitting, 1 for testing (held out) and 1 for a final"
    )
    assert told in " ".join(str(study).split())
    assert told not in changed.content().headline.sentence
    settings = {one.question: str(one) for one in content.settings}
    assert "help to choose effects" in settings["Held-out data"]
    assert "looked at once" in settings["Final test"]
    assert "final=final" in content.code


def test_data_for_the_end_are_no_copies_of_others() -> None:
    data = measurements(2.0, seed=3)
    with pytest.raises(ph.DataError, match="final: 'run 2' is a copy of 'run 2'"):
        ph.Study(spring(), data[:1], data[1:2], final=data[1:2])


def test_the_noise_given_to_a_study_holds_for_the_candidates_too(hidden) -> None:
    loss = ph.MaximumLikelihood(noise={"q": 0.08})
    study = ph.Study(spring(), hidden.train, loss=loss, effects=["coulomb friction"])
    study.diagnose()
    assert study.add("coulomb friction", "p").noise == {"q": 0.08}


def test_a_fit_draws_itself_and_knows_what_it_leaves(hidden, tmp_path) -> None:
    fit = hidden.fit
    compared = hidden.compare("training").residuals
    for own, known in zip(fit.residuals, compared, strict=True):
        np.testing.assert_allclose(own, known, atol=1e-8)
    _, ax = plt.subplots()
    assert fit.plot(ax, trajectory="run 2") is ax
    measured, free = (line.get_ydata() for line in ax.get_lines()[:2])
    np.testing.assert_allclose(measured - free, fit.residuals[1][:, 0], atol=1e-8)
    base = hidden.steps[0].fit.autocorrelation(n_lags=5)
    runs = [run[:, 0] for run in hidden.steps[0].fit.residuals]
    e = np.concatenate(runs)
    neighbours = sum(float(one[1:] @ one[:-1]) for one in runs)
    assert base["q"][1] == pytest.approx(neighbours / (e @ e))
    white = 1.96 / np.sqrt(len(e))
    assert base["q"][1] > 3 * white > 1.5 * abs(fit.autocorrelation()["q"][1:]).max()
    axes = fit.plot_autocorrelation()
    assert axes.get_xlabel() == "lag (samples)"
    (said,) = axes.get_legend().get_texts()
    assert said.get_text() == "95 % of white noise"
    fit.save(tmp_path / "fit.json")
    loaded = ph.Fit.load(tmp_path / "fit.json")
    for ask in (loaded.plot, loaded.autocorrelation, lambda: loaded.residuals):
        with pytest.raises(ph.DataError, match=r"ph\.compare\(fit, data\)"):
            ask()
    plt.close("all")


def test_pictures_use_the_axes_given_and_the_report_is_text(hidden, tmp_path) -> None:
    _, ax = plt.subplots()
    assert hidden.compare().plot(ax) is ax
    upper, lower = ax.figure.axes  # residuals below, with the band of the noise
    assert upper is ax and lower.get_ylabel() == "residual (m)"
    free = plt.figure().add_axes((0.1, 0.1, 0.8, 0.8))  # no part of a grid
    assert hidden.compare().plot(free) is free
    assert free.get_position().y0 > free.figure.axes[1].get_position().y1
    assert hidden.diagnose().plot().get_xlabel() == "t (s)"
    assert hidden.plot(plt.figure().add_subplot()).get_title() == "run 5 (held out)"
    with pytest.raises(ph.DataError, match="no trajectory 'run 9'; there are 5: run 4"):
        hidden.plot(trajectory="run 9")
    with pytest.raises(ph.DataError, match="state 'p' is not measured; expected one"):
        hidden.plot(state="p")
    with pytest.raises(ph.DataError, match="kind 'jpg' of file; expected one of csv"):
        hidden.export_figures(tmp_path, ["jpg"])
    effects = ["base model", "coulomb friction on p and sensor delay on q", "no drag"]
    _, axes = plt.subplots(figsize=(7.0, 3.8), layout="constrained")
    draw(axes, errors_chart([ErrorStep(one, 1.0, 1.0, 0.5) for one in effects], "m"))
    axes.figure.canvas.draw()
    boxes = [label.get_window_extent() for label in axes.get_xticklabels()]
    assert all(left.x1 < right.x0 for left, right in pairwise(boxes))
    plt.close("all")
    text = hidden.report(tmp_path / "study.md").read_text(encoding="utf-8")
    assert "Coulomb friction in the equation of p" in text and "noise floor" in text
    with pytest.raises(ph.DataError, match=r"\.md or \.txt"):
        hidden.report(tmp_path / "study.pdf")


def test_what_a_study_prints_loses_no_column_and_shows_itself_as_html_and_rich(
    hidden: ph.Study,
) -> None:
    found, compared, fit = hidden.diagnose(), hidden.compare(), hidden.fit
    tables = [hidden.history, found.candidates, found.where, found.follows]
    tables += [found.power, found.missing_force, compared.table, compared.energy]
    tables += [fit.parameters, fit.intervals(0.95), fit.standard_errors]
    for one in (*tables, fit.model_error, fit.correlations):
        text = str(one)
        assert max(map(len, text.splitlines())) <= 80
        for column in one.columns:
            assert all(piece in text for piece in str(column).split("_")), column
    for shown in (hidden, fit, compared, found):
        assert shown._repr_html_().startswith('<div class="phsi-opt">')
        console = Console(file=io.StringIO(), width=80)
        with console.capture() as captured:
            console.print(shown)
        assert max(map(len, captured.get().splitlines())) <= 80
    for column in hidden.history.columns:
        assert column in str(hidden)
        assert f">{column}</th>" in hidden._repr_html_()
    assert hidden.stopped == found.said and found.reason[1:] in " ".join(
        str(hidden).split()
    )


@pytest.mark.parametrize(("q", "said"), [
    (np.ones(50), "nothing moves"),
    (np.array([1.0, 0.9, 0.7]), "3 measured values are too few for 4 unknowns"),
])  # fmt: skip
def test_measurements_that_tell_nothing_are_refused(q: np.ndarray, said: str) -> None:
    t = 0.1 * np.arange(len(q))
    x = np.column_stack([q, np.full(len(q), np.nan)])
    data = ph.Measurements.from_arrays(t, x, states=["q", "p"])
    with pytest.raises(ph.DataError, match=said):
        ph.identify(spring(), data)


def test_the_data_that_a_comparison_is_on_can_be_named(complete: ph.Study) -> None:
    assert complete.compare() is complete.compare("held out")
    assert complete.compare("training").data is complete.train
    with pytest.raises(ph.DataError, match="'test' is neither 'held out' nor"):
        complete.compare("test")
    alone = ph.Study(spring(), measurements(0.0, seed=4))
    assert alone.compare() is alone.compare("training")
    with pytest.raises(ph.DataError, match="no data were held out"):
        alone.compare("held out")


def test_a_study_considers_what_it_was_told_to() -> None:
    data = measurements(2.0, seed=3)[:2]
    named = {"coulomb friction on p", "quadratic drag on p"}
    study = ph.Study(spring(), data, effects=["coulomb friction", "quadratic drag"])
    assert {one.name for one in study.diagnose().ranking} == named
    study.auto(without=["coulomb friction"])
    assert "coulomb friction on p" not in map(str, study.added)
    fit = study.steps[0].fit
    found = ph.diagnose(fit, data, effects=["gap", "cubic drag"], without=["gap on p"])
    assert {c.effect.name for c in found.ranking} <= {"cubic drag"}
    study = ph.Study(spring(), data[:1])
    base = study.model
    study.add("coulomb friction")
    assert list(map(str, study.added)) == ["coulomb friction on p"]
    assert "coulomb_friction_p" not in base.entries
    study.remove("coulomb friction")
    assert (
        study.added == () and study.steps[-1].label == "without coulomb friction on p"
    )


@pytest.mark.slow
def test_an_effect_with_several_parameters_is_ranked_with_all_of_them() -> None:
    model = spring()
    truth = model.add("harmonic force", "p").with_values(
        {"k": 10, "R_p": 0.5, "F_p[sin(omega*t)]": 1, "F_p[cos(omega*t)]": 0}
        | {"F_p.omega": 3.0}
    )
    t = np.linspace(0, 12, 121)
    runs = []
    for seed, q0 in enumerate((0.5, 1.0)):
        x = ph.simulate(truth, t, [q0, 0])
        noise = 0.01 * np.random.default_rng(seed).normal(size=len(t))
        runs.append(pd.DataFrame({"run": seed, "t": t, "q": x[:, 0] + noise}))
    data = ph.Measurements.from_dataframe(
        pd.concat(runs), time="t", states={"q": "q", "p": None}, trajectory="run"
    )
    effects = ["harmonic force", "constant force"]
    study = ph.Study(model, data[:1], held_out=data[1:], effects=effects)
    study.diagnose()
    present = study.content().present
    assert present is not None
    first, *others = present.ranking
    assert first.effect == "harmonic force on p"
    size, _, beside = first.size.partition("; ")
    assert float(size.split()[0]) == pytest.approx(1, abs=0.05)
    assert beside.startswith("F_p, frequency omega = ")
    assert float(beside.split()[4]) == pytest.approx(3, abs=0.05)
    assert all(";" not in one.size for one in others)


def test_a_study_begins_though_no_motion_of_the_base_model_follows_the_record(
    tmp_path: Path,
) -> None:
    whole = ph.formula("c*sin(a)", c=ph.Parameter(4.2))
    rates = {"a": ph.formula("cos(a)/tan(b)"), "b": whole}
    t = np.linspace(0, 10 / 3, 40)
    x = ph.simulate(ph.FirstOrder(["a", "b"], rates), t, [1.13, -0.3])
    noise = 0.02 * np.random.default_rng(1).standard_normal(x.shape)
    data = ph.Measurements.from_arrays(t, x * (1 + noise), states=["a", "b"])
    lacking = ph.formula("c*sin(a)*cos(b)**2", c=ph.Parameter(1.0))
    study = ph.Study(ph.FirstOrder(["a", "b"], rates | {"b": lacking}), data)
    assert study.fit.caution.count("No motion of the model was found") == 1
    assert "PHSILoss" in str(study.fit)
    report = study.report(tmp_path / "report.md").read_text(encoding="utf-8")
    assert not re.search(r"\bnan\b", report)  # of a loss without a BIC


def lorenz() -> ph.Measurements:
    """Five seconds of Lorenz's chaos, all three states with 2 % noise."""
    s, r, b = ph.Parameter(10.0), ph.Parameter(28.0), ph.Parameter(8 / 3)
    rates = {
        "x": ph.formula("s*(y - x)", s=s),
        "y": ph.formula("r*x - y - x*z", r=r),
        "z": ph.formula("x*y - b*z", b=b),
    }
    t = np.linspace(0, 5, 101)
    x = ph.simulate(ph.FirstOrder(list(rates), rates), t, [2.3, 8.1, 12.4])
    noise = 0.02 * x.std(axis=0) * np.random.default_rng(1).normal(size=x.shape)
    return ph.Measurements.from_arrays(t, x + noise, states=list(rates))


@pytest.mark.slow
def test_a_base_model_that_cannot_follow_the_record_is_diagnosed_all_the_same() -> None:
    rates = {
        "x": ph.formula("s*y", s=ph.Parameter(12.0)),  # lacks -s x
        "y": ph.formula("r*x - y - x*z", r=ph.Parameter(33.0)),
        "z": ph.formula("x*y - b*z", b=ph.Parameter(3.0)),
    }
    model = ph.FirstOrder(list(rates), rates)
    study = ph.Study(model, lorenz(), effects=["linear leak", "quadratic drag"])
    assert "No motion of the model was found" in study.fit.caution
    study.auto(1)
    assert list(map(str, study.added)) == ["linear leak on x"]
    # The damping of Lorenz's x is s itself, 10; 0.2 is two standard errors.
    assert study.model.values["linear_leak_x"] == pytest.approx(10, abs=0.2)


# ---- a larger model is never kept that fits worse than the one it contains


def plate(target: float, seed: int, n: int = 200, fine: int = 10) -> np.ndarray:
    """Temperature and power of a plate that a switch keeps warm; the sensor is late."""
    rng = np.random.default_rng(seed)
    late = [0.0] * fine
    plate = sensor = 20.0
    is_on = True
    rows = []
    for _ in range(n):
        is_on = sensor < target + (2 if is_on else -2)
        power = 55.0 * is_on
        rows.append((sensor + 0.1 * rng.standard_normal(), power))
        for _ in range(fine):
            late.append(power)
            plate += (late.pop(0) - 0.2 * (plate - 20)) / 9 / fine
            sensor += (plate - sensor) / 3 / fine
    return np.array(rows)


def study_of(seeds: tuple[int, ...]) -> ph.Study:
    runs = [plate(110 + seed, seed) for seed in seeds]
    data = ph.Measurements.from_arrays(
        [np.arange(200.0)] * len(runs),
        [run[:, :1] for run in runs],
        [run[:, 1:] for run in runs],
        states=["T"],
        inputs=["W"],
        hold="zero",
        units={"t": "s", "T": "degC", "W": "W"},
    )
    loss = ph.Parameter(0.1, lower=0, unit="W/K")
    capacity = ph.Parameter(15.0, lower=1, unit="J/K")
    rate = ph.formula("(W - h*(T-20))/C", h=loss, C=capacity)
    model = ph.FirstOrder(["T"], {"T": rate}, inputs=["W"], kind="thermal")
    return ph.Study(model, data)


def test_an_effect_that_the_data_do_not_show_leaves_the_error_as_it_was() -> None:
    study = study_of((11, 31))
    study.add("second heat storage", "T")
    before, after = study.history["train_rmse"]
    assert after <= before * (1 + 1e-6)


def test_a_worse_fit_is_refused_in_words(monkeypatch) -> None:
    study = study_of((12,))
    monkeypatch.setattr(record, "is_worse", lambda *_: True)
    with pytest.raises(
        ph.SolveError,
        match="input lag in the equation of T is not added: with it no fit",
    ):
        study.add("input lag", "T")
    assert len(study.steps) == 1
