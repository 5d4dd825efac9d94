"""Missing forces in tables and words, and what to do about those without a name.

Three answers tell a force: its size, where it acts and what it follows, and when. What
to do depends on its cause: one that shakes is sought at the machine, one that follows
an input where the input enters, one that follows nothing measured in a state or an
input that the model and the data lack.

Here are the facts; the sentences stand in ``words.jinja``.
"""

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from phsi_opt.arguments import require_known
from phsi_opt.criteria import CERTAIN_FORCE, CLEAR_PATTERN
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.dependence import leading
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.force_record import ForceRecord
from phsi_opt.model.structure import exchange_partners, kind_of, with_kinds_of_units
from phsi_opt.presentation.content import Answer
from phsi_opt.presentation.sentences import say
from phsi_opt.presentation.summary import printed_table
from phsi_opt.statistics import rms

if TYPE_CHECKING:
    import pandas as pd


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
        return list(map(force_words, self.strongest_first))


# ---- in words ------------------------------------------------------------------------


def _said(force: EquationForce, name: str, **more: Any) -> Answer:
    model = force.record.model
    effort = force.variable_words(model.efforts[force.row])
    facts: dict[str, Any] = {
        "force": force,
        "model": model,
        "units": defaultdict(str, force.record.units),
        "rate": force.equation_words,
        "labels": force.record.labels,
        "partners": exchange_partners(model, force.equation),
        "effort": f"the {effort}" if " " in effort else effort,
    }
    return say(__package__, name, **facts, **more)


def strength_words(force: EquationForce) -> str:
    """The size of a missing force, or that none is significant, in a sentence."""
    return _said(force, "strength").lead


def where_answer(force: EquationForce) -> Answer:
    """The equation of a force, what it follows, and where it is largest."""
    return _said(force, "where")


def when_answer(force: EquationForce) -> Answer:
    """When a force is there, in which runs, and when it is strongest."""
    if force.is_uncertain:
        return Answer("Never significant.")
    record = force.record
    runs = [np.flatnonzero(record.run == k) for k in range(len(record.along.runs))]
    clear = [inside for inside in runs if _is_clear(force, inside)] or runs
    return _said(
        force,
        "when",
        n_runs=len(runs),
        n_clear=len(clear),
        share=np.mean(force.is_sure[np.concatenate(clear)]),
        window=force.window_words(longest=float(record.t.max())),
        run=force.window.trajectory if len(runs) > 1 else "the training record",
    )


def _is_clear(force: EquationForce, inside: np.ndarray) -> bool:
    """Whether a part of the force exceeds its standard deviation."""
    typical = float(np.median(force.deviation[inside]))
    return rms(force.w[inside]) > CERTAIN_FORCE * typical


def force_words(force: EquationForce) -> str:
    """Size, place and time of a missing force; its size alone if not significant."""
    answers = () if force.is_uncertain else (where_answer(force), when_answer(force))
    return " ".join([strength_words(force), *map(str, answers)])


# ---- what to do next -----------------------------------------------------------------


def step_without_name(analysis: ForceAnalysis) -> Answer:
    """What to do about the surest missing force, for which there is no name."""
    force = analysis.force_in()
    if force.is_uncertain:
        return say(__package__, "unsure")
    if force.pace.is_vibration:
        return say(__package__, "shakes", n=force.pace.samples_per_cycle)
    return advice_of_cause(force)


def advice_of_cause(force: EquationForce) -> Answer:
    """What follows from the strongest cause of a force, or from there being none.

    A cause counts unless it explains less than is left.
    """
    shares = force.causes.shares
    case = max(shares, key=lambda cause: (shares[cause], cause != "unexplained"))
    model = with_kinds_of_units(force.record.model, force.record.units)
    kind = kind_of(model, force.equation)
    return _said(
        force,
        "advice",
        case=case,
        kind=kind,
        followed=_followed(force),
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
