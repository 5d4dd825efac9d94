"""TODO."""

from collections.abc import Mapping

import pandas as pd

from phsi_opt.criteria import CERTAIN_FORCE, CLEAR_PATTERN
from phsi_opt.force_analysis.dependence import leading
from phsi_opt.force_analysis.energy import Power
from phsi_opt.force_analysis.force_record import force_unit, frequency_unit, spaced


def sentences(
    units: Mapping[str, str],
    where: pd.DataFrame,
    follows: pd.DataFrame,
    energy: Power,
) -> list[str]:
    """Plain sentences on where the model fails, an equation each, strongest first.

    Args:
        units: as in `Measurements`.
        where: from `located`; ``follows``: from `depends_on`; ``energy``: from `power`.
    """
    words = dict(zip(energy.table["equation"], energy.sentences, strict=True))
    said = []
    for _, row in where.iterrows():
        said.append(_sentence(row, words[row["equation"]], follows, units))
    return said


def _sentence(
    row: pd.Series, words: str, found: pd.DataFrame, units: Mapping[str, str]
) -> str:
    name, times = row["equation"], row["times_noise"]
    size = f"{row['strength']:.3g}{spaced(force_unit(name, units))}"
    if times < CERTAIN_FORCE:
        return f"d{name}/dt: no missing force is sure (rms {size}, {times:.2g} times its standard deviation)."
    pattern = (
        f"It {words}."
        if words != "no clear pattern"
        else "No single cause explains it."
    )
    if (best := leading(found, name)) is not None and best["share"] >= CLEAR_PATTERN:
        pattern += (
            f" Best predicted from {best['variable']} ({100 * best['share']:.0f} %)."
        )
    sure = f"{times:.2g} times its standard deviation"
    return f"d{name}/dt lacks a force of rms {size}, {sure}; {_place(row, units)}. {pattern}"


def _place(row: pd.Series, units: Mapping[str, str]) -> str:
    """Trajectory, times, region and frequency of one row of `located`, in words."""
    run = (
        row["trajectory"]
        if isinstance(row["trajectory"], str)
        else f"trajectory {row['trajectory']}"
    )
    window, region, unit = (
        row["time_window"],
        row["state_region"],
        spaced(units.get("t", "")),
    )
    place = (
        "about as strong all the time"
        if "throughout" in window
        else f"strongest in {run}, t = {window}{unit}"
    )
    place += (
        ""
        if region == "everywhere"
        else f"{';' if 'throughout' in window else ','} strong where {region}"
    )
    return place + (
        f"; mostly at {row['frequency']:.3g} {frequency_unit(units)}"
        if row["frequency"] > 0
        else ""
    )
