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
    said = "\n".join(filter(None, (study.stopped, unestablished_words(study))))
    if said:
        parts.append(Part(text=said))
    return Summary(title, tuple(parts))


def unestablished_words(study: StudyRecord) -> str:
    """What was added that no diagnosis established; "" for nothing."""
    names = ", ".join(one.name for one in study.unestablished)
    return f"added, but not established: {names}" if names else ""
