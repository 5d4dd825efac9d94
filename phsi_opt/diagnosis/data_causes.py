"""What in the data may explain a misfit, before an effect is named for it.

Two causes can be tested: samples that a sensor or a logger may have spoilt (those that
`Measurements.noticed` reports), and one run that differs from the others. The model is
fitted again without them. Where most of the misfit is then gone, they are its cause.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phsi_opt.comparison.compare import explained_share, is_small_as_noise
from phsi_opt.criteria import EXPLAINED_IF_NAMED, MOST_OF_IT, MOST_REFITTED
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.refit import DiagnosedModel
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.identify import identify
from phsi_opt.estimation.optimum_checks import HUBER
from phsi_opt.estimation.record import Record
from phsi_opt.transcription.grid import AlignedData, grid_of

FEWEST_RUNS = 3  # of two runs that differ the data do not say which one is wrong
CHECK_RUN = (
    "check its set-up, sensors and scales; if they are right, what is missing acts "
    "only there"
)
Change = Callable[[Measurements], Measurements]


@dataclass(frozen=True)
class DataCause:
    """Something in the data that explains most of a misfit."""

    words: str  # what it is, and how the error falls without it
    advice: str  # what to do about it

    def __str__(self) -> str:
        return f"{self.words}: {self.advice}"


def data_cause(base: DiagnosedModel, larger: DiagnosedModel) -> DataCause | None:
    """What in the data explains more of the misfit than what would be named for it.

    Args:
        base: the model that is diagnosed.
        larger: the one that would be named; the base itself where nothing would.

    Returns:
        The cause; None where the data are not the cause.
    """
    with suppress(PhsiOptError):
        if spoilt := _spoilt_samples(base, larger):
            return spoilt
        if not all(map(is_small_as_noise, larger.comparisons)):
            return _one_run(base, larger)
    return None


def _spoilt_samples(base: DiagnosedModel, larger: DiagnosedModel) -> DataCause | None:
    """Samples that a sensor or a logger may have spoilt."""
    words = list(base.record.data.look.spoilt_words)
    if base.is_held_out:
        words += map("held-out {}".format, base.judged.record.data.look.spoilt_words)
    if base.loss.huber is not None:
        words = [one for one in words if "outlier" not in one]  # they count little
    if not words:
        return None
    base.say("fitting again without the samples that may be spoilt")
    rest = _fitted_again(base, without_spoilt)
    rest = rest.with_fit(rest.fit)  # beside the noise of the samples that are left
    errors = zip(larger.comparisons, rest.comparisons, strict=True)
    if not any(new.rmse**2 < (1 - MOST_OF_IT) * old.rmse**2 for old, new in errors):
        return None
    advice = "check the sensor, or leave these samples out"
    if "outlier" in str(words):
        advice += f"; {HUBER}"
    noticed = f"{'; '.join(words)}; without these samples"
    return DataCause(f"{noticed} {base.change_words(rest)}", advice)


def without_spoilt(data: Measurements) -> Measurements:
    """The measurements with samples that may be spoilt counted as missing."""
    look = data.look
    spoilt = np.column_stack(list(map(look.spoilt, look.state_looks)))
    runs = []
    for number, run in enumerate(data.trajectories):
        is_spoilt = spoilt[look.run == number]
        runs.append(replace(run, x=np.where(is_spoilt, np.nan, run.x)))
    return replace(data, trajectories=tuple(runs))


def _one_run(base: DiagnosedModel, rival: DiagnosedModel) -> DataCause | None:
    """A training run without which nearly all of the misfit is gone.

    The error that judges must also fall by no less than with the ``rival``, the model
    with the effect that would be named.
    """
    least = max(base.share_explained(rival), 0.0)
    # The farthest off first: a fit of all runs spreads the misfit of one.
    runs = base.record.data.trajectories
    if len(runs) < FEWEST_RUNS:
        return None
    farthest = np.argsort(-base.trained.run_errors)[:MOST_REFITTED]
    for run in (runs[k] for k in farthest):
        base.say(f"fitting again without {run.title}")
        with suppress(PhsiOptError):
            rest = _fitted_again(base, partial(_without_run, run.name))
            share = explained_share(base.trained, rest.trained)
            is_gone = is_small_as_noise(rest.trained) or share > EXPLAINED_IF_NAMED
            if is_gone and not base.share_explained(rest) < least:
                fall = f"without it {base.change_words(rest)}"
                return DataCause(
                    f"{run.title} differs from the others; {fall}", CHECK_RUN
                )
    return None


def _without_run(name: str, data: Measurements) -> Measurements:
    runs = tuple(run for run in data.trajectories if run.name != name)
    return replace(data, trajectories=runs)


def _fitted_again(base: DiagnosedModel, change: Change) -> DiagnosedModel:
    """The model fitted to changed data, beside the noise of the base.

    Raises:
        PhsiOptError: it could not be fitted.
    """

    def changed(record: Record) -> AlignedData:
        data = change(record.data)
        return AlignedData(data, grid_of(data), record.aligned.notes)

    training = changed(base.record)
    kept = [run.name for run in training.data.trajectories]
    numbers = list(map(base.record.runs.index, kept))
    start = replace(
        base.fit,
        states=tuple(base.fit.states[k] for k in numbers if base.fit.states),
        steps=tuple(base.fit.steps[k] for k in numbers if base.fit.steps),
    )
    fit = identify(base.fit.model, training, base.loss, start=start)
    return base.on(lambda record: Record(fit, changed(record), record.estimate))
