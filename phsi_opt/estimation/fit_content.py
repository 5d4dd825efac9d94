"""A fit as numbers, text, lists and mappings, for files; and the parts of such content.

The estimated states are left out: they are as long as the record, and a fit is used
without them.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from phsi_opt.data.checks import checked_hold
from phsi_opt.errors import DataError, did_you_mean
from phsi_opt.estimation.fit_record import FitRecord
from phsi_opt.estimation.fit_uncertainty import FitUncertainty
from phsi_opt.estimation.model_content import Content, model_content, model_from
from phsi_opt.estimation.model_error_table import ModelErrorRow
from phsi_opt.later import Later
from phsi_opt.model_error.standard_errors import Source
from phsi_opt.optimization.outcome import Outcome
from phsi_opt.transcription.parameter_vector import Theta

FORMAT = "phsi_opt fit 1"


def fit_content(fit: FitRecord) -> Content:
    """The content of a fit, in the format `FORMAT`."""
    return {
        "format": FORMAT,
        "model": model_content(fit.model),
        "names": list(fit.names),
        "by_trajectory": {run: dict(own) for run, own in fit.by_trajectory.items()},
        "loss": fit.loss,
        "loss_value": fit.loss_value,
        "covariance": fit.covariance.tolist(),
        "std_error_source": str(fit.std_error_source),
        "covariances": _covariances_content(fit.covariances),
        "freedom": None if fit.freedom is None else fit.freedom.tolist(),
        "model_error": [vars(row) for row in fit.model_error_rows],
        "has_model_error": fit.has_model_error,
        "noise": dict(fit.noise),
        "outcome": _outcome_content(fit.outcome),
        "n_values": fit.n_values,
        "bic": fit.bic,
        "log_evidence": fit.log_evidence,
        "hold": fit.hold,
        "huber": fit.huber,
        "steps": [_steps_content(steps) for steps in fit.steps],
        "n_gaps": [len(steps) for steps in fit.steps],
        "seconds": fit.seconds,
        "units": dict(fit.units),
        "removed": list(fit.removed),
        "warnings": list(fit.warnings),
        "provenance": dict(fit.provenance),
    }


def _covariances_content(covariances: Mapping[Source, np.ndarray]) -> Content:
    return {str(source): matrix.tolist() for source, matrix in covariances.items()}


def _outcome_content(outcome: Outcome) -> Content:
    return {**vars(outcome), "at_bounds": list(outcome.at_bounds)}


def _steps_content(steps: np.ndarray) -> int | list[int]:
    """One number where all gaps of a trajectory have as many steps, else a list."""
    if len(steps) and np.all(steps == steps[0]):
        return int(steps[0])
    per_gap: list[int] = steps.tolist()
    return per_gap


def fit_parts(content: Content) -> dict[str, Any]:
    """What a fit is made of, by the names of its fields, from its content.

    Raises:
        DataError: ``hold`` is unknown, or numbers do not belong to the model, or are
            none that a fit can have.
        ModelError: The model in the content is not valid.
        LookupError, TypeError, ValueError, AttributeError: The content is damaged.
    """
    model = model_from(content["model"])
    names = _texts(content.get("names", model.free))
    by_trajectory = _by_trajectory_from(content.get("by_trajectory", {}))
    _check_names(names, Theta.of(model, tuple(by_trajectory) or ("",)).names)
    covariance = np.array(content["covariance"], dtype=float)
    noise = _numbers(content["noise"])
    _check_names(noise, model.states)
    freedom = _freedom_from(content.get("freedom"))
    for what, numbers in (
        ("the variances of the estimates", np.diag(covariance)),
        ("noise", np.array(list(noise.values()))),
        ("degrees of freedom", np.zeros(0) if freedom is None else freedom),
        ("n_values", np.array([content["n_values"]])),
    ):
        if np.any(numbers < 0):
            raise DataError(f"{what}: {numbers.tolist()}; none can be negative")
    if freedom is not None and freedom.shape != (len(names),):
        raise DataError(f"{freedom.size} degrees of freedom for {len(names)} estimates")
    uncertainty = FitUncertainty(
        covariance=covariance.reshape(len(names), len(names)),
        source=_source_from(content),
        covariances=_covariances_from(content.get("covariances", {}), len(names)),
        freedom=freedom,
        model_error_rows=_model_error_from(content.get("model_error", [])),
        log_evidence=float(content.get("log_evidence", np.nan)),
        warnings=_texts(content["warnings"]),
    )
    return {
        "model": model,
        "names": names,
        "by_trajectory": by_trajectory,
        "loss": str(content["loss"]),
        "loss_value": float(content["loss_value"]),
        "uncertainty": Later.known(uncertainty),
        "has_model_error": bool(content.get("has_model_error", False)),
        "noise": noise,
        "outcome": _outcome_from(content["outcome"]),
        "n_values": int(content["n_values"]),
        "bic": float(content["bic"]),
        "hold": checked_hold(content["hold"], model.inputs),
        "huber": _huber_from(content.get("huber")),
        "steps": _steps_from(content.get("steps", []), content.get("n_gaps", [])),
        "seconds": float(content.get("seconds", np.nan)),
        "units": {str(name): str(unit) for name, unit in content["units"].items()},
        "removed": _texts(content["removed"]),
        "provenance": dict(content["provenance"]),
    }


def _check_names(names: Iterable[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise DataError(f"{name!r} is not in the model{did_you_mean(name, known)}")


def _texts(content: Sequence[Any]) -> tuple[str, ...]:
    return tuple(str(text) for text in content)


def _numbers(content: Content) -> dict[str, float]:
    return {str(name): float(value) for name, value in content.items()}


def _source_from(content: Content) -> Source:
    """Files of before hold standard errors from white noise alone."""
    return Source(content.get("std_error_source", Source.NOISE))


def _covariances_from(content: Content, n: int) -> dict[Source, np.ndarray]:
    covariances = {}
    for source, matrix in content.items():
        covariance = np.array(matrix, dtype=float).reshape(n, n)
        covariances[Source(source)] = covariance
    return covariances


def _freedom_from(content: Sequence[float] | None) -> np.ndarray | None:
    return None if content is None else np.array(content, dtype=float)


def _model_error_from(content: Sequence[Content]) -> tuple[ModelErrorRow, ...]:
    rows = []
    for row in content:
        rows.append(
            ModelErrorRow(
                where=str(row["where"]),
                kind=str(row["kind"]),
                size=float(row["size"]),
                time=float(row["time"]),
                unit=str(row["unit"]),
                share=float(row["share"]),
            )
        )
    return tuple(rows)


def _by_trajectory_from(content: Content) -> dict[str, dict[str, float]]:
    return {str(run): _numbers(values) for run, values in content.items()}


def _huber_from(huber: Any) -> float | None:
    return None if huber is None else float(huber)


def _steps_from(
    per_trajectory: Sequence[Any], n_gaps: Sequence[int]
) -> tuple[np.ndarray, ...]:
    steps = []
    for number_or_list, n in zip(per_trajectory, n_gaps, strict=True):
        per_gap = np.array(number_or_list, dtype=int)
        steps.append(np.broadcast_to(per_gap, n).copy())
    return tuple(steps)


def _outcome_from(content: Content) -> Outcome:
    return Outcome(
        success=bool(content["success"]),
        status=str(content["status"]),
        sentence=str(content["sentence"]),
        advice=str(content["advice"]),
        iterations=int(content["iterations"]),
        seconds=float(content["seconds"]),
        objective=float(content["objective"]),
        infeasibility=float(content["infeasibility"]),
        at_bounds=_texts(content["at_bounds"]),
    )
