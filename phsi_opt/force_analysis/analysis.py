"""What a missing force looks like, in tables and words, and what follows from it.

A record that is made once: where the forces are, what they follow, what they do with
energy, and what to do where no effect of the catalogue is named: one that shakes is
sought at the machine, one that follows an input where the input enters, one that
follows nothing measured in a state or an input that the model and the data lack.

Here are the facts; the sentences stand in ``words.jinja``. A velocity has no symbol.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from phsi_opt.arguments import require_known
from phsi_opt.criteria import CLEAR_PATTERN
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.cross_validation import odd_basis
from phsi_opt.force_analysis.dependence import leading
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.force_analysis.waves import period_of
from phsi_opt.model.effect import Effect, is_delay
from phsi_opt.model.structure import (
    effort_of,
    exchange_partners,
    kind_of,
    with_kinds_of_units,
)
from phsi_opt.presentation.content import Answer
from phsi_opt.presentation.sentences import say
from phsi_opt.presentation.summary import printed_table
from phsi_opt.presentation.units import spaced, time_words
from phsi_opt.statistics import TINY, rms

if TYPE_CHECKING:
    import pandas as pd

# Mean power over rms force times rms effort (-1: linear damping) below which a force
# takes energy out; nearer to zero its direction is not clear.
OPPOSING_POWER = -CLEAR_PATTERN

VIBRATION_WORDS = "a vibration or a sensor error rather than a physical law"
# What the rate of a momentum or a velocity is called, by its unit.
RATES = {
    "N": "force on",
    "N m": "torque on",
    "m/s^2": "acceleration of",
    "rad/s^2": "acceleration of",
}


@dataclass(frozen=True, eq=False)
class ForceAnalysis:
    """The missing forces of a record, with all that they may depend on, by equation."""

    record: ForceRecord
    forces: tuple[EquationForce, ...]

    @classmethod
    def of(cls, record: Record) -> "ForceAnalysis":
        found = ForceRecord.of(record)
        forces = [EquationForce(found, equation) for equation in found.equations]
        return cls(found, tuple(forces))

    def force_in(self, equation: str | None = None) -> EquationForce:
        """The missing force of an equation.

        Args:
            equation: None: the one whose force is strongest over its uncertainty.

        Raises:
            ModelError: the equation has no missing force.
        """
        if equation is None:
            return max(self.strongest_first, key=lambda f: f.where["times_noise"])
        by_equation = {force.equation: force for force in self.forces}
        said = f"equation={equation!r} has no missing force"
        require_known(equation, by_equation, said)
        return by_equation[equation]

    @property
    def strongest_first(self) -> list[EquationForce]:
        """The forces, by their root mean square."""
        return sorted(self.forces, key=lambda force: -rms(force.w))

    @cached_property
    def where(self) -> "pd.DataFrame":
        """Where the forces are strong, strongest first.

        A row per equation that may lack one: equation; trajectory (its name) and
        time_window where it is strongest; state_region where it is strong; frequency
        (cycles per unit of time; 0 for a force that is mostly constant); strength
        (rms) and its unit; times_noise (strength over the typical standard deviation of
        the estimate: below 1 it is not sure).
        """
        return printed_table([force.where for force in self.strongest_first])

    @cached_property
    def follows(self) -> "pd.DataFrame":
        """What the forces depend on, best first (see `dependence`)."""
        import pandas as pd

        tables = [force.follows for force in self.forces]
        return pd.concat(tables, ignore_index=True)

    @cached_property
    def energy(self) -> "pd.DataFrame":
        """Whether the forces dissipate, store or supply energy.

        A row per equation: equation, mean_power (force times effort, averaged over the
        time; negative: taken out), its unit, parameters, constant, dissipated,
        conserved, inputs, time and unexplained. These shares are parts of the force's
        mean square on stretches of time left out, each what its cause adds to the
        stronger ones; they sum to one.
        """
        rows = []
        for force in self.forces:
            known = {"equation": force.equation, "mean_power": force.mean_power}
            rows.append({**known, "unit": force.power_unit, **force.causes.shares})
        return printed_table(rows)

    @cached_property
    def sentences(self) -> list[str]:
        """Where the model fails, in plain words, an equation each; strongest first."""
        return list(map(sentence, self.strongest_first))


# ---- in words ------------------------------------------------------------------------


def _said(force: EquationForce, name: str, **more: Any) -> Answer:
    """What ``words.jinja`` says of a force under a name."""
    model = force.record.model
    facts = {
        "force": force,
        "where": force.where,
        "model": model,
        "units": defaultdict(str, force.record.units),
        "rate": f"d{force.equation}/dt",
        "partners": exchange_partners(model, force.equation),
        "rate_of": RATES.get(force.scale.unit, "") if force.position else "",
        "vibration": VIBRATION_WORDS,
        "clear_pattern": CLEAR_PATTERN,
        "plain": partial(plain_name, force),
        "place": partial(place_words, force),
        "loss_of": _loss_of,
        "period_words": _period_words,
    }
    return say(__package__, name, **facts, **more)


def sentence(force: EquationForce) -> str:
    """Size and place of a missing force, what it does with energy, what predicts it."""
    best = leading(force.follows)
    return _said(force, "sentence", window=force.window_words(), best=best).lead


def place_answer(force: EquationForce) -> Answer:
    """The equation of a force, what it follows, and where it is largest."""
    return _said(force, "place_of")


def law_answer(analysis: ForceAnalysis, effect: Effect) -> Answer:
    """Where an effect acts, and on what it depends by its law."""
    model = analysis.record.model
    x = effect.equation
    if effect.slot == "sensor":
        return Answer(f"At the sensor of {x}.")
    force = analysis.force_in(x if x in analysis.record.equations else None)
    names = set(effect.names)
    if effect.slot == "R":
        names |= {effort_of(model, model.states[row]) for row in model.rows(x)}
    channels = (*model.efforts, *model.states, *model.inputs, "t")
    known = filter(names.__contains__, channels)
    depends = dict.fromkeys(map(partial(plain_name, force), known))
    has_memory = bool(effect.memory) or is_delay(effect)
    return _said(force, "law", depends=depends, has_memory=has_memory)


def dependence_title(force: EquationForce, variable: str) -> str:
    """Whether the force follows the variable, in a sentence."""
    share = max(force.share_of(variable), 0.0)
    return _said(force, "dependence_title", variable=variable, share_of=share).lead


# ---- facts ---------------------------------------------------------------------------


def _loss_of(force: EquationForce) -> str:
    """Whether the force opposes the effort, or changes or overcomes the loss."""
    if not force.record.model.has_energy:
        return ""
    functions = odd_basis(force.effort)
    shown = force.shown(functions)
    fitted = functions @ np.linalg.lstsq(shown, force.w, rcond=None)[0]
    whole_loss = fitted + force.record.losses[:, force.row]
    for kind, loss in (("opposes", fitted), ("changes", whole_loss)):
        # Of linear damping it is -1, of what is conserved 0.
        size = float(np.linalg.norm(loss) * np.linalg.norm(force.effort))
        if loss @ force.effort < OPPOSING_POWER * max(size, TINY):
            return kind
    return "feeds"


def _period_words(force: EquationForce) -> str:
    """The period, where one is within the longest trajectory; "" where none is."""
    record = force.record
    runs = [record.t[record.run == run] for run in np.unique(record.run)]
    period = period_of(force)
    if period is None or period > max(float(np.ptp(t)) for t in runs):
        return ""
    return time_words(period, record.units.get("t", ""))


def place_words(force: EquationForce, names: Iterable[str]) -> str:
    """At which values of variables a force is strong."""
    words = []
    for name, ranges in force.region_among(names).items():
        unit = spaced(force.scale_of(name).unit)
        words.append(f"where {plain_name(force, name)} is {' or '.join(ranges)}{unit}")
    return ", and ".join(words)


def plain_name(force: EquationForce, name: str) -> str:
    """A variable with its article, where it has one: the velocity of q."""
    words = force.variable_words(name)
    return f"the {words}" if " " in words else words


# ---- what to do next -----------------------------------------------------------------


def step_without_name(analysis: ForceAnalysis) -> Answer:
    """What to do about the surest missing force, for which there is no name."""
    force = analysis.force_in()
    if force.is_uncertain:
        return say(__package__, "unsure")
    if force.pace.is_vibration:
        return say(__package__, "shakes", n=force.pace.samples_per_cycle)
    return advice_of_cause(force)


def likely_cause(force: EquationForce) -> str:
    """What seems to be wrong: the begin of a sentence; "" if nothing stands out."""
    return advice_of_cause(force, "likely").lead


def advice_of_cause(force: EquationForce, name: str = "advice") -> Answer:
    """What follows from the strongest cause of a force, or from there being none.

    A cause counts unless it explains less than is left.
    """
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
        kind=kind_of(with_kinds_of_units(model, force.record.units), force.equation),
        law_of=_followed,
        plain=partial(plain_name, force),
    )


def _followed(force: EquationForce) -> list[str]:
    """What predicts a force best, if clearly; else all states that it may follow."""
    model = force.record.model
    best = leading(force.follows)
    if best is None or best["share"] < CLEAR_PATTERN:
        partners = exchange_partners(model, force.equation)
        return list(dict.fromkeys((*partners, force.equation)))
    state_of = dict(zip(model.efforts, model.states, strict=True))
    names = str(best["variable"]).split(", ")
    return list(dict.fromkeys(state_of.get(name, name) for name in names))
