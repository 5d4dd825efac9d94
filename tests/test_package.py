"""The package as a whole: what importing it brings, and that the public names are
there.
"""

import subprocess
import sys
from importlib import import_module

import pytest

import phsi_opt


def test_importing_the_core_imports_no_extra() -> None:
    extras = {"torch", "pysindy", "nicegui", "dask"}
    assert imported_by("from phsi_opt import *") & extras == set()


def test_importing_the_package_alone_does_not_wait_for_libraries() -> None:
    slow = {"casadi", "numpy", "pandas", "scipy", "sympy", "matplotlib"}
    assert imported_by("import phsi_opt") & slow == set()


def test_identify_and_study_do_not_wait_for_what_they_may_not_need() -> None:
    slow = {"cvxpy", "jinja2", "matplotlib", "openpyxl", "pandas", "rich"}
    slow |= {"scipy.interpolate", "scipy.signal", "scipy.stats", "sympy", "typer"}
    imported = imported_by("from phsi_opt import Study, identify")
    assert imported & slow == set()


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
