"""Effects in a list that prints as a table."""

from phsi_opt.model.effect import Effect
from phsi_opt.presentation.summary import (
    Part,
    Summarised,
    Summary,
    text_of_summary,
)
from phsi_opt.presentation.table_making import printed_table

COLUMNS_OF_EFFECTS = ("effect", "equation", "slot", "family")


class EffectList(list[Effect], Summarised):
    """Effects; in all but how it prints a list."""

    def _summary(self) -> Summary:
        rows = []
        for effect in self:
            rows.append((effect.name, effect.equation, effect.slot, effect.family))
        table = printed_table(rows, columns=list(COLUMNS_OF_EFFECTS))
        noun = "effect" if len(self) == 1 else "effects"
        return Summary(f"{len(self)} {noun}", (Part(table=table),))

    def __repr__(self) -> str:
        return text_of_summary(self._summary())

    __str__ = __repr__
