"""What a study says in plain text: history, model, comparison, verdict, diagnoses."""

from phsi_opt.presentation.report import Section
from phsi_opt.presentation.tables import text_of_table
from phsi_opt.study.record import StudyRecord
from phsi_opt.study.summary import unestablished_words


def report_sections(study: StudyRecord) -> list[Section]:
    """History, present model, comparison, verdict, and every diagnosis."""
    unit = f" ({study.unit})" if study.unit else ""
    history = text_of_table(study.history)
    introduction = f"Errors are root mean squares of the free-run residual{unit}."
    not_asked = "not asked yet: call `study.auto()` or `study.diagnose()`"
    fit = study.last.fit
    model = (str(fit), "\n".join(fit.equations()))
    judged = str(study.last.judged)
    verdict = "\n\n".join(
        filter(None, (study.stopped or not_asked, unestablished_words(study)))
    )
    sections = [
        Section("Study", 1, introduction),
        Section("History", 2, outputs=(history,)),
        Section("Model", 2, outputs=model),
        Section("Against the measurements", 2, outputs=(judged,)),
        Section("Verdict", 2, verdict),
    ]
    for number, diagnosis in sorted(study.diagnoses.items()):
        said = "\n".join(f"- {sentence}" for sentence in diagnosis.sentences)
        heading = f"Diagnosis before step {number + 1}"
        sections.append(Section(heading, 3, said, (str(diagnosis),)))
    return sections
