"""Fitted models for other programs: what is written computes what `Fit.simulate` does."""

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from typer.testing import CliRunner

import phsi_opt as ph
from phsi_opt.command_line.app import app
from phsi_opt.command_line.job import EXPORT, ExitCode, Job
from phsi_opt.command_line.jobs import run as run_job
from phsi_opt.export import targets
from phsi_opt.export.equations import Equations, allowed_names
from problems.benchmarks.exports import AGREED, Motion, compared
from problems.tools.exported import Compiled, run_fmu
from tests import systems
from tests.systems import recorded

T = np.linspace(0.0, 4.0, 81)
PULSES = np.column_stack([np.sign(np.sin(3 * T)), np.cos(T)])


def fitted(model: ph.Model, hold: str = "linear", **options: object) -> ph.Fit:
    """A fit of a few parameters of a model to its own motion with a little noise."""
    u = PULSES[:, : len(model.inputs)]
    x0 = np.linspace(1.0, 0.5, model.n_states).tolist()
    shown = [name for name in model.states if name not in model.memory]
    data = recorded(model, T, x0, u=u, noise=0.001, shown=shown, hold=hold)
    return ph.identify(model, data, **options)  # type: ignore[arg-type]


def driven(force: Any, **parameters: ph.Parameter | float) -> ph.PseudoHamiltonian:
    """A mass on a spring with a free damper, and a force."""
    force = ph.formula(force, **parameters)
    k, c = ph.Parameter(9.0), ph.Parameter(0.3)
    return systems.spring(k, c, 1.5, force, inputs=["u"])


@cache
def spring() -> ph.Fit:
    return fitted(driven("u"), loss=ph.PHSILoss())


LAG = {"u_lagged": ph.formula("(u - u_lagged)/tau", tau=ph.Parameter(0.2))}
MODELS = {
    # words of the languages, a Greek letter, |q|^n / |q| at q = 0, corners, the time, a
    # number beyond the integers of C
    "awkward names": ph.PseudoHamiltonian(
        states=["input", "double"],
        inputs=["\u03b8"],
        S=ph.canonical(1),
        H="flow*max(input, 0)**2 + 4*abs(input)**n + 2**input + double**2/2",
        R={"double": "0.1 + 0.1*sign(double)**2"},
        F={
            "double": "\u03b8*cos(t) + 0.1*atan(pi*t) - min(input, 1) + min(double, 1e20)"
        },
        sensor={"input": "time + 0.1*dH_ddouble"},
    ).with_values({"flow": 2.0, "n": 2.5, "time": 0.1}),
    "delayed input, held": driven("delayed(u, tau)", tau=ph.Parameter(0.17)),
    "memory": ph.PseudoHamiltonian(
        states=["q", "p", "u_lagged"],
        inputs=["u"],
        S=[[0, 1, 0], [-1, 0, 0], [0, 0, 0]],
        H="9*q**2/2 + p**2/3",
        R={"p": "c"},
        F={"p": "u_lagged", **LAG},
        memory=["u_lagged"],
    ),
    "no energy, a direction": ph.FirstOrder(
        ["h1", "h2"],
        {"h2 - s*h1": "0.4*sqrt(abs(h1)) + 0.1*u2", "h1": "a*u1**2"},
        inputs=["u1", "u2"],
    ).with_values({"a": 0.5, "s": 0.7}),
    "dictionary": ph.FirstOrder(
        ["x"], {"x": ph.polynomials("x", 3, constant=True)}
    ).with_values({"F_x": 0.1, "F_x[x]": -0.5, "F_x[x**2]": 0.1, "F_x[x**3]": -0.2}),
}


@pytest.mark.parametrize("name", MODELS)
def test_every_language_computes_what_fit_simulate_does(
    name: str, tmp_path: Path
) -> None:
    hold = "zero" if "held" in name else "linear"
    model = MODELS[name].frozen() if name != "memory" else MODELS[name]
    fit = fitted(model, hold)
    u = PULSES[:, : len(model.inputs)]
    x0 = np.zeros(2) if name == "awkward names" else fit.states[0][0]
    differences = compared(Motion(fit, T, x0, u), tmp_path)
    for language, difference in differences.items():
        if np.isfinite(difference):  # there may be no Octave
            assert difference < AGREED, language
    assert differences["C"] < 1e-14 and differences["Modelica"] < 1e-14
    assert not validate_fmu(str(tmp_path / "model.fmu"))


