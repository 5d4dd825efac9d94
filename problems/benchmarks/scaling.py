"""How time grows: `identify` over samples and over states, `diagnose` over both.

    python -m problems.benchmarks.scaling [--quick]

Every size runs in a process of its own, so that its peak memory is its own.
"""

import resource
import sys
import time
from collections.abc import Sequence

import numpy as np

import phsi_opt as ph
from problems.benchmarks import chains
from problems.benchmarks.efficiency.cases import DUFFING, DUFFING_START, duffing_model
from problems.benchmarks.peer_problems import duffing_rates
from problems.tools.command_line import flag
from problems.tools.pages import publish, render
from problems.tools.simulation import integrated
from problems.tools.workers import fresh_processes

# What is measured of the oscillator, and numbers of samples.
SAMPLES = {"qp": (1_000, 10_000, 100_000), "q": (1_000, 10_000, 100_000, 1_000_000)}
MASSES = (1, 5, 25, 100, 200)
CHAIN_SAMPLES = 1_000
DIAGNOSED = ((1_000, 1), (10_000, 1), (1_000, 8))  # samples, masses
HELD_OUT = 3  # times as many samples are fitted as are held out
STEP = 0.1  # s
NOISE = 0.03  # of each channel's standard deviation
SEED = 9000

Row = dict[str, object]


def data(n_samples: int, channels: str) -> ph.Measurements:
    """One record of the driven Duffing oscillator, which forgets its start, so that
    errors of the integration do not grow with its length.
    """
    t = STEP * np.arange(n_samples)
    truth = list(DUFFING.values())

    def rates(at: float, x: np.ndarray) -> list[float]:
        return duffing_rates(at, x.tolist(), truth, np.cos)

    x = integrated(rates, t, DUFFING_START, "LSODA", rtol=1e-9, atol=1e-9)
    y = x + NOISE * x.std(axis=0) * np.random.default_rng(SEED).normal(size=x.shape)
    if channels == "q":
        y[:, 1] = np.nan
    return ph.Measurements.from_arrays([t], [y], states=("q", "p"))


def by_samples(n_samples: int, channels: str) -> Row:
    """One fit of the oscillator."""
    given = data(n_samples, channels)
    row: Row = {"measured": " and ".join(channels), "samples": n_samples}
    return row | _fitted(duffing_model(), given, DUFFING)


def by_states(n_masses: int, n_samples: int = CHAIN_SAMPLES) -> Row:
    """One fit of a chain, all states measured."""
    given = chains.data(n_masses, n_samples)
    row: Row = {"states": 2 * n_masses, "samples": n_samples}
    return row | _fitted(chains.model(n_masses), given, chains.TRUTH)


def _fitted(model: ph.Model, given: ph.Measurements, truth: dict[str, float]) -> Row:
    """Processor seconds, standard errors included, peak memory and errors."""
    began = time.process_time()
    fit = ph.identify(model, given)
    std_errors = fit.std_errors
    seconds = time.process_time() - began
    known = dict(zip(fit.names, truth.values(), strict=True))
    errors = [abs(fit.values[name] - known[name]) / std_errors[name] for name in known]
    # Linux counts it in kB, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9
    return {
        "identify (s)": round(seconds, 2),
        "memory (GB)": round(memory, 2),
        "largest error in standard errors": round(float(max(errors)), 2),
    }


def diagnosis(n_samples: int, n_masses: int) -> Row:
    """A diagnosis with the whole catalogue; friction on one mass is hidden."""
    train = chains.driven_data(n_masses, n_samples, seed=0)
    test = chains.driven_data(n_masses, n_samples // HELD_OUT, seed=1)
    model = chains.driven(n_masses)
    fit = ph.identify(model, train)
    _ = fit.std_errors  # computed when they are asked for
    began = time.process_time()
    found = ph.diagnose(fit, train, test)
    seconds = time.process_time() - began
    first = found.candidates.iloc[0]
    size = f"{first['coefficient']:.4f} +- {first['std_error']:.4f}"
    row: Row = {"masses": n_masses, "samples": n_samples}
    row |= {"effects": len(ph.catalogue(model)), "diagnosis (s)": round(seconds, 1)}
    return row | {"what it said": f"{found.verdict}: {found.effects[0]}, {size}"}


def growth(rows: Sequence[Row], size: str) -> float:
    """The power with which the time of `identify` grows over the last two sizes."""
    before, after = rows[-2:]
    times = float(str(after["identify (s)"])) / float(str(before["identify (s)"]))
    return float(np.log(times) / np.log(int(str(after[size])) / int(str(before[size]))))


def main(quick: bool) -> None:
    """All sizes; the page is written unless ``quick``."""
    samples = {"q": (500, 1000)} if quick else SAMPLES
    sizes = [(n, channels) for channels, all_n in samples.items() for n in all_n]
    masses = (1, 2) if quick else MASSES
    n_samples = 100 if quick else CHAIN_SAMPLES
    diagnosed = ((400, 1),) if quick else DIAGNOSED
    with fresh_processes() as alone:
        of_samples = [alone.submit(by_samples, *size).result() for size in sizes]
        of_states = [alone.submit(by_states, n, n_samples).result() for n in masses]
        diagnoses = [alone.submit(diagnosis, *size).result() for size in diagnosed]
    text = render(
        "benchmarks/pages/scaling.md",
        of_samples=of_samples,
        of_states=of_states,
        diagnoses=diagnoses,
        powers=(growth(of_samples, "samples"), growth(of_states, "states")),
        held_out=HELD_OUT,
        step=STEP,
        noise=NOISE,
        chain_noise=chains.NOISE,
        friction=chains.FRICTION,
    )
    publish("scaling.md", text, not quick)


if __name__ == "__main__":
    main(flag("quick"))
