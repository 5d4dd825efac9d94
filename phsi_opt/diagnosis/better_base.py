"""A base model re-fitted from where it was weighed.

A fit that began far off may have ended in the wrong optimum, with a parameter at its
bound. Beside a force the model is not held to one course of its states, and comes to
the values that follow the record; a re-fit from there may be far likelier.
"""

from dataclasses import replace

from phsi_opt.comparison.compare import compare_record, deviance
from phsi_opt.criteria import OTHER_OPTIMUM_DEVIANCE
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.identify import identify_aligned
from phsi_opt.estimation.record import Record
from phsi_opt.screening.weighing import EvidenceRecord


def better_base(base: DiagnosedModel, record: EvidenceRecord) -> DiagnosedModel | None:
    """The model from a clearly better optimum; None where there is none.

    Args:
        base: the model that is diagnosed.
        record: beside which it was weighed.
    """
    fitted = base.fit
    if not fitted.model.free or not base.record.is_of_training:
        return None
    weighed = record.base
    values = {name: weighed.model.values[name] for name in fitted.model.free}
    states = weighed.states[: record.n_fitted_nodes]
    start = replace(
        fitted,
        model=fitted.model.with_values(values),
        states=base.record.estimate.grid.split(states),
    )
    base.say("re-fitting the model from where it was weighed")
    aligned = base.record.aligned
    try:
        fit = identify_aligned(start.model, aligned, base.loss, start=start)
        if not deviance(fit) < deviance(fitted) - OTHER_OPTIMUM_DEVIANCE:
            return None
        trained = compare_record(Record.of_aligned(fit, aligned))
        judged = trained
        if base.is_held_out:
            judged = compare_record(Record.of_aligned(fit, base.judged.record.aligned))
    except PhsiOptError:
        return None
    return replace(base, trained=trained, judged=judged)
