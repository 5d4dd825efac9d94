"""Where a model fails, in plain sentences: size, place, cause of each missing force.

Nothing is computed here; the numbers come from the tables of an analysis.
"""

import datetime as dt
from collections.abc import Mapping
from typing import TYPE_CHECKING

from phsi_opt.criteria import CERTAIN_FORCE, CLEAR_PATTERN
from phsi_opt.force_analysis.dependence import leading
from phsi_opt.force_analysis.energy import EnergyExchange
from phsi_opt.force_analysis.energy_wording import NO_PATTERN
from phsi_opt.force_analysis.localization import EVERYWHERE, THROUGHOUT
from phsi_opt.force_analysis.pace import Pace
from phsi_opt.force_analysis.units import (
    RateScale,
    frequency_words,
    scale_of_rate,
    spaced,
    with_units,
)
from phsi_opt.presentation.durations import dates_words, times_words

if TYPE_CHECKING:
    import pandas as pd

VIBRATION_WORDS = "a vibration or an error of a sensor, rather than a law of the motion"


def sentences(
    units: Mapping[str, str],
    where: "pd.DataFrame",
    follows: "pd.DataFrame",
    energy: EnergyExchange,
    paces: Mapping[str, Pace],
    origins: Mapping[str, dt.datetime | None],
    longest: float = 0.0,
) -> list[str]:
    """Plain sentences on where the model fails, an equation each, strongest first.

    Args:
        units: as in `Measurements`.
        where: from `located`.
        follows: from `depends_on`.
        energy: from `energy_exchange`.
        paces: of the missing forces by equation.
        origins: moments at which the time is 0, by trajectory; None: no dates.
        longest: the last time of the record; long ones have rates per hour.
    """
    causes = dict(zip(energy.table["equation"], energy.sentences, strict=True))
    texts = []
    for _, row in where.iterrows():
        equation = row["equation"]
        pattern = _pattern(causes[equation], leading(follows, equation))
        origin = origins[str(row["trajectory"])]
        place = _place(row, units, paces[equation], origin)
        scale = scale_of_rate(equation, units, longest)
        texts.append(_sentence(row, pattern, scale, place))
    return texts


def _sentence(row: "pd.Series", pattern: str, scale: RateScale, place: str) -> str:
    """Size and place of one row of `located`, and the pattern of its force."""
    equation = row["equation"]
    times_noise = row["times_noise"]
    size = f"rms {row['strength'] / scale.size:.3g}{spaced(scale.unit)}"
    certainty = f"{times_noise:.2g} times its standard deviation"
    if times_noise < CERTAIN_FORCE:
        return f"d{equation}/dt: no missing force is sure ({size}, {certainty})."
    return f"d{equation}/dt lacks a force of {size}, {certainty}; {place}. {pattern}"


def _pattern(cause: str, best: "pd.Series | None") -> str:
    """What the force does with energy, and what predicts it best."""
    pattern = f"It {cause}."
    if cause == NO_PATTERN:
        pattern = "No single cause explains it."
    if best is None or best["share"] < CLEAR_PATTERN:
        return pattern
    percent = f"{100 * best['share']:.0f} %"
    return f"{pattern} Best predicted from {best['variable']}: {percent} of it."


def _place(
    row: "pd.Series",
    units: Mapping[str, str],
    pace: Pace,
    origin: dt.datetime | None,
) -> str:
    """Trajectory, times, region and frequency of one row of `located`, in words."""
    window = row["time_window"]
    region = row["state_region"]
    is_throughout = window.endswith(THROUGHOUT)
    if is_throughout:
        place = "about as strong all the time"
    else:
        times = times_words(window, units.get("t", ""))
        place = f"strongest in {row['trajectory']}, t = {times}"
        dates = dates_words(window, origin)
        if dates:
            place += f" ({dates})"
    if region != EVERYWHERE:
        mark = ";" if is_throughout else ","
        place += f"{mark} strong where {with_units(region, units)}"
    if pace.is_vibration:
        return f"{place}; mostly {pace.speed_words(units)}: {VIBRATION_WORDS}"
    if row["frequency"] > 0:
        place += f"; mostly {frequency_words(float(row['frequency']), units)}"
    return place
