"""Inputs that differ in what they do between samples: `hold={"valve": "zero"}`."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.page.drafts import StudyDraft
from phsi_opt.simulation.simulate import free_run
from phsi_opt.study_file.study_file import section_of, write_table
from phsi_opt.study_file.toml_text import toml_tables
from phsi_opt.transcription.grid import aligned, grid_of

T = np.arange(0.0, 12.0, 0.25)
PUSH = 2 * np.sin(2.5 * T)  # smooth, and coarsely sampled: ten samples a period
VALVE = np.where((T // 1.5) % 2 == 0, 1.0, -1.0)  # a digital output: it steps
U = np.column_stack([PUSH, VALVE])
HOLD = {"push": "cubic", "valve": "zero"}


def tank(k: float | ph.Parameter = 0.8) -> ph.FirstOrder:
    """A leaking tank with two inputs that add up."""
    return ph.FirstOrder(
        ["q"], {"q": ph.formula("push + valve - k*q", k=k)}, inputs=["push", "valve"]
    )


def record(hold: Any = HOLD, **changes: Any) -> ph.Measurements:
    """What the tank does where the push is smooth and the valve steps."""
    x = ph.simulate(tank(), T, [0.5], U, hold=HOLD)
    arguments = {"states": ["q"], "inputs": ["push", "valve"], "hold": hold} | changes
    return ph.Measurements.from_arrays(T, x, U, **arguments)


def test_inputs_that_are_left_out_are_linear_and_one_word_stays_a_word() -> None:
    assert record({"valve": "zero"}).hold == {"push": "linear", "valve": "zero"}
    assert record({"push": "zero", "valve": "zero"}).hold == "zero"
    assert record({}).hold == "linear"
    data = record()
    assert pickle.loads(pickle.dumps(data)).hold == data.hold
    with pytest.raises(TypeError):
        data.hold["valve"] = "linear"  # type: ignore[index]


@pytest.mark.parametrize(
    ("hold", "message"),
    [
        (
            {"valv": "zero"},
            r"hold names the unknown 'valv'; expected one of push, valve\. "
            r"Did you mean 'valve'\?",
        ),
        ({"q": "zero"}, "hold names the unknown 'q'"),
        (
            {"valve": "zeros"},
            "hold: 'valve' has the hold 'zeros'; expected 'linear', 'zero' or 'cubic'. "
            r"Did you mean 'zero'\?",
        ),
        ({"valve": None}, "hold: 'valve' has the hold None"),
        (["zero", "linear"], r"hold=\['zero', 'linear'\] is unknown"),
    ],
)
def test_an_unknown_input_or_way_is_refused(hold: Any, message: str) -> None:
    with pytest.raises(ph.DataError, match=message):
        record(hold)
    with pytest.raises(ph.DataError, match=message):
        ph.simulate(tank(), T, [0.5], U, hold=hold)
    with pytest.raises(ph.DataError, match=message):
        free_run(tank(), T, np.array([0.5]), U, hold)


@pytest.mark.parametrize("steps", [1, 3])
def test_each_column_of_a_grid_is_that_of_its_own_way(steps: int) -> None:
    grid = grid_of(record(), steps)
    for number, hold in enumerate(HOLD.values()):
        alone = grid_of(record(hold), steps)
        for name in ("u", "u0", "u1"):
            column = getattr(grid, name)[:, number]
            np.testing.assert_array_equal(column, getattr(alone, name)[:, number])


@pytest.mark.parametrize("push", ["linear", "cubic"])
def test_a_simulation_is_the_sum_of_what_each_input_does(push: str) -> None:
    """A linear system adds up the responses to its inputs."""
    both = {"push": push, "valve": "zero"}
    x = ph.simulate(tank(), T, [0.0], U, hold=both)
    of_push = ph.simulate(tank(), T, [0.0], U * [1, 0], hold=push)
    of_valve = ph.simulate(tank(), T, [0.0], U * [0, 1], hold="zero")
    np.testing.assert_allclose(x, of_push + of_valve, atol=1e-6)  # of the integrator
    fast = free_run(tank(), T, np.zeros(1), U, both)
    np.testing.assert_allclose(fast, x, atol=1e-5)  # its tolerance, of the spread


def test_a_fit_needs_the_right_way_for_each_input_and_keeps_it(tmp_path: Path) -> None:
    model = tank(ph.Parameter(1.0, lower=0))
    fit = ph.identify(model, record())
    assert fit.values["k"] == pytest.approx(0.8, abs=1e-4)
    for hold in ("linear", "zero"):
        other = ph.identify(model, record(hold))
        assert abs(other.values["k"] - 0.8) > 20 * abs(fit.values["k"] - 0.8)
    assert fit.hold == HOLD
    path = tmp_path / "fit.json"
    fit.save(path)
    expected = fit.simulate(T, [0.5], U)
    for again in (ph.Fit.load(path), pickle.loads(pickle.dumps(fit))):
        assert again.hold == HOLD
        np.testing.assert_array_equal(again.simulate(T, [0.5], U), expected)
    # As long as the record is, errors of the integrators and of k show.
    assert ph.compare(fit, record()).rmse < 1e-3


def test_columns_in_another_order_or_left_out_keep_their_way() -> None:
    turned = ph.FirstOrder(
        ["q"], {"q": ph.formula("push + valve - q")}, inputs=["valve", "push"]
    )
    assert aligned(turned, record()).hold == HOLD
    np.testing.assert_array_equal(
        grid_of(aligned(turned, record())).u1, grid_of(record()).u1[:, ::-1]
    )
    alone = ph.FirstOrder(["q"], {"q": ph.formula("valve - q")}, inputs=["valve"])
    assert aligned(alone, record()).hold == "zero"
    fit = ph.identify(
        ph.FirstOrder(
            ["q"],
            {"q": ph.formula("valve - k*q", k=ph.Parameter(1.0))},
            inputs=["valve"],
        ),
        record(),
    )
    assert fit.hold == "zero"


def test_thinning_and_splitting_treat_each_input_in_its_own_way() -> None:
    thin = record().thinned(3)
    assert thin.hold == HOLD
    for number, hold in enumerate(HOLD.values()):
        alone = record(hold).thinned(3).trajectories[0]
        column = thin.trajectories[0].u[:, number]
        np.testing.assert_array_equal(column, alone.u[:, number])
    assert all(part.hold == HOLD for part in record().split())


def test_only_inputs_that_are_not_held_separate_pairs() -> None:
    pairs: dict[str, Any] = {
        "x_start": [1.0, 2.0, 3.0],
        "x_end": [2.0, 3.0, 4.0],
        "t_start": [0, 1, 2],
        "t_end": [1, 2, 3],
        "u_start": [[0.0, 5.0], [1.0, 6.0], [3.0, 6.0]],
        "u_end": [[1.0, 5.0], [2.0, 6.0], [4.0, 6.0]],
        "inputs": ["push", "valve"],
    }
    data = ph.Measurements.from_pairs(**pairs, hold={"valve": "zero"})
    assert [run.n_samples for run in data] == [3, 2]  # the push jumps at t = 2
    with pytest.raises(ph.DataError, match="only one of u_start and u_end"):
        ph.Measurements.from_pairs(**(pairs | {"u_end": None}), hold={"valve": "zero"})
    both = dict.fromkeys(pairs["inputs"], "zero")
    held = ph.Measurements.from_pairs(**(pairs | {"u_end": None}), hold=both)
    assert held.n_samples == 4


STUDY = """
[data]
files = "tank.csv"
hold = "cubic"
time = { column = "t" }

