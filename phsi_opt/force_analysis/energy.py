"""What a missing force does with energy.

It takes energy out, stores and returns it, follows an input, or depends on time.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.force_analysis.causes import CAUSES, Causes
from phsi_opt.force_analysis.energy_wording import energy_sentence
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.position_waves import PositionWave
from phsi_opt.presentation.table_making import printed_table

if TYPE_CHECKING:
    import pandas as pd

SHARES = ("parameters", *CAUSES)


@dataclass(frozen=True, eq=False)
class EnergyExchange:
    """What the missing force of every equation does with energy.

    Attributes:
        table: a row per equation: equation, mean_power (force times effort, averaged
            over the time; negative: taken out), parameters, constant, dissipated,
            conserved, inputs, time and unexplained. These shares are parts of the
            force's mean square on stretches of time left out, each what its cause adds
            to the stronger ones; they sum to one.
        sentences: the end of a sentence on each equation's force, with shares.
        causes: the same without shares.
    """

    table: "pd.DataFrame"
    sentences: tuple[str, ...]
    causes: tuple[str, ...]


def energy_exchange(
    force: ForceRecord, waves: Mapping[str, PositionWave]
) -> EnergyExchange:
    """Whether a force dissipates power w_i dH/dx_i, conserves it, or is driven.

    The force w_i is explained by functions of five kinds: a constant; odd functions of
    its own effort dH/dx_i (dissipated); functions of the states that it exchanges
    energy with, the positions for a momentum (conserved: what goes in comes back on the
    same way); functions of the inputs; functions of the time. The model's own
    parameters move along. The kind that predicts the left-out stretches best comes
    first; others follow while they add a fifth.

    Args:
        force: along the record.
        waves: along positions, by equation, where there are any.
    """
    rows = []
    sentences = []
    without_shares = []
    for equation in force.equations:
        causes = Causes.of(force, equation, waves.get(equation))
        shares = [causes.contributions.get(kind, 0.0) for kind in SHARES]
        mean_power = _mean_power(force, equation)
        rows.append((equation, mean_power, *shares, 1 - sum(shares)))
        sentences.append(energy_sentence(causes))
        without_shares.append(energy_sentence(causes, with_shares=False))
    columns = ["equation", "mean_power", *SHARES, "unexplained"]
    table = printed_table(rows, columns=columns)
    return EnergyExchange(table, tuple(sentences), tuple(without_shares))


def _mean_power(force: ForceRecord, equation: str) -> float:
    """Force times effort, averaged over the time."""
    power = force.force_on(equation) * force.effort_of(equation)
    energy = np.sum(power * force.h)
    return float(energy / np.sum(force.h))