def test_sensors_show_what_the_model_has(tmp_path: Path) -> None:
    fit = fitted(MODELS["awkward names"].frozen())
    x = np.array([0.3, 0.4])
    expected = x[0] + 0.1 + 0.1 * x[1]
    compiled = Compiled(fit.export(tmp_path / "a.c"))
    assert compiled.shown(0.0, x, np.ones(1))[0] == pytest.approx(expected, rel=1e-15)
    # As a user runs it.
    path = str(fit.export(tmp_path / "a.fmu"))
    found = fmpy.simulate_fmu(
        path, stop_time=0.1, output_interval=0.1, output=["input shown", "double"],
        start_values={"input": x[0], "double": x[1]},
    )  # fmt: skip
    assert found["input shown"][0] == pytest.approx(expected, rel=1e-15)
    known = fit.simulate([0.0, 0.1], x, np.zeros((2, 1)))
    assert found["double"][-1] == pytest.approx(known[-1, 1], abs=1e-7)


def test_an_fmu_stops_where_it_cannot_be_right(tmp_path: Path, capsys) -> None:
    none = np.zeros((3, 0))
    escapes = fitted(ph.FirstOrder(["x"], {"x": "-x"}))
    escapes = dataclasses.replace(escapes, model=ph.FirstOrder(["x"], {"x": "x**2"}))
    path = escapes.export(tmp_path / "escapes.fmu")
    with pytest.raises(FMICallException):  # x = 1/(1 - t)
        run_fmu(path, np.array([0.0, 0.5, 1.5]), np.ones(1), none, np.zeros(0))
    assert "the model is much faster" in capsys.readouterr().out
    late = fitted(driven("delayed(u, tau)", tau=ph.Parameter(0.17)).frozen())
    path = late.export(tmp_path / "late.fmu")
    t = 1e-5 * np.arange(5000)  # 0.17 s are more steps than are remembered
    with pytest.raises(FMICallException):
        run_fmu(path, t, np.ones(2), np.ones((5000, 1)), np.zeros(1))
    assert "longer than the last 4096" in capsys.readouterr().out


def test_what_is_known_of_the_numbers_is_carried_along(tmp_path: Path) -> None:
    fit = dataclasses.replace(spring(), units={"q": "m", "p": "kg m/s", "t": "s"})
    data = ph.Measurements.from_arrays(
        T, fit.simulate(T, [1, 0], PULSES[:, :1]) + 0.01, PULSES[:, :1],
        states=["q", "p"], inputs=["u"],
    )  # fmt: skip
    comparison = ph.compare(fit, data)
    for suffix in targets.SUFFIXES:
        path = fit.export(tmp_path / f"spring{suffix}", comparison)
        if suffix != ".fmu":
            text = path.read_text()
            assert f"Free run against 81 samples: rmse {comparison.rmse:.4g}" in text
            assert f"k = {fit.values['k']:.4f}"[:8] in text
            assert "q in m" in text
            assert ("'previous'" in text) == (suffix == ".m")  # of held inputs
    description = fmpy.read_model_description(str(tmp_path / "spring.fmu"))
    assert "Free run against 81 samples" in description.description
    variables = {one.name: one for one in description.modelVariables}
    assert "+-" in variables["k"].description
    assert variables["q"].unit == "m"
    assert float(variables["k"].start) == fit.values["k"]


