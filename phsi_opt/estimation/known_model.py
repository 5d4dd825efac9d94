"""A model whose values are all known, beside measurements: its fit has no estimates.

Such a model is compared and diagnosed like a fitted one. What measurements tell of it
is the noise and the states; `identify` finds them by maximum likelihood.
"""

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.model.model import Model


def fit_of(fit: Fit | Model, data: Measurements, verb: str) -> Fit:
    """The fit itself, or that of a model without free parameters.

    Args:
        fit: a fit, or a model whose parameters are all known.
        data: measurements of the model's states and inputs.
        verb: what the fit is for, such as "compare"; it stands in the messages.

    Raises:
        DataError: a state or input of the model is not in the measurements.
        ModelError: it is neither, or the model has free parameters.
        SolveError: no states were found that obey the model.
    """
    if isinstance(fit, Fit):
        return fit
    if not isinstance(fit, Model):
        raise ModelError(
            f"{verb} got a {type(fit).__name__}; expected a Fit, as identify returns, "
            "or a Model whose parameters are all known."
        )
    if fit.free:
        raise ModelError(
            f"the model has free parameters ({', '.join(fit.free)}), so it must be "
            f"fitted first: {verb}(identify(model, data), data). Where their values "
            f"are known, fix them: {verb}(model.frozen(), data)."
        )
    return identify(fit, data)
