"""What a baseline returns: the record of every method, with its loss and history."""

from dataclasses import dataclass, field

import pandas as pd

from phsi_opt.estimation.identified import Identified


@dataclass(frozen=True, eq=False, kw_only=True)
class Baseline(Identified):
    """A model found by another method, with everything that `Identified` can do.

    Attributes:
        method: name of the method, such as "gradient descent".
        loss_value: the method's own loss over all its data at the result, without its
            penalties; NaN if it has none.
        history: a row per epoch with at least epoch, loss and n_terms; empty for a
            method without epochs.
        settings: the settings that were used, as text.
    """

    method: str
    loss_value: float = float("nan")
    history: pd.DataFrame = field(default_factory=pd.DataFrame)
    settings: str = ""

    def __str__(self) -> str:
        head = f"{self.method}: loss {self.loss_value:.6g}, {self.seconds:.3g} s"
        lines = [head, *self.equations()]
        if self.removed:
            lines.append(f"removed: {', '.join(self.removed)}")
        return "\n".join(lines)
