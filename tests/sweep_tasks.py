"""Functions for the tests of sweeps, where another process can import them."""

import os
import pickle
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

import phsi_opt as ph
from phsi_opt.transcription.losses import MaximumLikelihood
from tests.waiting import HANGS_AFTER

N_SAMPLES = 60


def model() -> ph.FirstOrder:
    return ph.FirstOrder(
        states=["x", "v"],
        F={
            "x": "v",
            "v": ph.formula(
                "-k*x - c*v", k=ph.Parameter(3.0, lower=0), c=ph.Parameter(0.2, lower=0)
            ),
        },
    )


def data(seed: np.random.SeedSequence | int) -> ph.Measurements:
    """A damped swing of which the position alone is measured."""
    t = np.linspace(0.0, 6.0, N_SAMPLES)
    x = np.exp(-0.15 * t) * np.cos(2.0 * t)
    noisy = x + 0.02 * np.random.default_rng(seed).normal(size=N_SAMPLES)
    missing = np.full(N_SAMPLES, np.nan)
    return ph.Measurements.from_arrays(
        t, np.column_stack([noisy, missing]), states=["x", "v"]
    )


def estimates(seed: np.random.SeedSequence) -> dict[str, float]:
    """A fit of one draw of the noise."""
    fit = ph.identify(model(), data(seed), MaximumLikelihood())
    return {name: float(value) for name, value in fit.estimates.items()}


def slow_estimates(seed: np.random.SeedSequence) -> dict[str, float]:
    """The same, and long enough that a worker can be killed meanwhile."""
    time.sleep(0.3)
    return estimates(seed)


def square(number: int) -> int:
    return number**2


def fails_at_three(number: int) -> int:
    if number == 3:
        raise ValueError("three")
    return number


def process_and_threads(number: int) -> tuple[int, str]:
    return os.getpid(), os.environ.get("OMP_NUM_THREADS", "")


def sleeps(folder: str) -> None:
    """Leaves a file named by its process, and sleeps for longer than any test."""
    Path(folder, str(os.getpid())).touch()
    time.sleep(10 * HANGS_AFTER)


def dies(number: int) -> int:
    os._exit(7)


def halved(number: int, say: Callable[[str], None]) -> float:
    """Says what it does; three cannot be halved."""
    say(f"halving {number}")
    if number == 3:
        raise ph.SolveError("three")
    return number / 2


class Counted:
    """Has `submit` alone, and computes copies at once, as another process would."""

    def __init__(self) -> None:
        self.begun: list[Future[Any]] = []

    def submit(self, fn: Any, /, *args: Any) -> Future[Any]:
        copied, values = pickle.loads(pickle.dumps((fn, args)))
        future: Future[Any] = Future()
        future.set_result(copied(*values))
        self.begun.append(future)
        return future
