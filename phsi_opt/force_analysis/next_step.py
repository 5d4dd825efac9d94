"""What to do where no effect of the catalogue is named.

That is a measurement, an experiment, or a part of the model to look at again.
What the missing force looks like decides: one that shakes is sought at the machine, one
that follows an input where the input enters, one that follows nothing measured in a
state or an input that the model and the data lack. The sentences stand in
``words.jinja``.
"""

from collections.abc import Mapping

from phsi_opt.criteria import CLEAR_PATTERN
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.dependence import leading
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.model.structure import exchange_partners, kind_of, with_kinds_of_units
from phsi_opt.presentation.content import Answer
from phsi_opt.presentation.sentences import say


def step_without_name(analysis: ForceAnalysis, units: Mapping[str, str]) -> Answer:
    """What to do next about the surest missing force, for which there is no name.

    ``units`` are as in `Measurements`; they tell of which field an equation is.
    """
    force = analysis.force_in()
    if force.is_uncertain:
        return say(__package__, "unsure")
    if force.pace.is_vibration:
        return say(__package__, "shakes", n=force.pace.samples_per_cycle)
    return advice_of_cause(units, force)


def likely_cause(units: Mapping[str, str], force: EquationForce) -> str:
    """What seems to be wrong, by what a force follows: the begin of a sentence.

    Empty where one is as likely as another; ``units`` are as in `step_without_name`.
    """
    return _said("likely", units, force).lead


def advice_of_cause(units: Mapping[str, str], force: EquationForce) -> Answer:
    """What follows from the strongest cause of a force, or from there being none.

    ``units`` are as in `step_without_name`.
    """
    return _said("advice", units, force)


def _said(name: str, units: Mapping[str, str], force: EquationForce) -> Answer:
    """By the cause that explains most, unless that is less than is left."""
    shares = force.causes.shares
    case = max(shares, key=lambda cause: (shares[cause], cause != "unexplained"))
    model = force.record.model
    return say(
        __package__,
        name,
        case=case,
        force=force,
        model=model,
        rate=f"d{force.equation}/dt",
        kind=kind_of(with_kinds_of_units(model, units), force.equation),
        law_of=_followed,
    )


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
