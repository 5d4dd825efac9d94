"""A base model re-fitted from where its own missing force points.

A fit that began far off may have ended in the wrong optimum, with a parameter at its
bound. Its missing force is then mostly what other values of its own parameters would
give. Gauss-Newton steps from the states of that force find these values.
"""

from dataclasses import replace

import numpy as np

from phsi_opt.comparison.compare import compare_record
from phsi_opt.comparison.model_selection import deviance
from phsi_opt.criteria import OTHER_OPTIMUM_DEVIANCE
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.identify import identify_aligned
from phsi_opt.estimation.record import Record
from phsi_opt.screening.second_look import Look, second_look


def from_missing_force(base: DiagnosedModel) -> DiagnosedModel:
    """The model re-fitted from there where that is clearly better; else as it was."""
    record = base.record
    if not record.model.free:
        return base
    look = second_look(record, (), {})
    if look is None:
        return base
    present = second_look(record, (), record.fit.values, is_held=True)
    least = np.inf if present is None else present.deviance - OTHER_OPTIMUM_DEVIANCE
    if look.deviance > least:
        return base
    base.say("re-fitting the model from other values of its own parameters")
    try:
        return _refitted(base, look)
    except PhsiOptError:
        return base


def _refitted(base: DiagnosedModel, look: Look) -> DiagnosedModel:
    """The model re-fitted from where a look ended.

    Raises:
        PhsiOptError: the re-fit, or its free run, fails.
    """
    record = base.record
    start = replace(
        record.fit,
        model=record.model.with_values(look.model.values),
        states=record.estimate.grid.split(look.states),
    )
    fit = identify_aligned(start.model, record.aligned, base.loss, start=start)
    is_same_record = record.is_of_training
    if is_same_record and deviance(fit) > deviance(record.fit) - OTHER_OPTIMUM_DEVIANCE:
        return base
    trained = compare_record(Record.of_aligned(fit, record.aligned))
    judged = trained
    if base.is_held_out:
        aligned = base.judged.record.aligned
        judged = compare_record(Record.of_aligned(fit, aligned))
    return replace(base, trained=trained, judged=judged)
