"""What the parts of the battery hand to each other, and how motions are integrated.

Truth is simulated here by SciPy, from formulas of its own, never by the package.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from scipy.integrate import solve_ivp

import phsi_opt as ph

Array = np.ndarray
HIDDEN, FIELD = "hidden_effects", "field_machines"  # the two tables of machines
RTOL = 1e-8
ESCAPED = 1e6  # times what a motion begins with: the machine runs away


class RunawayError(ArithmeticError):
    """The machine leaves every bound, as beyond the top of a softening spring: no
    experiment to learn from.
    """


@dataclass(frozen=True)
class Truth:
    """A hidden effect as the catalogue calls it.

    Attributes:
        names: All that are the same term in the equation.
        equations: Those that are right; "" where the name tells between which states.
        coefficient: The catalogue's; NaN where it counts something else.
    """

    names: tuple[str, ...]
    equations: tuple[str, ...]
    coefficient: float = np.nan

    @property
    def effect(self) -> str:
        """Its first name."""
        return self.names[0]

    @property
    def places(self) -> set[str]:
        """The names that are right, as a diagnosis prints them."""
        every = product(self.names, self.equations)
        return {f"{name} on {at}" if at else name for name, at in every}


@dataclass(frozen=True, eq=False)
class Case:
    """What a row and a seed give: the model that lacks the truths, and measurements.

    Attributes:
        truths: None where nothing is to be named.
        hidden: What was hidden, in words.
        noise: Relative to each channel.
        ratio: Free-run error of the best re-fit without the effect, over the noise.
        size: Of the effect, where the truths' coefficients are those of size one.
        clean: The training runs without noise, weighed by their true noise.
        sigma: The standard deviation of the noise by state.
        test_noise: What was added to the held-out runs.
        has_function: Whether a function of the states acts beside model and truths.
    """

    model: ph.Model
    train: ph.Measurements
    test: ph.Measurements
    truths: tuple[Truth, ...]
    hidden: str
    noise: float
    ratio: float = np.nan
    size: float = 1.0
    clean: ph.Measurements | None = None
    sigma: Array = field(default_factory=lambda: np.zeros(0))
    test_noise: Array = field(default_factory=lambda: np.zeros(0))
    has_function: bool = False

    @property
    def places(self) -> set[str]:
        """All names that are right, as a diagnosis prints them."""
        return set().union(*(truth.places for truth in self.truths))

    @property
    def listed(self) -> set[str]:
        """Those of the right names that the catalogue of the model has."""
        return self.places & {str(effect) for effect in ph.catalogue(self.model)}


def log_uniform(
    rng: np.random.Generator, low: float, high: float, size: int | None = None
) -> Array:
    """Numbers whose logarithm is uniform."""
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


def lasting(white: Array, memory: float, axis: int = 0) -> Array:
    """White noise as one of the same size that keeps a share from sample to sample."""
    found = np.moveaxis(white.copy(), axis, 0)
    fresh = np.sqrt(1 - memory**2)
    for k in range(1, len(found)):
        found[k] = memory * found[k - 1] + fresh * found[k]
    return np.moveaxis(found, 0, axis)


def measurements(
    times: Sequence[Array],
    states: Sequence[Array],
    inputs: Sequence[Array] | None,
    names: tuple[Sequence[str], Sequence[str]],
    seen: Sequence[int],
    runs: Sequence[int],
    hold: str = "linear",
    noise: dict[str, float] | None = None,
) -> ph.Measurements:
    """Runs of which the states ``seen`` are measured; ``names``: of states, inputs."""
    state_names, input_names = names
    measured = [
        np.where(np.isin(np.arange(x.shape[1]), seen), x, np.nan) for x in states
    ]
    return ph.Measurements.from_arrays(
        list(times),
        measured,
        inputs,
        states=state_names,
        inputs=list(input_names) or None,
        hold=hold,
        noise=noise,
        names=[f"run {run + 1}" for run in runs],
    )


# --- integration

Rates = Callable[..., Array]


def integrated(
    rates: Rates,
    x0: Array,
    times: Array,
    max_step: float,
    *arguments: Array,
    is_bounded: bool = True,
) -> Array:
    """Flat states (n_times, n) by LSODA; no kink or step of an input is passed over.

    ``is_bounded``: it ends where a state is `ESCAPED` times what it begins with.
    """

    def escaped(_t: float, x: Array, *_: Array) -> float:
        # On its way to infinity LSODA would take ever shorter steps, without an end.
        return bound - float(np.abs(x).max())

    bound = ESCAPED * max(float(np.abs(x0).max()), 1.0)
    escaped.terminal = True  # type: ignore[attr-defined]
    with np.errstate(over="ignore", invalid="ignore"), warnings.catch_warnings():
        # LSODA's own words about a machine that runs away.
        warnings.simplefilter("ignore", UserWarning)
        solved = solve_ivp(
            rates,
            (times[0], times[-1]),
            x0,
            method="LSODA",
            t_eval=times,
            rtol=RTOL,
            atol=RTOL * np.abs(x0).max(),
            max_step=max_step,
            events=escaped if is_bounded else None,
            args=arguments or None,
        )
    if solved.status != 0 or not np.isfinite(solved.y).all():
        raise RunawayError(
            f"a machine could not be simulated to t = {times[-1]:.6g}: {solved.message}"
        )
    return solved.y.T


def runge_kutta(rates: Rates, x: Array, h: float) -> Array:
    """One step of four stages; ``rates(share, x)`` at a share of the step."""
    k1 = rates(0.0, x)
    k2 = rates(0.5, x + h / 2 * k1)
    k3 = rates(0.5, x + h / 2 * k2)
    k4 = rates(1.0, x + h * k3)
    return x + h / 6 * (k1 + 2 * (k2 + k3) + k4)


# --- the size of an effect, searched so that it shows by a given amount

TRIALS = 6  # sizes that are tried
NEAR = (0.8, 1.25)  # shares of the error that is asked for, which are near enough


@dataclass(frozen=True)
class Aim:
    """Noise (relative), the free-run error over the noise floor that is asked for, and
    the least that is accepted.
    """

    noise: float
    target: float
    least: float

    @property
    def wanted(self) -> float:
        """The error without the noise, in standard deviations of the signal."""
        return float(self.noise * np.sqrt(self.target**2 - 1))

    def ratio(self, error: float) -> float:
        """Free-run error with the noise over the noise floor."""
        return float(np.sqrt(1 + (error / self.noise) ** 2))


@dataclass(frozen=True)
class Trial:
    """A size and the error that it makes."""

    size: float
    error: float


def searched(
    error_of: Callable[[float], float],
    largest: float,
    aim: Aim,
    is_hopeless: Callable[[Trial], bool] = lambda trial: False,
) -> Trial | None:
    """The size whose error is near the wanted one, from an eighth of the largest on.

    The largest where it makes less; None where ``is_hopeless`` gives up.
    """
    low, high = NEAR
    size = largest / 8
    trials = [Trial(0.0, 0.0)]
    for _ in range(TRIALS):
        last = Trial(size, error_of(size))
        trials.append(last)
        is_all = size >= largest and last.error < aim.wanted
        if low * aim.wanted < last.error < high * aim.wanted or is_all:
            break
        if is_hopeless(last):
            return None
        size = min(_next_size(trials, aim.wanted), largest)
    return trials[-1]


def _next_size(trials: list[Trial], wanted: float) -> float:
    """Between the sizes that enclose the wanted error, in proportion; else beyond the
    largest, at most four times.
    """
    too_small = [trial for trial in trials if trial.error < wanted]
    too_large = [trial for trial in trials if trial.error >= wanted]
    below = max(too_small, key=lambda trial: trial.size)
    above = min(too_large, key=lambda trial: trial.size, default=below)
    if above.size <= below.size:
        factor = wanted / max(below.error, 1e-9)
        return below.size * float(np.clip(factor, 1.2, 4.0))
    share = (wanted - below.error) / (above.error - below.error)
    return below.size + float(np.clip(share, 0.1, 0.9)) * (above.size - below.size)
