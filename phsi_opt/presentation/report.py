"""A study as text."""

from pathlib import Path
from typing import TYPE_CHECKING

from phsi_opt.errors import DataError

if TYPE_CHECKING:
    from phsi_opt.study import Study


def write_report(study: "Study", path: Path) -> Path:
    """Write the report; raises `DataError` for a kind of file that cannot be written."""
    if path.suffix not in (".md", ".txt"):
        raise DataError(
            f"a report is written as .md or .txt; {path.name!r} is neither."
        )
    path.write_text(report_text(study), encoding="utf-8")
    return path


def report_text(study: "Study") -> str:
    """The study as Markdown: history, present model, comparison, verdict."""
    unit = f" ({study.unit})" if study.unit else ""
    history = study.history.to_string(index=False, float_format=lambda v: f"{v:.4g}")
    parts = [
        "# Study",
        f"Errors are root mean squares of the free-run residual{unit}.",
        "## History",
        _block(history),
        "## Model",
        _block(str(study.fit)),
        _block("\n".join(study.fit.equations())),
        "## Against the measurements",
        _block(str(study.compare())),
        "## Verdict",
        study.stopped or "not asked yet: call `study.auto()` or `study.diagnose()`",
    ]
    for number, diagnosis in sorted(study._diagnoses.items()):
        said = "\n".join(f"- {sentence}" for sentence in diagnosis.sentences)
        parts += [f"### Diagnosis before step {number}", said, _block(str(diagnosis))]
    return "\n\n".join(parts) + "\n"


def _block(text: str) -> str:
    return f"```text\n{text}\n```"
