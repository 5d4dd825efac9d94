"""The package as a whole: what importing it brings, and that the public names are
there.
"""

import subprocess
import sys
from importlib import import_module

import pytest

import phsi_opt


@pytest.mark.parametrize(("statement", "loads", "never"), [
    ("from phsi_opt import *", "numpy", "torch pysindy nicegui dask"),
    ("import phsi_opt", "phsi_opt", "casadi numpy pandas scipy sympy matplotlib"),
    ("from phsi_opt import Study, identify", "casadi", "cvxpy jinja2 matplotlib openpyxl pandas rich sympy typer "
     "scipy.interpolate scipy.signal scipy.stats"),
    ("import phsi_opt.baselines.gradient_descent, problems.thesis.systems", "numpy", "torch"),
    ("import phsi_opt.command_line.app", "typer", "numpy casadi pandas scipy"),
    ("import phsi_opt.command_line.worker, phsi_opt.command_line.__main__", "phsi_opt.command_line.worker",
     "typer rich tomlkit numpy"),
    ("import phsi_opt.command_line.file_jobs", "casadi", "scipy.linalg scipy.special sympy phsi_opt.study.study"),
])  # fmt: skip
def test_what_is_imported_waits_for_nothing_it_may_not_need(
    statement: str, loads: str, never: str
) -> None:
    imported = imported_by(statement)
    assert loads in imported
    assert not imported & set(never.split())


def imported_by(statement: str) -> set[str]:
    """The modules that a statement imports, with all below it."""
    code = f"import sys\n{statement}\nprint(*sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(run.stdout.split())


def test_every_public_name_has_its_module() -> None:
    assert sorted(phsi_opt.MODULES) == phsi_opt.__all__ == dir(phsi_opt)
    for name, module in phsi_opt.MODULES.items():
        made = getattr(phsi_opt, name)
        assert made is getattr(import_module(module), name)
        assert made.__module__ == module
    with pytest.raises(AttributeError, match="no attribute 'Fitt'"):
        getattr(phsi_opt, "Fitt")  # noqa: B009  (as a user's typing error would)


def test_every_public_name_is_exported_once_and_documented() -> None:
    assert len(set(phsi_opt.__all__)) == len(phsi_opt.__all__)
    assert not [
        name
        for name in phsi_opt.__all__
        if not (getattr(phsi_opt, name).__doc__ or "").strip()
    ]


def test_verdicts_are_texts_and_a_missing_force_is_no_loss_of_identify() -> None:
    assert [str(verdict) for verdict in phsi_opt.Verdict] == [
        "nothing missing",
        "missing: named",
        "missing: partly named",
        "missing: unexplained",
    ]
    named: str = phsi_opt.Verdict.NAMED
    assert named == "missing: named"
    assert not hasattr(phsi_opt, "MissingForce")
