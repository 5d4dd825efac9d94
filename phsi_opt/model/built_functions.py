"""What was built of the formulas of models, kept for the next model that has the same.

Models are records that come and go: a fit makes dozens with other values, a study
hundreds. Building CasADi functions takes longer than evaluating them, and what a
function computes follows from its formulas alone, so it does not matter who built it.
Nothing here is written to a file.
"""

from collections.abc import Hashable
from functools import lru_cache

# Different formulas that are remembered, those last asked for; a model keeps its own as
# long as it lives.
MOST_FORMULAS = 64


@lru_cache(MOST_FORMULAS)
def built_of(formulas: Hashable) -> dict[Hashable, object]:
    """What was built of the same formulas, by name; empty at first."""
    return {}
