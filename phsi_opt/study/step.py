"""One step of a study: a model, its fit, and how far its free runs are off."""

from dataclasses import dataclass

from phsi_opt.comparison.compare import Comparison
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a study.

    Attributes:
        label: what was done.
        added: the effects that the model has since beyond the base model.
        fit: of the model.
        train: its free run on the training record.
        held_out: its free run on data held out; None where there are none.
    """

    label: str
    added: tuple[Effect, ...]
    fit: Fit
    train: Comparison
    held_out: Comparison | None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.label!r})"

    @property
    def judged(self) -> Comparison:
        """The comparison that judges, on data held out or else the training record."""
        return self.held_out or self.train
