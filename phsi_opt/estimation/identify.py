"""The verb: model and measurements in, `Fit` out.

How each loss is solved has its own file (`phsi_solve`, `maximum_likelihood`); here the
arguments are checked and put together, and a failure becomes an error.
"""

import time
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

from phsi_opt.arguments import typed
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError, SolveError
from phsi_opt.estimation.estimate import Estimate, Loss, Pruning, Task
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.likelihood_estimate import with_model_error
from phsi_opt.estimation.likelihood_problem import LikelihoodProblem
from phsi_opt.estimation.maximum_likelihood import by_likelihood
from phsi_opt.estimation.phsi_solve import by_defects
from phsi_opt.estimation.record import doubts_of
from phsi_opt.initialization.relative_guesses import check_rates, guessed_corners
from phsi_opt.interrupts import interruptible
from phsi_opt.later import Later
from phsi_opt.model.model import Model
from phsi_opt.model.structure import with_kinds_of_units
from phsi_opt.optimization.ipopt import SolverSettings
from phsi_opt.sweeps.sweep import Progress, silent
from phsi_opt.transcription.grid import AlignedData, checked_data
from phsi_opt.transcription.losses import MaximumLikelihood, PHSILoss, l1_weights


@typed
@interruptible
def identify(
    model: Model,
    data: Measurements | AlignedData,
    loss: Loss | None = None,
    l1: Mapping[str, float] | float | None = None,
    pruning: Pruning | None = None,
    *,
    start: Fit | None = None,
    settings: SolverSettings | None = None,
    raise_on_failure: bool = True,
    progress: Progress | None = None,
    executor: Executor | None = None,
) -> Fit:
    """Estimate the parameters of ``model`` from ``data``.

    For a model without free parameters only states and noise are estimated, by maximum
    likelihood (``names`` is empty, ``covariance`` is (0, 0)); the fit can be compared
    and diagnosed as usual.

    Args:
        model: the model, with its free parameters.
        data: measurements with the states and inputs of the model, or an `AlignedData`.
        loss: `PHSILoss` or `MaximumLikelihood` (default).
        l1: weight lambda of ``|coefficient|`` per slot, such as {"H": 0.1, "F": 0.01};
            a number stands for both.
        pruning: how terms are removed; None keeps them all.
        start: a fit of a similar model of the same measurements, to start from its
            states and values.
        settings: tolerance and limits of the solver.
        raise_on_failure: False returns the fit with an outcome that says what went
            wrong.
        progress: called with a line of text about the progress, such as ``print``.
        executor: solves from the points of ``MaximumLikelihood(starts=...)`` in
            parallel (see `sweep`); None: in this process, one after the other. The
            numbers are the same. It is not shut down.

    Returns:
        The estimates with standard errors (if available) and the outcome of the solver.

    Raises:
        DataError: if model and data do not match, or the executor is not valid.
        ModelError: for a model that cannot be solved.
        SolveError: if the solver fails.

    Examples:
        >>> fit = ph.identify(model.add("coulomb friction", "p"), train)
        >>> print(f"k = {fit.values['k']:.1f} +- {fit.std_errors['k']:.1f} N/m")
        k = 40.1 +- 0.2 N/m
    """
    loss = loss or MaximumLikelihood()
    if isinstance(loss, PHSILoss) and not model.free:
        raise ModelError(
            "the model has no free parameter, and the PHSI loss estimates nothing "
            "else; use compare or diagnose with the model, or MaximumLikelihood(), "
            "which estimates states and noise."
        )
    aligned = data if isinstance(data, AlignedData) else checked_data(model, data)
    model = with_kinds_of_units(model, aligned.data.units)
    own = aligned.for_model(model)
    if start is None:
        check_rates(model, own.grid)
    task = Task(
        model=model,
        aligned=own,
        l1=l1_weights(l1),
        pruning=pruning,
        settings=settings or SolverSettings(),
        say=progress or silent,
        executor=executor,
        corners=guessed_corners(model),
    )
    return fit_of_task(loss, task, start, raise_on_failure)


def fit_of_task(
    loss: Loss, task: Task, start: Fit | None, raise_on_failure: bool = True
) -> Fit:
    """The fit of a task, with what its free run lets doubt, once that is asked for.

    Raises:
        ModelError: L1 and a model error that cannot be combined.
        SolveError: if the solver fails.
    """
    began = time.perf_counter()
    estimate = estimate_by(loss, task, start)
    if raise_on_failure:
        _raise_failure(estimate)
    seconds = time.perf_counter() - began
    values = dict(zip(task.model.free, task.model.theta.tolist(), strict=True))
    values |= {} if start is None else start.start
    fit = replace(estimate.fit(), seconds=seconds, start=values, data=task.aligned.data)
    return replace(fit, doubts=Later(partial(doubts_of, fit, task.aligned)))


def estimate_by(loss: Loss, task: Task, start: Fit | None) -> Estimate:
    """The estimate by a loss, solved in the way of its kind.

    Raises:
        ModelError: L1 and a model error that cannot be combined.
    """
    if isinstance(loss, PHSILoss):
        return by_defects(task, loss, start)
    is_debiased = task.pruning is not None and task.pruning.debias
    if loss.model_error and any(task.l1.values()) and not is_debiased:
        raise ModelError(
            f"l1={dict(task.l1)!r} and model_error=True of MaximumLikelihood cannot "
            "be combined: the estimate with a model error has no L1 term; leave l1 "
            "out, or use it only to select terms, with pruning=Pruning()."
        )
    estimate = by_likelihood(LikelihoodProblem.of(task, loss), start)
    if not loss.model_error or not estimate.is_success:
        return estimate
    return with_model_error(estimate)


def _raise_failure(estimate: Estimate) -> None:
    if not estimate.is_success:
        raise SolveError(f"The solver failed: {estimate.solution.outcome}")


def fit_of(fit: Fit | Model, data: Measurements, verb: str) -> Fit:
    """The fit itself, or that of a model whose parameters are all known.

    Measurements tell the noise and the states of such a model. Messages name the
    ``verb``, such as "compare".

    Raises:
        DataError: a state or input of the model is not in the measurements.
        ModelError: it is neither, or the model has free parameters.
        SolveError: no states were found that obey the model.
    """
    if isinstance(fit, Fit):
        return fit
    if fit.free:
        raise ModelError(
            f"the model has free parameters ({', '.join(fit.free)}), so it must be "
            f"fitted first: {verb}(identify(model, data), data). If their values are "
            f"known, fix them: {verb}(model.frozen(), data)."
        )
    return identify(fit, data)