[data.states]
q = { column = "q" }

[data.inputs]
push = { column = "push" }
valve = { column = "valve", hold = "zero" }

[model]
type = "FirstOrder"
states = ["q"]
inputs = ["push", "valve"]
F = { q = "push + valve - k*q" }

[parameters]
k = { start = 1.0 }
"""


@pytest.fixture
def study_path(tmp_path: Path) -> Path:
    record().to_dataframe().to_csv(tmp_path / "tank.csv", index=False)
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


def test_a_study_file_says_it_beside_the_column(study_path: Path) -> None:
    file = ph.StudyFile.read(study_path)
    assert file.measurements().hold == HOLD
    again = ph.StudyFile.read(file.write(study_path.with_name("again.toml")))
    assert again.data == file.data
    assert again.measurements().hold == HOLD
    seen: dict[str, Any] = {"__file__": str(study_path)}
    exec(file.script().partition("study = ph.Study(")[0], seen)
    assert seen["data"].hold == HOLD
    study_path.write_text(STUDY.replace('"zero"', '"zeros"'))
    with pytest.raises(ph.StudyFileError, match=r"data.inputs.valve.hold = .*'zero'\?"):
        ph.StudyFile.read(study_path)


def test_the_page_keeps_it(study_path: Path) -> None:
    table = study_path.with_name("tank.csv")
    draft = StudyDraft.of(toml_tables(STUDY), {table.name: table})
    assert draft.content()["data"]["inputs"] == {
        "push": {"column": "push"},
        "valve": {"column": "valve", "hold": "zero"},
    }


def test_a_report_says_it(study_path: Path) -> None:
    study = ph.StudyFile.read(study_path).study()
    report = study.report(study_path.with_name("report.html")).read_text()
    assert "push: smooth, on the cubic spline" in report
    assert "valve: constant until the next sample" in report


def test_measurements_of_a_study_are_written_with_it(tmp_path: Path) -> None:
    section = section_of(record(), "tank.csv")
    write_table(record(), tmp_path / "tank.csv")
    again = section.measurements(tmp_path)
    assert again.hold == record().hold
    assert again.digest == record().digest
