"""What a fit says of quantised sensors: where their steps, not its residuals, count.

Quantisation is like noise, uniform and new in every sample, where a signal crosses
several steps (Widrow 1956). Where it stays within one, the errors follow the motion.
"""

import numpy as np

from phsi_opt.data.resolution import DEVIATION_PER_STEP, unresolved_channels
from phsi_opt.estimation.likelihood_estimate import LikelihoodEstimate
from phsi_opt.estimation.likelihood_problem import NoiseLevels

# Share of the least noise within which the estimate counts as held up by it.
AT_LEAST_NOISE = 1e-9


def resolution_notes(
    estimate: LikelihoodEstimate, noise: NoiseLevels
) -> tuple[str, ...]:
    """Sentences on channels whose quantisation sets the noise, or hides the motion.

    Args:
        estimate: with its noise.
        noise: what was known of it before; of a declared one nothing is said.
    """
    units = estimate.task.data.units
    unresolved = unresolved_channels(estimate.task.data)
    notes = []
    for k in np.flatnonzero(~noise.is_known & (noise.least > 0)).tolist():
        name = estimate.model.states[k]
        unit = units.get(name, "")
        least = noise.least[k]
        step = least / DEVIATION_PER_STEP
        if estimate.sigma[k] <= (1 + AT_LEAST_NOISE) * least:
            notes.append(
                f"the values of {name} are quantised in steps of "
                f"{_with_unit(f'{step:.3g}', unit)}: at least "
                f"{_with_unit(f'{least:.2g}', unit)} counts as noise"
            )
        if name in unresolved:
            notes.append(
                f"{name} moves by less than one of its steps of "
                f"{_with_unit(f'{step:.3g}', unit)} (standard deviation): the errors "
                "of its values follow the motion, so standard errors are too small and "
                "a diagnosis names nothing"
            )
    return tuple(notes)


def _with_unit(number: str, unit: str) -> str:
    return f"{number} {unit}".rstrip()
