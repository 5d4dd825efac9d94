"""TODO."""

from dataclasses import dataclass

from phsi_opt.comparison.compare import Comparison
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.effect import Effect


@dataclass(frozen=True, eq=False)
class Proposal:
    """One effect, or two together, with what is left when they are added; ``words`` on
    the first one's size.
    """

    effects: tuple[Effect, ...]
    fit: Fit
    trained: Comparison
    comparison: Comparison
    words: str = ""
