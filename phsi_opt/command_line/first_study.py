"""``phsi-opt init``: a first study file from the look of a table."""

from pathlib import Path

from phsi_opt.command_line.job import Answer
from phsi_opt.errors import Complaint, DataError, StudyFileError
from phsi_opt.study_file.first_text import first_text
from phsi_opt.study_file.study_file import StudyFile
from phsi_opt.study_file.survey import TableSurvey, survey
from phsi_opt.writing import write_whole


def first_study(files: list[Path], study: Path, force: bool) -> Answer:
    """Write a study file; nothing that is there is overwritten unless forced.

    Raises:
        DataError: the table cannot be read, or the study file is there already.
    """
    if study.exists() and not force:
        raise DataError(
            f"{study} is there already; nothing was written. Give another name with "
            "--study, or overwrite it with --force."
        )
    table = survey(files[0])
    for further in files[1:]:
        _check_alike(table, survey(further))
    text = first_text(table, files, study.parent)
    write_whole(study, text)
    needs = _needs(study)
    lines = _seen(table, study, files)
    lines += ["", "It needs:", *[f"  {need}" for need in needs]]
    lines += ["", f"Then: phsi-opt check {study}"]
    content = {
        "study_file": str(study),
        "columns": [vars(column) for column in table.columns],
        "further": [vars(variable) for variable in table.further],
        "needs": [vars(need) for need in needs],
    }
    return Answer("\n".join(lines), content)


def _check_alike(first: TableSurvey, other: TableSurvey) -> None:
    """Refuse a further file that is no further run of the same measurement."""
    known = [column.column for column in first.columns]
    found = [column.column for column in other.columns]
    if sorted(known) != sorted(found):
        differ = sorted(set(known) ^ set(found))
        raise DataError(
            f"{other.path} has other columns than {first.path}: {', '.join(differ)} "
            "stand in one of them alone. Files of one study are runs of the same "
            "machine with the same columns; give one kind of file, or rename them."
        )


def _seen(table: TableSurvey, study: Path, files: list[Path]) -> list[str]:
    """What was seen in the table, a line for each column."""
    lines = [f"{study} is written, for {table.n_lines} lines of {files[0]}:"]
    if len(table.sheets) > 1:
        others = ", ".join(table.sheets[1:])
        lines.append(f"  (of its sheet {table.sheets[0]}; there are {others} too)")
    if table.encoding:
        lines.append(f"  ({table.encoding})")
    for column in table.columns:
        if column.column:
            unit = f" [{column.unit}]" if column.unit else ""
            name = " ".join(column.column.split())  # a header may have lines
            lines.append(f"  {name}{unit}: {column.part}; {column.remark}")
    for variable in table.further:
        lines.append(f"  {variable.name}: left out; {variable.said}")
    if table.is_long:
        keys = "between" if table.thinning == 1 else "between and thinned"
        lines.append(f"  So many lines take long: see {keys} in {study}.")
    return lines


def _needs(study: Path) -> tuple[Complaint, ...]:
    """What is missing in the file that was written."""
    try:
        StudyFile.read(study)
    except StudyFileError as error:
        return error.complaints
    return ()
