"""How hard the re-fits of a diagnosis try, by their place in it.

All are counts: a loaded machine gives the same verdict.
"""

from dataclasses import replace

from phsi_opt.criteria import (
    AFTER_PATH_ITERATIONS,
    CORNER_ITERATIONS,
    REFIT_ITERATIONS,
    REFIT_TOLERANCE,
    THOROUGH_ITERATIONS,
)
from phsi_opt.optimization.settings import (
    EXACT,
    FEASIBLE_PATH,
    GAUSS_NEWTON,
    WAYS,
    SolverSettings,
)

# A smooth candidate.
BRIEF = SolverSettings(
    tolerance=REFIT_TOLERANCE,
    max_iterations=REFIT_ITERATIONS,
    thorough=False,
    ways=(GAUSS_NEWTON, EXACT),
)
# One with dry friction, or the one that screening likes best.
IN_EVERY_WAY = replace(BRIEF, ways=WAYS)
# The same from a fit whose free run leaves its states.
THOROUGH = replace(IN_EVERY_WAY, thorough=True)
# Beside a sharp corner.
ALONG_SOLUTIONS = replace(IN_EVERY_WAY, ways=(FEASIBLE_PATH,))
AT_CORNER = replace(
    IN_EVERY_WAY, max_iterations=CORNER_ITERATIONS, ways=(GAUSS_NEWTON, FEASIBLE_PATH)
)
# Beyond a base that was found beside a sharp corner: from where the path ended the
# exact Hessian converges in a few iterations or never, and Gauss-Newton's not at all.
BESIDE_SHARP = replace(
    IN_EVERY_WAY, max_iterations=AFTER_PATH_ITERATIONS, ways=(FEASIBLE_PATH, EXACT)
)
# What a study adds.
ADDED = SolverSettings(max_iterations=THOROUGH_ITERATIONS)
