"""Where a model fails, in a plain sentence: size, place, cause of a missing force.

Nothing is computed here; the numbers are those of the force.
"""

from phsi_opt.criteria import CLEAR_PATTERN
from phsi_opt.force_analysis.cause_words import NO_PATTERN, cause_words
from phsi_opt.force_analysis.dependence import leading
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.localization import THROUGHOUT, region_words
from phsi_opt.force_analysis.units import frequency_words, spaced
from phsi_opt.presentation.durations import dates_words, times_words

VIBRATION_WORDS = "a vibration or an error of a sensor, rather than a law of the motion"


def sentence(force: EquationForce) -> str:
    """Size and place of a missing force, what it does with energy, what predicts it."""
    where = force.where
    scale = force.scale
    equation = f"d{force.equation}/dt"
    size = f"rms {where['strength'] / scale.size:.3g}{spaced(scale.unit)}"
    certainty = f"{where['times_noise']:.2g} times its standard deviation"
    if force.is_uncertain:
        return f"{equation}: no missing force is sure ({size}, {certainty})."
    said = f"{equation} lacks a force of {size}, {certainty}; {_place(force)}."
    cause = cause_words(force)
    said += " No single cause explains it." if cause == NO_PATTERN else f" It {cause}."
    best = leading(force.follows, force.equation)
    if best is None or best["share"] < CLEAR_PATTERN:
        return said
    share = f"{100 * best['share']:.0f} % of it"
    return f"{said} Best predicted from {best['variable']}: {share}."


def _place(force: EquationForce) -> str:
    """Trajectory, times, region and frequency."""
    units = force.record.units
    window = force.where["time_window"]
    place = "about as strong all the time"
    mark = ";"
    if not window.endswith(THROUGHOUT):
        name = force.where["trajectory"]
        place = f"strongest in {name}, t = {times_words(window, units.get('t', ''))}"
        dates = dates_words(window, force.record.origin_of(name))
        place += f" ({dates})" if dates else ""
        mark = ","
    if force.region:
        place += f"{mark} strong where {region_words(force.region, units)}"
    if force.pace.is_vibration:
        return f"{place}; mostly {force.pace.speed_words(units)}: {VIBRATION_WORDS}"
    if force.pace.frequency > 0:
        place += f"; mostly {frequency_words(force.pace.frequency, units)}"
    return place
