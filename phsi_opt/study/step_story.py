"""One diagnosis in a paragraph, as an engineer would write it in a report."""

from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.presentation.numbers import capitalised
from phsi_opt.study.answers import (
    missing_answer,
    to_do_answer,
    where_answer,
    wrong_answer,
)
from phsi_opt.study.off_words import judged_words, off_words
from phsi_opt.study.record import StudyRecord
from phsi_opt.study.since_when import since_when


def step_story(study: StudyRecord, number: int) -> str:
    """What is wrong with the model of a step, where, since when, and what was done.

    Args:
        study: as it stands.
        number: of the step, counted from 0; its model was diagnosed.
    """
    diagnosis = study.diagnoses[number]
    is_held_out = study.held_out is not None
    if diagnosis.verdict == Verdict.NOTHING_MISSING:
        off = " and ".join(off_words(diagnosis.base))
        return (
            f"Simulated on {judged_words(is_held_out)}, the model is off: {off}. "
            "That is what noise leaves: no force is evident beside the model, and no "
            "effect is decisive."
        )
    told = (
        missing_answer(diagnosis, is_held_out),
        wrong_answer(diagnosis, is_held_out),
        where_answer(diagnosis),
        since_when(diagnosis, study.steps[number].train),
        to_do_answer(diagnosis, is_held_out),
        _done_since(study, number),
    )
    return " ".join(map(str, told)).strip()


def _done_since(study: StudyRecord, number: int) -> str:
    """What the next step did, and where the error has got since; "" without one."""
    if number + 1 >= len(study.steps):
        return ""
    step = study.steps[number + 1]
    return f"{capitalised(step.label)}: added in step {number + 1}."
