"""What to do where no effect of the catalogue is named: a measurement, an experiment, a
part of the model to look at again.

What the missing force looks like decides: one that shakes is sought at the machine, one
that follows an input where the input enters, one that follows nothing measured in a
state or an input that the model and the data lack.
"""

from collections.abc import Mapping

from phsi_opt.criteria import NAMED_CAUSE
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.force_analysis.causes import exchange_partners
from phsi_opt.force_analysis.energy_wording import TOGETHER
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.pace import Pace
from phsi_opt.model.kinds import ELECTRICAL, HYDRAULIC, MECHANICAL, THERMAL
from phsi_opt.model.structure import kind_of, with_kinds_of_units

# A part that moves or stores by itself, as the field calls it.
FURTHER_STATE = {
    THERMAL: "A further store of heat (walls beside the air)",
    HYDRAULIC: "A further vessel or pipe",
    ELECTRICAL: "A further storage (a second resistor and capacitor)",
    MECHANICAL: "A part that moves by itself (play, a soft shaft, a second mass)",
    "": "A further storage, or a part that moves by itself",
}


def next_step(diagnosis: Diagnosis) -> str:
    """What to do next, in sentences."""
    force = EquationForce.of(diagnosis.analysis, None)
    if force.is_uncertain:
        return (
            "No force is sure: record longer, or with less noise, and diagnose again."
        )
    if force.pace.is_vibration:
        return against_vibration(force.pace)
    return advice_of_cause(diagnosis.data.units, force)


def against_vibration(pace: Pace) -> str:
    """What to do about a force that shakes, and to see what is missing beside it."""
    n = pace.samples_per_cycle
    return (
        "First find out what swings so fast: loose or soft parts, play, interference, "
        "a sensor's resolution; repeat the run without it. To see what is missing "
        f"beside it, take means of {n} samples, data.thinned({n}), and diagnose again."
    )


def advice_of_cause(units: Mapping[str, str], force: EquationForce) -> str:
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
    told = []
    if share < float(shares["unexplained"]):
        told.append(_of_nothing(units, force))
    elif strongest == "parameters":
        told.append(f"{_further_state(units, force)} may be what they make up for.")
    if share > NAMED_CAUSE:
        told.insert(0 if strongest == "parameters" else 1, causes[strongest](force))
    return " ".join(told)


def _further_state(units: Mapping[str, str], force: EquationForce) -> str:
    """A further state in the words of the equation's field."""
    known = with_kinds_of_units(force.record.fit.model, units)
    return FURTHER_STATE[kind_of(known, force.equation)]


def _of_nothing(units: Mapping[str, str], force: EquationForce) -> str:
    further = _further_state(units, force)
    return (
        "Most of it follows nothing that was measured at the same time: "
        f"{further[:1].lower()}{further[1:]} may be missing in the model, or an input "
        "in the record."
    )


def _of_parameters(force: EquationForce) -> str:
    return (
        "Other values of the model's own parameters would give a part of it, but no "
        "value for the whole record: fit its halves apart and compare the values."
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
        "Something changed with the time: repeat the run, and record what may have "
        "changed (a load, a temperature, a supply) as an input."
    )


def _of_states(force: EquationForce) -> str:
    model = force.record.fit.model
    names = dict.fromkeys((*exchange_partners(model, force.equation), force.equation))
    return (
        f"Write a term of your own in d{force.equation}/dt that depends on "
        f"{' and '.join(names)}; diagnosis.learned_force() draws its curve."
    )
