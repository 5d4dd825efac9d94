"""Values of a fit's free parameters in each trajectory of a record.

Parameters `per_trajectory` have a value of their own in every trajectory that the fit
has seen. Simulations and defects along a record need one value of every parameter in
every trajectory, also in those that the fit has not seen.
"""

from collections.abc import Mapping

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.estimation.fit_record import FitRecord
from phsi_opt.model.model import Model


def parameters_of(fit: FitRecord, data: Measurements) -> dict[str, dict[str, float]]:
    """Values of the free parameters by name, for every trajectory by name.

    Args:
        fit: The fit.
        data: The record; its trajectories are known to the fit by their names.

    Returns:
        One new mapping per trajectory. A trajectory that the fit has not seen gets the
        means of the fit.
    """
    values = fit.values
    means = {name: values[name] for name in fit.model.free}
    per_trajectory = {}
    for trajectory in data.trajectories:
        own_values = fit.by_trajectory.get(trajectory.name, {})
        per_trajectory[trajectory.name] = {**means, **own_values}
    return per_trajectory


def parameter_matrix(
    model: Model, per_trajectory: Mapping[str, Mapping[str, float]]
) -> np.ndarray:
    """Free parameters as columns, (n_free, n_trajectories).

    Args:
        model: Its ``free`` names are the order of the rows.
        per_trajectory: Values by name for every trajectory, as from `parameters_of`;
            their order is that of the columns.
    """
    matrix = np.empty((len(model.free), len(per_trajectory)))
    for column, values in enumerate(per_trajectory.values()):
        matrix[:, column] = [values[name] for name in model.free]
    return matrix
