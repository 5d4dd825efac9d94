"""The league table: how a test is scored; ODEBench less one term."""

import ast
import json
import sys
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

import phsi_opt as ph
from phsi_opt.model.expressions import evaluate, parse
from phsi_opt.simulation.simulate import free_run
from problems.league import f16, odebench, robot
from problems.league.entries import LEAGUE
from problems.league.run import WAYS, error, page
from problems.measured.vibrations import RATE, Shaken
from problems.tools import provenance

T = np.arange(0, 4, 0.05)


def entry(n_first: int):
    return replace(LEAGUE["EMPS"], n_first=n_first, per_unit=1000.0)


def record(y) -> ph.Measurements:
    u = np.zeros((len(T), 1))
    return ph.Measurements.from_arrays(T, y[:, None], u, states=["x"], inputs=["u"])


DECAY = ph.FirstOrder(["x"], {"x": ph.formula("u - x")}, inputs=["u"])


def test_errors_are_counted_from_the_first_samples_on_and_the_start_is_of_those_alone():
    y = np.exp(-T)
    y[10:] += 0.25  # a start estimated from all samples would follow this
    assert error(DECAY, record(y), entry(10)) == pytest.approx(250, rel=1e-3)
    y[:10] += 0.1 * np.exp(-T[:10])  # the start is 1.1
    expected = np.sqrt(np.mean((0.25 - 0.1 * np.exp(-T[10:])) ** 2))
    assert error(DECAY, record(y), entry(10)) == pytest.approx(1e3 * expected, rel=1e-3)


def test_a_free_run_is_cut_at_the_limit_of_the_sensor_and_samples_there_tell_no_start():
    y = np.minimum(2 * np.exp(-T), 1.0)
    limited = replace(entry(20), most=1.0)
    assert error(DECAY, record(y), limited) == pytest.approx(0, abs=1e-3)
    assert error(DECAY, record(y), entry(20)) > 10


def test_the_page_says_where_others_are_ahead_and_by_how_much():
    found = {"EMPS": 148.2, "Silverbox": 0.2, "cascaded tanks": 0.1}
    results = []
    for name in LEAGUE:
        error = {"the test": found.get(name, 1.0)}
        told = {
            "commit": "0",
            "seconds": [1.0, 1.0],
            "added": [],
            "fit": "its equations",
        }
        results += [{"name": name, "way": way, "errors": error, **told} for way in WAYS]
    behind = [line for line in page(results).splitlines() if line.startswith("- ")]
    assert len(behind) == 1
    assert behind[0].startswith("- EMPS, the test: what was found has 2 times")


def shaken(model: ph.Model, n: int) -> Shaken:
    """A swept sine at the shaker, the accelerations from differences of velocities."""
    t = np.arange(n) / RATE
    u = 50 * np.sin(2 * np.pi * (4 + 3 * t) * t)[:, None]
    fine = np.linspace(0, t[-1], 4 * (n - 1) + 1)
    force = np.interp(fine, t, u[:, 0])[:, None]
    x = free_run(model, fine, np.full(model.n_states, 1e-4), force, "linear")
    value = model.values
    p, pr = x[:, 4:7], x[:, 7]
    modal = np.c_[(p.T + np.outer([value[f"j{i}"] for i in (1, 2, 3)], pr)).T, 0 * pr]
    modal[:, 3] = value["j4"] * pr
    b, s, j = (np.array([value[f"{k}{i}"] for i in (1, 2, 3, 4)]) for k in "bsj")
    velocities = np.c_[modal @ b, modal @ s, modal @ (s + j)]
    return Shaken(t, u, np.gradient(velocities, fine, axis=0, edge_order=2)[::4])


def test_accelerations_of_the_f16_are_slopes_of_its_velocities():
    model = f16.base().frozen()
    record = shaken(model, 300)
    assert f16.error(model, record, 50) < 0.05 * record.a.std()
    stiffer = model.with_values({"k4": 1.3 * model.values["k4"]})
    assert f16.error(stiffer, record, 50) > 0.15 * record.a.std()


def published(path: Path) -> Path:
    """A file as ODEBench publishes it, with one system of two equations."""
    one: dict[str, Any] = {"id": 7, "eq_description": "spring", "consts": [[4.0, 0.5]]}
    one["eq"] = "x_1 | - c_0 * (x_0 + x_0^2) - c_1 * x_1"
    t = np.linspace(0, 4, 41)
    solution = {"t": t.tolist(), "y": [np.cos(2 * t).tolist(), np.sin(t).tolist()]}
    one["solutions"] = [[solution, solution]]
    path.write_text(json.dumps([one]), "utf-8")
    return path


