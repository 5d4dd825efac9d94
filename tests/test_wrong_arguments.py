"""Wrong arguments end in an error of this package that names them, and nothing is lost."""

import errno
import fcntl
import io
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
from phsi_opt.errors import did_you_mean
from phsi_opt.writing import write_whole

T = np.linspace(0.0, 5.0, 51)
X = np.column_stack([np.cos(1.5 * T), -1.5 * np.sin(1.5 * T)])
NANOSECONDS = 1_700_000_000_000_000_000 + 1000 * np.arange(51)


def measured(t: Any = T, x: Any = X) -> ph.Measurements:
    return ph.Measurements.from_arrays(t, x, states=["q", "p"])


def spring(q: str = "q", **extra: Any) -> ph.PseudoHamiltonian:
    energy = ph.formula(f"k*{q}**2/2 + p**2/2", k=ph.Parameter(2.0))
    return ph.PseudoHamiltonian(
        states=[q, "p"], S=ph.canonical(1), H=energy, R=ph.damping("p"), **extra
    )


def forced(force: str, **parameters: ph.Parameter) -> ph.PseudoHamiltonian:
    return spring(F={"p": ph.formula(force, **parameters)})


def read_of(time: Any, states: Any = ("q",), **form: Any) -> ph.Measurements:
    text = io.StringIO("t,q\n0,1\n1,2\n")
    return ph.Measurements.from_csv(text, time=time, states=states, **form)


@pytest.mark.parametrize("t", [[0.0, [1.0, 2.0]], [[0.0, [1.0]], [0.0, 1.0]]])
def test_times_of_rows_that_differ_in_length_are_refused(t: Any) -> None:
    with pytest.raises(ph.DataError, match="'run 1': t is not a regular array"):
        measured(t, [X[:2]] * 2)


def test_whether_states_are_in_a_fit_is_true_or_false() -> None:
    model = ph.FirstOrder(["x"], {"x": "-k*x"})
    one = np.exp(-T)[:, None]
    fit = ph.identify(model, ph.Measurements.from_arrays(T, one, states=["x"]))
    wrong: Any = np.zeros(3)
    with pytest.raises(ph.ModelError, match="is not possible; expected bool"):
        fit.content(states=wrong)


@pytest.mark.parametrize("name", ["dH_dq", "dF_du", "dH_dp", "t"])
def test_names_of_derivatives_are_refused_everywhere(name: str) -> None:
    with pytest.raises(ph.ModelError, match=name):
        spring(name)
    with pytest.raises(ph.ModelError, match=name):
        forced(f"{name}*p", **{name: ph.Parameter(1.0)})
    with pytest.raises(ph.ModelError, match=name):
        ph.FirstOrder(states=["x"], F={"x": "-x"}, inputs=[name])
    with pytest.raises(ph.DataError, match=name):
        ph.Measurements.from_arrays(T, X, states=["q", name])


def test_whole_times_that_no_float_holds_are_counted_from_the_first(tmp_path) -> None:
    expected = 1000.0 * np.arange(51)
    assert np.array_equal(measured(NANOSECONDS).trajectories[0].t, expected)
    two = measured([NANOSECONDS, NANOSECONDS + 7], [X, X])
    assert np.array_equal(two.trajectories[1].t, expected + 7)
    path = tmp_path / "record.csv"
    rows = zip(NANOSECONDS, X[:, 0], strict=True)
    path.write_text("ns,q\n" + "".join(f"{t},{q}\n" for t, q in rows))
    read = ph.Measurements.from_csv(path, time="ns", states=["q"])
    assert np.array_equal(read.trajectories[0].t, expected)
    small = measured(np.arange(51) + 10)
    assert small.trajectories[0].t[0] == 10.0


