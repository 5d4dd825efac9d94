"""What to do where no effect of the catalogue is named.

That is a measurement, an experiment, or a part of the model to look at again.
What the missing force looks like decides: one that shakes is sought at the machine, one
that follows an input where the input enters, one that follows nothing measured in a
state or an input that the model and the data lack.
"""

from collections.abc import Mapping

from phsi_opt.criteria import NAMED_CAUSE
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.causes import exchange_partners
from phsi_opt.force_analysis.energy_wording import TOGETHER
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.pace import Pace
from phsi_opt.model.kinds import ELECTRICAL, HYDRAULIC, MECHANICAL, THERMAL
from phsi_opt.model.structure import kind_of, with_kinds_of_units
from phsi_opt.presentation.report_content import Answer

# A part that moves or stores by itself, as the field calls it.
FURTHER_STATE = {
    THERMAL: "a further store of heat (walls beside the air)",
    HYDRAULIC: "a further vessel or pipe",
    ELECTRICAL: "a further storage (a second resistor and capacitor)",
    MECHANICAL: "a part that moves by itself (play, a soft shaft, a second mass)",
    "": "a further storage, or a part that moves by itself",
}
NO_EFFECT = "No effect of the catalogue fits."


def next_step(analysis: ForceAnalysis, units: Mapping[str, str]) -> Answer:
    """What to do next about the surest missing force.

    Args:
        analysis: of the missing forces.
        units: as in `Measurements`.
    """
    force = EquationForce.of(analysis, None)
    if force.is_uncertain:
        return Answer(
            "Record longer, or with less noise, and diagnose again.",
            f"{NO_EFFECT} No missing force is sure.",
        )
    if force.pace.is_vibration:
        return against_vibration(force.pace)
    return advice_of_cause(units, force)


def against_vibration(pace: Pace) -> Answer:
    """What to do about a force that shakes, and to see what is missing beside it."""
    n = pace.samples_per_cycle
    return Answer(
        f"Find what swings so fast, or average it away by means of {n} samples, and "
        "diagnose again.",
        f"{NO_EFFECT} Means, data.thinned({n}) or thinned = {n} in a study file, show "
        "what is missing beside it. Look for loose or soft parts, play, interference, "
        "a sensor's resolution.",
    )


def advice_of_cause(units: Mapping[str, str], force: EquationForce) -> Answer:
    """What follows from the strongest cause of a force, or from there being none.

    Args:
        units: as in `Measurements`; they tell of which field the equation is.
        force: that is missing.
    """
    shares = force.shares
    causes = {
        "parameters": _of_parameters,
        "inputs": _of_inputs,
        "time": _of_time,
        "conserved": _of_states,
        "dissipated": _of_states,
        "constant": _of_states,
    }
    strongest = max(causes, key=lambda cause: float(shares[cause]))
    share = float(shares[strongest])
    told = causes[strongest](force) if share > NAMED_CAUSE else ""
    further = _further_state(units, force)
    if share < float(shares["unexplained"]):
        return Answer(
            f"Give the model {further}, or measure an input that is not recorded.",
            f"{NO_EFFECT} Most of what is missing follows nothing that was measured "
            f"at the same time. {told}".strip(),
        )
    if strongest == "parameters":
        return Answer(told, f"{NO_EFFECT} What they make up for may be {further}.")
    return Answer(told, NO_EFFECT)


def _further_state(units: Mapping[str, str], force: EquationForce) -> str:
    """A further state in the words of the equation's field."""
    known = with_kinds_of_units(force.record.fit.model, units)
    return FURTHER_STATE[kind_of(known, force.equation)]


def _of_parameters(force: EquationForce) -> str:
    return (
        "Fit the halves of the record apart and compare the values: other values of "
        "the model's own parameters would give a part of it, but none for the whole "
        "record."
    )


def _of_inputs(force: EquationForce) -> str:
    inputs = force.record.fit.model.inputs
    names = f"{'the inputs' if len(inputs) > 1 else 'the input'} {', '.join(inputs)}"
    if TOGETHER in force.cause:
        return f"Record data in which {names} and what it moves with go apart."
    return (
        f"Look at how {names} enter{'s' if len(inputs) == 1 else ''} "
        f"d{force.equation}/dt: measured where it acts, or on the way there?"
    )


def _of_time(force: EquationForce) -> str:
    return (
        "Repeat the run, and record what may have changed with the time (a load, a "
        "temperature, a supply) as an input."
    )


def _of_states(force: EquationForce) -> str:
    model = force.record.fit.model
    names = dict.fromkeys((*exchange_partners(model, force.equation), force.equation))
    return (
        f"Write a term of your own in d{force.equation}/dt that depends on "
        f"{' and '.join(names)}; diagnosis.learned_force() draws its curve."
    )
