"""How far a model is off, how sure a verdict is, and what the data leave open."""

import numpy as np
import pandas as pd

from phsi_opt.comparison.compare import Comparison
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.force_analysis.next_step import likely_cause
from phsi_opt.force_analysis.units import spaced
from phsi_opt.presentation.numbers import listed, number
from phsi_opt.statistics import TINY

ONE_ERROR = "\N{PLUS-MINUS SIGN} is one standard error."
# Times the noise floor from which an error alone says that something is missing.
SURE_ERROR = 1.5
AT_NOISE = 1.05  # times the noise floor up to which an error is that of the noise
FAST_DISTURBANCE = "fast disturbance"
MOST_CHANNELS = 3  # that are told, the worst first
# Errors over the noise floor: of training data that are fitted to the noise, and of
# data held out that are not foretold.
NEAR_FLOOR = 1.1
FAR_ABOVE_FLOOR = 2.0
PERCENT = 100.0  # of a whole


def certainty_words(diagnosis: Diagnosis) -> str:
    """Whether something is missing, how far the error is off, whether why is known."""
    ratio = _times_noise(diagnosis)
    error = f"the error is {number(ratio, 2)} times the noise"
    if ratio < AT_NOISE:
        error = "the error is that of the noise"
    if diagnosis.verdict == Verdict.NOTHING_MISSING:
        return f"Nothing is seen to be missing: {error}. {ONE_ERROR}"
    if ratio > SURE_ERROR or diagnosis.findings:  # these are established
        sure = f"Certain that something is missing: {error}."
    elif ratio < AT_NOISE:
        sure = f"{no_noise_words(diagnosis)}."
    else:
        sure = f"{no_noise_words(diagnosis)}: {error}."
    return " ".join(filter(None, (sure, _cause(diagnosis), ONE_ERROR)))


def evidence_words(candidate: Candidate) -> str:
    """How clearly an effect is there, such as "decisive, log evidence 95"."""
    if not candidate.was_weighed:
        return "not weighed"
    return f"{candidate.grade}, log evidence {number(candidate.log_evidence, 2)}"


def no_noise_words(diagnosis: Diagnosis) -> str:
    """That something is left beside noise: a larger error, or a pattern as small."""
    if _times_noise(diagnosis) < AT_NOISE:
        return "The residuals are as small as noise, but not as random"
    return "The residuals are no noise"


def _times_noise(diagnosis: Diagnosis) -> float:
    """The error of the free run over that of noise alone."""
    return diagnosis.base.rmse / diagnosis.base.noise_floor


def _cause(diagnosis: Diagnosis) -> str:
    """How clear the cause is, or what is still open about it, in a sentence."""
    if diagnosis.findings:
        first = diagnosis.ranking[0]
        size = number(first.log_evidence, 2)
        said = f"The evidence for {first.name} is {first.grade} (log evidence {size})."
        is_class = any(not finding.is_name for finding in diagnosis.findings)
        open_ = "Which of the class it is, the data do not tell." if is_class else ""
        return f"{said} {open_}".strip()
    if disturbance_word(diagnosis):
        return "It is a fast disturbance; its source is not found yet."
    force = diagnosis.analysis.force_in()
    if not force.is_uncertain and likely_cause(diagnosis.record.data.units, force):
        return "The cause is suspected, not proven."
    return "The cause is not known."


def undetermined_words(parameters: pd.DataFrame) -> str:
    """The parameters whose standard error exceeds their value; "" for none.

    Args:
        parameters: of a fit: name, value, std_error.
    """
    value = parameters["value"].to_numpy(dtype=float)
    error = parameters["std_error"].to_numpy(dtype=float)
    is_open = np.isfinite(error) & (error > np.abs(value))
    names = [str(name) for name in parameters["name"][is_open]]
    if not names:
        return ""
    return (
        f"Parameters that these data do not determine: {listed(names)} "
        "(standard error above the value); do not rely on them."
    )


def disturbance_word(diagnosis: Diagnosis) -> str:
    """What stands beside a verdict whose force shakes; "" for others."""
    force = diagnosis.analysis.force_in()
    is_open = not diagnosis.findings and not force.is_uncertain
    is_missing = diagnosis.verdict != Verdict.NOTHING_MISSING
    is_fast = is_missing and is_open and force.pace.is_vibration
    return FAST_DISTURBANCE if is_fast else ""


def off_words(judged: Comparison) -> list[str]:
    """Such as "q by 0.122 rad (6.7 % of its movement; noise alone 0.1 %)".

    Each of the channels that are farthest off, the worst first.
    """
    table = judged.table
    shares = PERCENT - table["fit_percent"].to_numpy(dtype=float)
    worst = np.argsort(-np.nan_to_num(shares), kind="stable")[:MOST_CHANNELS]
    return [_channel_words(table.iloc[k]) for k in worst.tolist()]


def _channel_words(row: pd.Series) -> str:
    rmse = float(row["rmse"])
    share = PERCENT - float(row["fit_percent"])
    noise = share * float(row["noise_floor"]) / max(rmse, TINY)
    size = f"{number(rmse, 3)}{spaced(str(row['unit']))}"
    beside = f"{number(share, 2)} % of its movement"
    if share >= PERCENT:
        beside = f"{number(share, 3)} % of its movement: a constant would do better"
    return f"{row['state']} by {size} ({beside}; noise alone {number(noise, 2)} %)"


def only_follows(trained: Comparison, judged: Comparison) -> bool:
    """Whether a model fits its training data to the noise, and no other data."""
    floor = judged.noise_floor
    is_fitted = trained.rmse < NEAR_FLOOR * floor
    return is_fitted and judged.rmse > FAR_ABOVE_FLOOR * floor


def judged_words(is_held_out: bool) -> str:
    """On which data an error is."""
    return "data not used for fitting" if is_held_out else "the training data"