@pytest.mark.parametrize(("call", "said"), [
    (lambda: measured(x=X + 1j), "complex"),
    (lambda: measured(t=T + 0j), "complex"),
    (lambda: measured(t=None), "t has the type object"),
    (lambda: ph.Parameter(1 + 2j), "value=.* expected float"),  # type: ignore[arg-type]
    (lambda: ph.Parameter(upper=np.ma.masked), "upper=masked is not possible; expected float"),  # type: ignore[arg-type]
    (lambda: ph.PseudoHamiltonian(states=["q", "p"], H="p**2", S=[[0, 10**400], [1, 0]]), "is not a matrix of numbers"),
    (lambda: ph.PseudoHamiltonian(states=["q", "p"], H="p**2", S=[[0, 1j], [-1, 0]]), "is not a matrix of numbers"),
    (lambda: measured(t=2**53 + 1), "has the shape"),
    (lambda: ph.Measurements.from_arrays(T, X, states=np.array(1.0)), "states=.* Write a list"),  # type: ignore[arg-type]
    (lambda: spring().with_values({"k": 1j}), "values={'k': 1j}.* expected Mapping"),  # type: ignore[dict-item]
    (lambda: spring().with_values({"k": np.complex128(1)}), "values=.* expected Mapping"),  # type: ignore[dict-item]
    (lambda: ph.simulate(spring(), T, [1 + 1j, 0]), "x0=.*real numbers"),
    (lambda: ph.simulate(spring(), T, "a"), "x0='a'"),
    (lambda: ph.simulate(spring(), None, [1.0, 0.0]), "t=None"),
    (lambda: ph.simulate(forced("sqrt(q)"), T, [1.0, 0.0]), "is not finite there"),
    (lambda: ph.identify(spring(), None), "data=None"),  # type: ignore[arg-type]
    (
        lambda: ph.identify(spring(), measured(), ph.PHSILoss(), [1]),  # type: ignore[arg-type]
        r"l1=\[1\]",
    ),
    (lambda: ph.identify(spring(), measured(x=0 * X), ph.PHSILoss()), "every state is zero"),
    # Squares of such numbers are infinite, among which the solver looks without end.
    (
        lambda: ph.identify(
            forced("c*abs(p)**w", c=ph.Parameter(1e200), w=ph.Parameter(-5.4)), measured()
        ),
        r"beyond 1e\+100, at",
    ),
    (lambda: ph.formula(["q"]), r"expression=\['q'\] is not possible; expected str"),  # type: ignore[arg-type]
    (lambda: ph.damping(3), "variable 3 is not a usable name"),  # type: ignore[arg-type]
    (lambda: spring().with_upper({"k": "1"}), "bounds={'k': '1'}"),  # type: ignore[dict-item]
    (lambda: spring().with_free([["k"]]), r"names=\[\['k'\]\]"),  # type: ignore[list-item]
    (lambda: ph.simulate(spring(), T, [1.0, 0.0], method="euler"), "method='euler'"),
    (lambda: measured().split(10**400), "fraction=a number beyond"),
    (lambda: ph.SolverSettings(max_iterations=0), "max_iterations=0"),
    (lambda: ph.simulate(spring(), T, [1e200, 0.0]), "x0=.* finite numbers"),
    (lambda: measured().stacked("states"), "stacked: 'states'.*one of t, x, u"),
    (lambda: ph.FirstOrder(["q"], {"q": "-q"}, S=[[1.0], [1.0, 2.0]]), "S=.* not a matrix"),
    (lambda: ph.mechanical(["x", "y"], 1.0, {"-x", "-y"}), "forces=.* expected str"),  # type: ignore[arg-type]
    (lambda: ph.StudyFile.read(3), "path=3"),  # type: ignore[arg-type]
    (lambda: ph.Measurements.from_csv("\ud800", time="t", states=["q"]), "file"),
    (lambda: read_of([]), "without a column"),
    (lambda: ph.Measurements(pd.DataFrame(), ["q"]), "expected at least one Trajectory"),  # type: ignore[arg-type]
    (lambda: ph.Measurements([], ["q"]), "expected at least one Trajectory"),  # type: ignore[arg-type]
    (lambda: ph.FirstOrder(iter("qp"), {}), "states=.*Write a list"),  # type: ignore[arg-type]
    (lambda: ph.Pruning(np.timedelta64(1)), "threshold=np.timedelta64"),  # type: ignore[arg-type]
    (lambda: list(ph.sweep(str, {"\ud800": 1})), "the key '.ud800'"),
    (lambda: list(ph.sweep(str, {"a": 1}, folder="a\0b")), "folder 'a.x00b' cannot"),
    (lambda: read_of("t", {"q": ()}), "without a column"),
    (lambda: read_of("t", separator=1), "separator=1"),
    (lambda: ph.SolverSettings(max_iterations=1.5), "max_iterations=1.5"),  # type: ignore[arg-type]
    (lambda: ph.Pruning("a"), "threshold='a'"),  # type: ignore[arg-type]
    (lambda: ph.MaximumLikelihood("a"), "noise='a'"),  # type: ignore[arg-type]
    (lambda: ph.MaximumLikelihood({"q": -1.0}), r"noise\['q'\]=-1"),
    (lambda: ph.Measurements.from_csv("a\0b", time="t", states=["q"]), "cannot contain NUL"),
    (lambda: ph.Fit.load(None), "path=None is not possible"),  # type: ignore[arg-type]
])  # fmt: skip
def test_a_wrong_argument_is_named(call: Callable[[], Any], said: str) -> None:
    with pytest.raises(ph.PhsiOptError, match=said):
        call()


