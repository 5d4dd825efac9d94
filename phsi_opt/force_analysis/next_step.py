"""What to do where no effect of the catalogue is named.

That is a measurement, an experiment, or a part of the model to look at again.
What the missing force looks like decides: one that shakes is sought at the machine, one
that follows an input where the input enters, one that follows nothing measured in a
state or an input that the model and the data lack.
"""

from collections.abc import Mapping

from phsi_opt.criteria import CLEAR_PATTERN
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.causes import CAUSES
from phsi_opt.force_analysis.dependence import leading
from phsi_opt.force_analysis.energy_wording import TOGETHER
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.pace import Pace
from phsi_opt.force_analysis.position_waves import PositionWave
from phsi_opt.model.kinds import ELECTRICAL, HYDRAULIC, MECHANICAL, THERMAL
from phsi_opt.model.structure import exchange_partners, kind_of, with_kinds_of_units
from phsi_opt.presentation.report_content import Answer

# A part that moves or stores by itself, as the field calls it.
FURTHER_STATE = {
    THERMAL: "a further store of heat (walls beside the air)",
    HYDRAULIC: "a further vessel",
    ELECTRICAL: "a further storage (a second resistor and capacitor)",
    MECHANICAL: "a part that moves by itself (play, a soft shaft, a second mass)",
    "": "one more state (a second inertia or storage, an elastic part, a lag)",
}
# What else may be sought, in the same words.
FURTHER_INPUT = {
    THERMAL: "another input of heat (people, ventilation)",
    HYDRAULIC: "another inflow or outflow",
    ELECTRICAL: "another source or load",
    MECHANICAL: "another force from outside",
    "": "another input",
}
# What an input is where it acts.
ARRIVES = {
    THERMAL: "the heat that reaches",
    HYDRAULIC: "the flow that reaches",
    ELECTRICAL: "the voltage or current at",
    MECHANICAL: "the force on",
    "": "what drives",
}
# What is missing where most of a force follows nothing that was measured.
UNSEEN = {
    THERMAL: "A store or an input of heat",
    HYDRAULIC: "A vessel, a pipe or an inflow",
    ELECTRICAL: "A storage or a source",
    MECHANICAL: "A part that moves by itself, or a force from outside,",
    "": "A storage, or an input that was not measured,",
}
NO_EFFECT = "No effect of the catalogue fits."


def step_without_name(analysis: ForceAnalysis, units: Mapping[str, str]) -> Answer:
    """What to do next about the surest missing force, for which there is no name.

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
        f"Average every {n} samples and diagnose again: anything else that is missing "
        "then shows.",
        "At the machine, look for what swings so fast: loose or soft parts, play, "
        f"interference, a sensor's resolution. (Averages: thinned = {n} in a study "
        f"file, data.thinned({n}) in Python.)",
    )


def likely_cause(units: Mapping[str, str], force: EquationForce) -> str:
    """What seems to be wrong, by what a force follows: the begin of a sentence.

    Empty where one is as likely as another.

    Args:
        units: as in `Measurements`; they tell of which field the equation is.
        force: that is missing.
    """
    strongest, share = _strongest(force)
    if share < float(force.shares["unexplained"]):
        known = with_kinds_of_units(force.record.fit.model, units)
        unseen = UNSEEN[kind_of(known, force.equation)]
        return f"{unseen} seems to be missing"
    inputs = force.record.fit.model.inputs
    if strongest == "inputs" and TOGETHER not in force.cause:
        several = "inputs enter" if len(inputs) > 1 else "input enters"
        return f"The way the {several} d{force.equation}/dt seems to be wrong"
    if strongest == "time":
        return "Something that changes with the time seems to be missing"
    if strongest == "parameters":
        return "The model's parameters seem to change along the record"
    return ""


def _strongest(force: EquationForce) -> tuple[str, float]:
    """The cause that explains most of a force, and its share."""
    causes = ("parameters", *CAUSES)
    strongest = max(causes, key=lambda cause: float(force.shares[cause]))
    return strongest, float(force.shares[strongest])


def advice_of_cause(units: Mapping[str, str], force: EquationForce) -> Answer:
    """What follows from the strongest cause of a force, or from there being none.

    Args:
        units: as in `Measurements`; they tell of which field the equation is.
        force: that is missing.
    """
    strongest, share = _strongest(force)
    kind = kind_of(with_kinds_of_units(force.record.fit.model, units), force.equation)
    further = FURTHER_STATE[kind]
    causes = {
        "parameters": _of_parameters,
        "inputs": lambda one: _of_inputs(one, ARRIVES[kind]),
        "time": _of_time,
        "conserved": _of_states,
        "dissipated": _of_states,
        "constant": _of_states,
    }
    if share < float(force.shares["unexplained"]):
        return Answer(
            f"Give the model {further}.",
            "Most of what is missing follows nothing that was measured at the same "
            f"time. If that does not help, record {FURTHER_INPUT[kind]}.",
        )
    # Parameters are bent to imitate what repeats.
    if force.wave is not None and strongest in ("conserved", "parameters"):
        return _of_wave(force.equation, force.wave)
    told = causes[strongest](force)
    if strongest == "parameters":
        return Answer(told.lead, f"{told.detail} They may make up for {further}.")
    return told


def _of_parameters(force: EquationForce) -> Answer:
    return Answer(
        "Fit each half of the record by itself, and compare the parameters.",
        "Changing them helps on parts of the record, but no one set of values fits "
        "all of it.",
    )


def _of_inputs(force: EquationForce, arrives: str) -> Answer:
    inputs = force.record.fit.model.inputs
    names = f"{'the inputs' if len(inputs) > 1 else 'the input'} {', '.join(inputs)}"
    if TOGETHER in force.cause:
        told = f"Record data in which {names} and what it moves with go apart."
        return Answer(told, NO_EFFECT)
    return Answer(
        f"Measure {arrives} {force.equation} directly, or give the model a store, a "
        f"delay or a limit between {names} and {force.equation}.",
        NO_EFFECT,
    )


def _of_time(force: EquationForce) -> Answer:
    return Answer(
        "Repeat the run, and record what may have changed with the time as an input.",
        f"{NO_EFFECT} What changes may be a load, a temperature, a supply.",
    )


def _of_wave(equation: str, wave: PositionWave) -> Answer:
    return Answer(
        f"Write a term of your own in d{equation}/dt that repeats along "
        f"{wave.position}.",
        f"{NO_EFFECT} Cogging, the teeth of a gear or a wheel off centre look so. "
        f'In Python, study.add(ph.Effect("ripple", "F", "{equation}", '
        f'ph.trigonometric("{wave.position}"))) finds the period with the size.',
    )


def _of_states(force: EquationForce) -> Answer:
    return Answer(
        f"Write a term of your own in d{force.equation}/dt that depends on "
        f"{' and '.join(_followed(force))}.",
        f"{NO_EFFECT} diagnosis.learned_force() draws the curve of what is missing.",
    )


def _followed(force: EquationForce) -> list[str]:
    """What predicts a force best, if clearly; else all states that it may follow."""
    model = force.record.fit.model
    best = leading(force.follows, force.equation)
    if best is None or best["share"] < CLEAR_PATTERN:
        partners = exchange_partners(model, force.equation)
        return list(dict.fromkeys((*partners, force.equation)))
    state_of = dict(zip(model.efforts, model.states, strict=True))
    names = str(best["variable"]).split(", ")
    return list(dict.fromkeys(state_of.get(name, name) for name in names))