def test_a_term_is_taken_out_of_the_first_sum_and_who_can_write_it_is_told(
    tmp_path: Path,
) -> None:
    system = odebench.read(published(tmp_path / "file.json"))[7]
    terms = odebench.terms_of(parse(system.rates["x_1"]))
    values = {"x_0": 3.0, "x_1": 5.0, "c_0": 7.0, "c_1": 11.0}
    assert [evaluate(ast.unparse(one), values) for one in terms] == [-21, -63, -55]
    rates, equation, term = system.less_one_term()
    assert (equation, term) == ("x_1", "-(c_1 * x_1)")
    assert evaluate(rates["x_1"], values) == -21 - 63
    model = system.model(rates)
    assert model.values == pytest.approx({"c_0": 4.8})  # starts 20 % off
    laws = []
    for effect in odebench.effects(model):
        if odebench.is_law(effect, system, equation, term):
            laws.append(str(effect))
    assert laws == ["viscous damping on x_1", "product x_1 on x_1"]
    growing = replace(system, constants={"c_0": 4.0, "c_1": -0.5})
    (damping,) = ph.catalogue(model, called="viscous damping")
    assert not odebench.is_law(damping, growing, equation, term)  # it only takes out


def told_of(case: tuple[str, int, float, int]) -> dict[str, Any]:
    _, number, noise, _ = case
    told = {"number": number, "noise": noise, "system": "spring", "states": 2}
    told |= {"term": "dx_1/dt: -c", "holder": "catalogue", "outcome": "named"}
    told |= {"added": "drag", "ended": "", "seconds": 1.0, "all seconds": 100.0}
    return told | {way: [0.99, 0.5] for way in odebench.WAYS}


def test_odebench_is_downloaded_and_its_page_counts_what_was_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    published(tmp_path / "published.json")
    handler = partial(SimpleHTTPRequestHandler, directory=tmp_path)
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    Thread(target=server.serve_forever, daemon=True).start()
    source = f"http://127.0.0.1:{server.server_port}/published.json"
    options = [
        "--download",
        f"--source={source}",
        f"--data={tmp_path}",
        "--noise=0,0.05",
    ]
    monkeypatch.setattr(sys, "argv", ["odebench", *options])
    monkeypatch.setattr(provenance, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(odebench, "studied", told_of)
    odebench.main()
    odebench.main()  # all is kept
    server.shutdown()
    server.server_close()
    text = (tmp_path / "results" / "odebench.md").read_text("utf-8")
    assert "; seconds: 200; " in text.splitlines()[0]
    assert "| 0.05 | reconstruction | 1 | 1 | 1 | 1 |" in text
    assert "| 0.05 | generalization | 0 | 0 | 0 | 0 |" in text
    assert "| 0.05 | catalogue | 1 |" in text
    assert (tmp_path / "odebench" / odebench.FILE).exists()


def test_an_angle_of_the_robot_stands_beside_the_torque_of_its_own_time(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("PHSI_OPT_DATA", str(tmp_path))
    (tmp_path / "industrial_robot").mkdir()
    times = np.arange(2 * 606).reshape(2, 606)  # a movement after the other
    rows = {"u_test": times[:, :-1], "y_test": np.rad2deg(times[:, 1:])}
    six = {name: np.tile(row.ravel(), (6, 1)) for name, row in rows.items()}
    savemat(tmp_path / "industrial_robot" / "forward_identification.mat", six)
    first, second = robot.movements("test")
    assert first.u[0, 0] == 1
    assert second.u[-1, 5] == 2 * 606 - 2
    for q, u in (first, second):
        assert np.allclose(q, u)


def test_a_free_run_of_the_robot_couples_its_joints():
    model = robot.joined(robot.joints())
    t = robot.STEP * np.arange(80)
    start = np.zeros(12)
    start[2] = 0.3
    hold = np.array([0, 18, 10, 0, 0, 0]) * np.ones((len(t), 1))
    u = hold + np.sin(np.outer(t, [1, 1.3, 0.7, 1.1, 0.9, 1.5])) * [3, 2, 2, 1, 1, 1]
    q = free_run(model, t, start, u, "cubic")[:, ::2]
    assert robot.error(model, [robot.Record(q, u)], 50) < 2
    light = model.with_values({"forearm3": 0.0})
    assert robot.error(light, [robot.Record(q, u)], 50) > 8


def test_an_effect_with_a_memory_is_a_state_of_the_robot():
    models = [*robot.joints()[:2], robot.joint(3).add("hysteresis", "p3")]
    q = np.linspace(0, 1, 80)[:, None] * np.ones(6)
    whole = robot.joined([*models, *robot.joints()[3:]])
    assert whole.memory == ("hysteresis_p3",)
    assert whole.states[4:7] == ("q3", "p3", "hysteresis_p3")
    x = robot.data(models[2], [robot.Record(q, 0 * q)]).trajectories[0].x
    assert np.array_equal(x[:, 0], q[:, 0])
    assert np.isnan(x[:, 1:]).all()
    assert x.shape == (80, 3)
