"""What to do where no effect of the catalogue is named.

That is a measurement, an experiment, or a part of the model to look at again.
What the missing force looks like decides: one that shakes is sought at the machine, one
that follows an input where the input enters, one that follows nothing measured in a
state or an input that the model and the data lack.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from phsi_opt.criteria import CLEAR_PATTERN
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.dependence import leading
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.words import inputs_words
from phsi_opt.model.kinds import ELECTRICAL, HYDRAULIC, MECHANICAL, THERMAL
from phsi_opt.model.structure import exchange_partners, kind_of, with_kinds_of_units
from phsi_opt.presentation.content import Answer


class FieldWords(NamedTuple):
    """What a field calls what a model may lack."""

    state: str  # a part that moves or stores by itself
    input: str  # what else may be sought
    arrives: str  # what an input is where it acts
    unseen: str  # what is missing where a force follows nothing that was measured


FIELDS = {
    THERMAL: FieldWords(
        "a further store of heat (walls beside the air)",
        "another input of heat (people, ventilation)",
        "the heat that reaches",
        "A store or an input of heat",
    ),
    HYDRAULIC: FieldWords(
        "a further vessel",
        "another inflow or outflow",
        "the flow that reaches",
        "A vessel, a pipe or an inflow",
    ),
    ELECTRICAL: FieldWords(
        "a further storage (a second resistor and capacitor)",
        "another source or load",
        "the voltage or current at",
        "A storage or a source",
    ),
    MECHANICAL: FieldWords(
        "a part that moves by itself (play, a soft shaft, a second mass)",
        "another force from outside",
        "the force on",
        "A part that moves by itself, or a force from outside,",
    ),
    "": FieldWords(
        "one more state (a second inertia or storage, an elastic part, a lag)",
        "another input",
        "what drives",
        "A storage, or an input that was not measured,",
    ),
}
# What seems to be wrong, by what explains most of a force.
LIKELY = {
    "unexplained": "{field.unseen} seems to be missing",
    "inputs": "The way the {enters} d{equation}/dt seems to be wrong",
    "time": "Something that changes with the time seems to be missing",
    "parameters": "The model's parameters seem to change along the record",
}
NO_EFFECT = "No effect of the catalogue fits."
# What to do, and why or how, by what the force looks like.
WHAT_TO_DO = {
    "unsure": (
        "Record longer, or with less noise, and diagnose again.",
        f"{NO_EFFECT} No missing force is sure.",
    ),
    "vibration": (
        "Average every {n} samples and diagnose again: anything else that is missing "
        "then shows.",
        "At the machine, look for what swings so fast: loose or soft parts, play, "
        "interference, a sensor's resolution. (Averages: thinned = {n} in a study "
        "file, data.thinned({n}) in Python.)",
    ),
    "unexplained": (
        "Give the model {field.state}.",
        "Most of what is missing follows nothing that was measured at the same time. "
        "If that does not help, record {field.input}.",
    ),
    "wave": (
        "Write a term of your own in d{equation}/dt that repeats along {position}.",
        f"{NO_EFFECT} Cogging, the teeth of a gear or a wheel off centre look so. "
        'In Python, study.add(ph.Effect("ripple", "F", "{equation}", '
        'ph.trigonometric("{position}"))) finds the period with the size.',
    ),
    "parameters": (
        "Fit each half of the record by itself, and compare the parameters.",
        "Changing them helps on parts of the record, but no one set of values fits all "
        "of it. They may make up for {field.state}.",
    ),
    "together": (
        "Record data in which {inputs} and what it moves with go apart.",
        NO_EFFECT,
    ),
    "inputs": (
        "Measure {field.arrives} {equation} directly, or give the model a store, a "
        "delay or a limit between {inputs} and {equation}.",
        NO_EFFECT,
    ),
    "time": (
        "Repeat the run, and record what may have changed with the time as an input.",
        f"{NO_EFFECT} What changes may be a load, a temperature, a supply.",
    ),
    "law": (
        "Write a term of your own in d{equation}/dt that depends on {followed}.",
        f"{NO_EFFECT} diagnosis.learned_force() draws the curve of what is missing.",
    ),
}


def step_without_name(analysis: ForceAnalysis, units: Mapping[str, str]) -> Answer:
    """What to do next about the surest missing force, for which there is no name.

    ``units`` are as in `Measurements`; they tell of which field an equation is.
    """
    force = analysis.force_in()
    if force.is_uncertain:
        return _advice("unsure")
    if force.pace.is_vibration:
        return _advice("vibration", n=force.pace.samples_per_cycle)
    return advice_of_cause(units, force)


def _advice(case: str, **facts: Any) -> Answer:
    lead, detail = WHAT_TO_DO[case]
    return Answer(lead.format(**facts), detail.format(**facts))


def likely_cause(units: Mapping[str, str], force: EquationForce) -> str:
    """What seems to be wrong, by what a force follows: the begin of a sentence.

    Empty where one is as likely as another; ``units`` are as in `step_without_name`.
    """
    strongest = _strongest(force)
    if strongest == "inputs" and force.causes.goes_together:
        return ""
    is_one = len(force.record.model.inputs) == 1
    enters = "input enters" if is_one else "inputs enter"
    facts = {"equation": force.equation, "enters": enters}
    return LIKELY.get(strongest, "").format(field=_field(units, force), **facts)


def _strongest(force: EquationForce) -> str:
    """The cause that explains most of a force, unless less than is 'unexplained'."""
    shares = force.causes.shares
    left = shares.pop("unexplained")
    strongest = max(shares, key=shares.__getitem__)
    return "unexplained" if shares[strongest] < left else strongest


def _field(units: Mapping[str, str], force: EquationForce) -> FieldWords:
    known = with_kinds_of_units(force.record.model, units)
    return FIELDS[kind_of(known, force.equation)]


def advice_of_cause(units: Mapping[str, str], force: EquationForce) -> Answer:
    """What follows from the strongest cause of a force, or from there being none.

    ``units`` are as in `step_without_name`.
    """
    facts = {"equation": force.equation, "field": _field(units, force)}
    case = _strongest(force)
    # Parameters are bent to imitate what repeats.
    if force.wave is not None and case in ("conserved", "parameters"):
        return _advice("wave", position=force.wave.position, **facts)
    if case == "inputs":
        case = "together" if force.causes.goes_together else case
        return _advice(case, inputs=inputs_words(force), **facts)
    if case in WHAT_TO_DO:
        return _advice(case, **facts)
    return _advice("law", followed=" and ".join(_followed(force)), **facts)


def _followed(force: EquationForce) -> list[str]:
    """What predicts a force best, if clearly; else all states that it may follow."""
    model = force.record.model
    best = leading(force.follows, force.equation)
    if best is None or best["share"] < CLEAR_PATTERN:
        partners = exchange_partners(model, force.equation)
        return list(dict.fromkeys((*partners, force.equation)))
    state_of = dict(zip(model.efforts, model.states, strict=True))
    names = str(best["variable"]).split(", ")
    return list(dict.fromkeys(state_of.get(name, name) for name in names))
