"""The law of an effect that was added: what the present model lacks without it.

A base model that was fitted without the effect imitates it: its damping stands in for a
friction, and the missing force is the difference. Here the values are those of the
present model, so that the whole effect is missing, and a step is seen as a step.
"""

from dataclasses import dataclass

from phsi_opt.errors import ModelError
from phsi_opt.estimation.identify import identify_aligned
from phsi_opt.estimation.record import Record
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.equation_force import EquationForce
from phsi_opt.force_analysis.state_plots import Dependence
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.transcription.alignment import AlignedData
from phsi_opt.transcription.losses import MaximumLikelihood

SENSOR_SLOT = "sensor"
LOSS_SLOT = "R"


@dataclass(frozen=True, eq=False)
class EffectLaw:
    """The force that is missing where an effect is left out.

    Attributes:
        effect: that was left out.
        force: the missing force of its equation.
        variable: that it is shown against: the effort for a loss, else what predicts
            it best.
    """

    effect: Effect
    force: EquationForce
    variable: str

    @property
    def dependence(self) -> Dependence:
        """The force beside the variable."""
        return Dependence.of(self.force, self.variable)

    @property
    def title(self) -> str:
        """What is drawn, in a sentence."""
        return f"Force that is missing without {self.effect}"


def effect_law(
    base: Model,
    present: Model,
    added: tuple[Effect, ...],
    effect: Effect,
    data: AlignedData,
) -> EffectLaw:
    """The law of one of the effects added, with the present values of all others.

    Args:
        base: the model that effects were added to.
        present: the model with all of them, with its values.
        added: all effects.
        effect: the one to leave out.
        data: the training record.

    Raises:
        ModelError: the effect is one of a sensor, or its equation can lack no force.
        SolveError: no states were found that obey the smaller model.
    """
    if effect.slot == SENSOR_SLOT:
        raise ModelError(f"{effect} acts in a sensor; no force is missing without it.")
    model = base
    for other in added:
        if other is not effect:
            model = model.add(other)
    known = {}
    for name, value in present.values.items():
        if name in model.entries:
            known[name] = value
    frozen = model.with_values(known).frozen()
    fit = identify_aligned(frozen, data, MaximumLikelihood())
    analysis = ForceAnalysis.of(Record.of_aligned(fit, data))
    force = analysis.force_in(effect.equation)
    if effect.slot == LOSS_SLOT:
        variable = model.efforts[model.states.index(effect.equation)]
        return EffectLaw(effect, force, variable)
    return EffectLaw(effect, force, force.single_variable)
