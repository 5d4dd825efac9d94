"""Storages that nobody measures, where the candidates leave more than noise.

What is expected of one by a linearisation of the model without it says nothing (see
``is_second_storage``), so that those of the equations that lack most are re-fitted.
"""

from collections.abc import Sequence

from phsi_opt.comparison.model_selection import is_like_noise
from phsi_opt.criteria import N_STORAGE_REFITS
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.remainder import weakest_equations
from phsi_opt.diagnosis.simple_losses import Refitted
from phsi_opt.model.catalogue_storages import is_second_storage
from phsi_opt.screening.prospects import Prospects


def with_second_storages(
    base: DiagnosedModel,
    prospects: Prospects,
    candidates: Sequence[Candidate],
    refitted: Refitted,
) -> list[Candidate]:
    """The candidates, and the second storages where none of them leaves noise.

    Args:
        base: the model that is diagnosed.
        prospects: its larger models.
        candidates: those that were re-fitted.
        refitted: makes re-fits of more.
    """
    result = list(candidates)
    is_left = any(base.is_left_with_noise(one.trained) for one in result)
    if is_left or is_like_noise(base.trained):
        return result
    tried = [one.name for one in result]
    storages = []
    weakest = weakest_equations(base.fit.model, base.record.estimate)
    for equation in weakest[:N_STORAGE_REFITS]:
        for one in prospects.singles:
            is_there = one.effect.equation == equation and one.name not in tried
            if is_there and is_second_storage(one.effect):
                storages.append(one)
    return result + refitted(storages, base.fit, None)