def test_equal_fits_are_equal_files(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    for suffix in targets.SUFFIXES:
        first = spring().export(tmp_path / f"a{suffix}")
        second = spring().export(tmp_path / "other" / f"a{suffix}")
        assert first.read_bytes() == second.read_bytes()


def test_texts_of_a_user_do_not_become_code(tmp_path: Path) -> None:
    hostile = '*/ int x; "; end\n%{ <b>&'
    units = {"q": "*/m", "t": "s"}
    fit = dataclasses.replace(spring(), units=units, provenance={"phsi_opt": hostile})
    for suffix in targets.SUFFIXES:
        fit.export(tmp_path / f"hostile{suffix}")
    Compiled(tmp_path / "hostile.c")
    assert not validate_fmu(str(tmp_path / "hostile.fmu"))
    for suffix, begin in ((".m", "%"), (".mo", "  //")):
        lines = (tmp_path / f"hostile{suffix}").read_text().splitlines()
        assert next(one for one in lines if "<b>" in one).startswith(begin)


def test_a_trajectory_has_its_own_parameters(tmp_path: Path) -> None:
    own = ph.Parameter(9.0, per_trajectory=True)
    energy = ph.formula("k*q**2/2 + p**2/3", k=own)
    model = dataclasses.replace(driven("u"), H=energy)
    runs = []
    for k in (6.0, 9.0):
        of_run = model.with_values({"k": k})
        runs.append(ph.simulate(of_run, T, [1, 0], PULSES[:, :1]))
    data = ph.Measurements.from_arrays(
        [T, T], runs, [PULSES[:, :1]] * 2, states=["q", "p"], inputs=["u"], names=["a", "b"],
    )  # fmt: skip
    fit = ph.identify(model, data)
    x = np.array([1.0, 0.0])
    for run, k in (("a", 6.0), ("b", 9.0)):
        path = fit.export(tmp_path / f"{run}.c", trajectory=run)
        assert Compiled(path).rates(0.0, x, np.zeros(1))[1] == pytest.approx(
            -k, rel=1e-3
        )
    with pytest.raises(
        ph.DataError, match="trajectory 'c' has no parameters of its own"
    ):
        fit.export(tmp_path / "c.c", trajectory="c")


def test_what_cannot_be_exported_is_refused(tmp_path: Path, monkeypatch) -> None:
    with pytest.raises(
        ph.DataError, match=r"'model.fmi' cannot be .* Did you mean '.fmu'"
    ):
        spring().export(tmp_path / "model.fmi")
    with pytest.raises(ph.DataError, match="Give what compare returns"):
        spring().export(tmp_path / "model.c", 0.1)  # type: ignore[arg-type]
    with pytest.raises(ph.DataError, match="its folder does not exist"):
        spring().export(tmp_path / "nowhere" / "model.c")
    energy = "abs(sqrt(q)) + p**2"
    complex_slope = ph.PseudoHamiltonian(states=["q", "p"], S=ph.canonical(1), H=energy)
    with pytest.raises(ph.ModelError, match=r"the energy cannot be exported: 'atan2"):
        Equations.of(complex_slope)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ph.DataError, match=r"no C compiler .* export the model as .c"):
        spring().export(tmp_path / "model.fmu")
    assert not list(tmp_path.iterdir())


def test_names_become_names_of_every_language() -> None:
    names = ["q", "\u03b8", "\u03a9", "F_p[q**2]", "F_p_q_2", "_a", "a", "input", "1x"]
    assert list(allowed_names(names).values()) == [
        *("q", "theta", "Omega", "F_p_q_2", "F_p_q_2_2", "a", "a_2", "input_2", "x1x")
    ]


def test_the_command_exports_with_the_error_on_data_held_out(tmp_path: Path) -> None:
    example = Path(ph.__file__).parent / "study_file" / "examples" / "spring"
    file = ph.StudyFile.read(str(example / "study.toml"))
    saved = tmp_path / "fit.json"
    ph.identify(file.model(), file.split()[0]).save(saved)
    path = tmp_path / "spring.c"
    wrong = CliRunner().invoke(app, ["export", "model.fmi"])
    assert wrong.exit_code == ExitCode.BAD_INPUT
    assert "Did you mean '.fmu'" in wrong.stderr
    said: list[object] = []
    answer = run_job(
        Job(EXPORT, example / "study.toml", saved, export=path), said.append
    )
    assert answer.text == f"exported: {path}"
    assert f"rmse {answer.content['rmse']:.4g} m" in path.read_text()
