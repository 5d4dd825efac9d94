"""The package as a whole: what importing it brings, and that the public names are
there.
"""

import subprocess
import sys

import phsi_opt


def test_importing_the_core_imports_no_extra() -> None:
    code = "import sys, phsi_opt; print(sorted({'torch', 'pysindy', 'nicegui', 'dask'} & set(sys.modules)))"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "[]"


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
