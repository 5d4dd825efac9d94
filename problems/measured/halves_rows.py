"""Estimates of the two halves of a record beside each other.

What is counted and how distances are made; `halves` says what for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.measured.halving import Halves, halved
from problems.measured.machines import Case

AT_BOUND = "at a bound"
NO_ERROR = "no standard error"


@dataclass(frozen=True)
class Estimate:
    """A number from one half.

    Attributes:
        value: The estimate.
        std_error: As the fit gives it.
        white: As if the residuals were independent.
        degrees: Of freedom of Student's distribution in the fit's intervals.
    """

    value: float
    std_error: float
    white: float
    degrees: float


@dataclass(frozen=True)
class Row:
    """A parameter in the two halves of a record."""

    set: str
    cut: str
    n_first: int
    n_second: int
    parameter: str
    first: float
    second: float
    std_error_first: float
    std_error_second: float
    degrees_first: float
    degrees_second: float
    z: float
    z_white: float
    left_out: str


@dataclass(frozen=True)
class Run:
    """A case cut in one way: its rows, what it took, what failed."""

    set: str
    cut: str
    rows: tuple[Row, ...]
    seconds: tuple[float, ...]
    failure: str = ""


# --- the one place where distances are made


def distance(first: Estimate, second: Estimate) -> float:
    """By how many standard errors two independent estimates differ.

    To be compared with a normal distribution. The fits have hundreds of degrees of
    freedom, where Student's distribution is the normal one.
    """
    return (first.value - second.value) / np.hypot(first.std_error, second.std_error)


def white_distance(first: Estimate, second: Estimate) -> float:
    """The same by the standard errors that take residuals as independent."""
    return (first.value - second.value) / np.hypot(first.white, second.white)


def estimate_of(fit: ph.Fit, name: str) -> Estimate:
    """A parameter of a fit with its standard errors."""
    std_error = fit.std_errors[name]
    return Estimate(
        fit.values[name],
        std_error,
        _white_error(fit, name),
        _freedom(fit, name),
    )


def _freedom(fit: ph.Fit, name: str) -> float:
    """Degrees of freedom of its variance."""
    return float(fit.standard_errors["freedom"][name])


def _white_error(fit: ph.Fit, name: str) -> float:
    """As if residuals were independent."""
    return float(fit.standard_errors["white noise"][name])


# --- fits of halves


def measured_halves(name: str, case: Case, cut: str) -> Run:
    """Both halves of a record fitted, and every free parameter compared."""
    halves = halved(case.load(case.path), case.window, cut, case.is_windowed)
    seconds: list[float] = []
    fits = []
    for half in (halves.first, halves.second):
        try:
            fit = ph.identify(case.model(), half)
        except ph.PhsiOptError as error:
            return Run(name, cut, (), tuple(seconds), str(error))
        fits.append(fit)
        seconds.append(fit.seconds)
    rows = [_row(name, cut, halves, fits, known) for known in fits[0].names]
    return Run(name, cut, tuple(rows), tuple(seconds))


def _row(
    name: str, cut: str, halves: Halves, fits: Sequence[ph.Fit], parameter: str
) -> Row:
    """One parameter of the two fits."""
    first = estimate_of(fits[0], parameter)
    second = estimate_of(fits[1], parameter)
    return Row(
        name,
        cut,
        len(halves.first),
        len(halves.second),
        parameter,
        first.value,
        second.value,
        first.std_error,
        second.std_error,
        first.degrees,
        second.degrees,
        distance(first, second),
        white_distance(first, second),
        _left_out(fits, parameter),
    )


def _left_out(fits: Sequence[ph.Fit], parameter: str) -> str:
    """Why a parameter cannot be compared; empty where it can."""
    for fit in fits:
        if parameter in fit.outcome.at_bounds:
            return AT_BOUND
    for fit in fits:
        if np.isnan(fit.std_errors[parameter]):
            return NO_ERROR
    return ""


def root_mean_square(z: np.ndarray | pd.Series) -> float:
    """NaN where there is none."""
    return float(np.sqrt(np.mean(np.square(z)))) if len(z) else np.nan