@pytest.mark.parametrize("names", [
    pd.Index(["q", "p"]),
    pd.Series(["q", "p"]),
    np.array(["q", "p"]),
    {"q": 1, "p": 2}.keys(),
], ids=lambda one: type(one).__name__)  # fmt: skip
def test_names_may_be_any_collection_with_an_order(names) -> None:
    inputs: Any = pd.Index(["u"])
    data = ph.Measurements.from_arrays(T, X, u=T, states=names, inputs=inputs)
    assert (data.states, data.inputs) == (("q", "p"), ("u",))
    frame = pd.DataFrame({"t": T, "q": X[:, 0], "p": X[:, 1]})
    assert (
        ph.Measurements.from_dataframe(frame, time="t", states=names).states
        == data.states
    )


@pytest.mark.parametrize(("place", "said"), [
    ("", "it is a folder"),
    ("no folder/fit.json", "its folder does not exist"),
    ("a\0b", "expected a path"),
    (None, "expected a path"),
])  # fmt: skip
def test_what_cannot_be_written_is_said(tmp_path, place, said) -> None:
    path: Any = None if place is None else f"{tmp_path}/{place}"
    with pytest.raises(ph.DataError, match=said):
        write_whole(path, "text")
    assert list(tmp_path.iterdir()) == []


def test_a_file_behind_a_link_is_replaced_and_keeps_its_rights(tmp_path: Path) -> None:
    file = tmp_path / "file.json"
    file.write_text("before")
    file.chmod(0o600)
    link = tmp_path / "link.json"
    link.symlink_to(file)
    write_whole(link, "after\r\n")
    assert link.is_symlink()
    assert file.read_bytes() == b"after\r\n"
    assert file.stat().st_mode & 0o777 == 0o600


KILLED_IN_WRITING = """
import os, signal, sys
from phsi_opt.writing import write_whole
os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
write_whole(sys.argv[1], "after")
"""


def test_what_a_killed_process_began_to_write_is_removed_by_the_next(tmp_path) -> None:
    place = tmp_path / "[a] fit.json"
    place.write_text("before")
    mine = tmp_path / ".[a] fit.json.mine.part"
    mine.touch()
    subprocess.run([sys.executable, "-c", KILLED_IN_WRITING, place], check=False)
    assert place.read_text() == "before"
    assert len(list(tmp_path.iterdir())) == 3
    write_whole(place, "anew")
    assert place.read_text() == "anew"
    assert sorted(tmp_path.iterdir()) == [mine, place]


def test_what_a_living_process_writes_is_left_to_it(
    tmp_path: Path, monkeypatch
) -> None:
    place = tmp_path / "fit.json"
    part = tmp_path / ".fit.json.01234567.part"
    with part.open("wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        write_whole(place, "mine")
        assert part.exists()
    replace = os.replace

    def taken_away(source: str, target: Path) -> None:
        monkeypatch.setattr(os, "replace", replace)
        write_whole(target, "another's")  # its own is closed, and taken for left
        replace(source, target)

    monkeypatch.setattr(os, "replace", taken_away)
    write_whole(place, "after")
    assert place.read_text() == "after"
    assert list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize("reason", [errno.ENOLCK, errno.ENOTSUP, errno.EINTR])
def test_a_file_system_without_locks_takes_files(tmp_path, monkeypatch, reason) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(reason, os.strerror(reason))

    monkeypatch.setattr(fcntl, "flock", refuse)
    write_whole(tmp_path / "fit.json", "kept")
    assert (tmp_path / "fit.json").read_text() == "kept"
    assert len(list(tmp_path.iterdir())) == 1


def test_suggestions_ignore_case_and_say_nothing_when_nothing_is_close() -> None:
    assert (
        did_you_mean("Positon", ["velocity", "POSITION"]) == " Did you mean 'POSITION'?"
    )
    assert did_you_mean("xyz", ["velocity"]) == ""
    assert did_you_mean(3, []) == ""


@pytest.mark.parametrize(
    ("args", "named"),
    [
        ((T, X), {}),
        ((T, X), {"states": ["q", "p"]}),
        (([T], [X]), {"states": ["q", "p"]}),
    ],
)
def test_arrays_given_to_measurements_are_told_their_reader(args, named) -> None:
    with pytest.raises(ph.DataError, match="from_arrays"):
        ph.Measurements(*args, **named)
