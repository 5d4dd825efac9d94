"""What a study says of itself where it is printed: its steps, and why it stopped."""

from phsi_opt.presentation.summary import Part, Summary
from phsi_opt.study.record import StudyRecord


def study_summary(study: StudyRecord) -> Summary:
    """The effects that were added, the history, and why the study stopped."""
    added = [str(effect) for effect in study.last.added]
    title = f"Study of {type(study.last.fit.model).__name__}"
    title += f", added: {', '.join(added)}" if added else ", nothing added yet"
    unit = f", {study.unit}" if study.unit else ""
    heading = f"errors of free runs{unit}"
    parts = [Part(heading, table=study.history)]
    if study.stopped:
        parts.append(Part(text=study.stopped))
    return Summary(title, tuple(parts))
