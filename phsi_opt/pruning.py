"""Which terms go: thresholded re-solves until the support stops changing."""

from dataclasses import dataclass

from phsi_opt.errors import ModelError
from phsi_opt.model import Model


@dataclass(frozen=True)
class Pruning:
    """Remove terms with |coefficient| < ``threshold`` and solve again, until none is left to remove.

    Acts in ``slots`` (damping stays by default: a small damping is still one). ``debias`` solves the last time without
    L1, which shrinks every coefficient that it keeps.
    """

    threshold: float = 0.05
    slots: tuple[str, ...] = ("H", "F")
    debias: bool = True
    max_rounds: int = 50

    def __post_init__(self) -> None:
        if not self.threshold >= 0:
            raise ModelError(f"threshold={self.threshold!r} of Pruning must be a number of at least 0.")
        for slot in self.slots:
            if slot not in ("H", "R", "F"):
                raise ModelError(f"slot {slot!r} of Pruning is unknown; expected 'H', 'R' or 'F'.")

    def small(self, model: Model, values: dict[str, float]) -> set[str]:
        """Names of the coefficients to remove."""
        return {
            name
            for name, entry in model.entries.items()
            if entry.prunable
            and not entry.parameter.fixed
            and entry.slot in self.slots
            and abs(values[name]) < self.threshold
        }
