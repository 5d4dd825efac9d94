"""How hard the re-fits of a diagnosis try, by their place in it.

All are counts: a loaded machine gives the same verdict.
"""

from dataclasses import replace

from phsi_opt.criteria import REFIT_ITERATIONS, REFIT_TOLERANCE, THOROUGH_ITERATIONS
from phsi_opt.optimization.ipopt import SolverSettings

BRIEF = SolverSettings(
    tolerance=REFIT_TOLERANCE, max_iterations=REFIT_ITERATIONS, thorough=False
)
# The same from a fit whose free run leaves its states.
THOROUGH = replace(BRIEF, thorough=True)
# What a study adds.
ADDED = SolverSettings(max_iterations=THOROUGH_ITERATIONS)
