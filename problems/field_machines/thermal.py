"""Two bodies, one heated: temperatures above a reference, heater power and the ambient
temperature as inputs.

    C1 dT1/dt = P - g1 (T1 - Ta) - g12 (T1 - T2)
    C2 dT2/dt =   - g2 (T2 - Ta) - g12 (T2 - T1)
"""

from collections.abc import Mapping

import numpy as np

import phsi_opt as ph
from problems.field_machines.records import Array, Experiment, Hidden, Truth, Values
from problems.hidden_effects.machines import log_uniform

N_SAMPLES = 150
N_RUNS = 3
N_TRAIN = 2
N_CONSTANTS = (3.0, 6.0)  # time constants in a run
LOSS, COUPLING, RADIATION = "loss to ambient", "heat exchange", "quadratic loss"
LARGEST = 3.0  # hidden conductance over that of a body that is known
POWER = (0.0, 8.0)
AMBIENT = (0.2, 1.5)  # above the reference, as all temperatures
N_LEVELS = 8  # of the power in a run


def thermal(rng: np.random.Generator) -> Experiment:
    """One of the three ways that heat leaves the first body is hidden."""
    name = str(rng.choice([LOSS, COUPLING, RADIATION]))
    C1 = float(log_uniform(rng, 0.5, 2.0))
    C2 = float(log_uniform(rng, 0.5, 2.0))
    true = {}
    for conductance in ("g1", "g2", "g12"):
        true[conductance] = float(log_uniform(rng, 0.5, 1.5))
    t = np.linspace(0.0, rng.uniform(*N_CONSTANTS), N_SAMPLES)
    power, ambient = _inputs(rng, t)
    starts = rng.uniform(1.0, 4.0, (N_RUNS, 2))

    def inputs(time: float, x: Array) -> Array:
        k = min(int(time / t[1] + 1e-9), N_SAMPLES - 1)
        return np.stack([power[:, k], ambient[:, k]], axis=1)

    hidden = _hidden(name, C1, C2)
    absent = {LOSS: "g1", COUPLING: "g12"}.get(name, "")
    values = {key: value for key, value in true.items() if key != absent}

    def rates(x: Array, u: Array, values: Values) -> Array:
        lost1 = values.get("g1", 0.0) * (x[..., 0] - u[..., 1])
        lost2 = values.get("g2", 0.0) * (x[..., 1] - u[..., 1])
        passed = values.get("g12", 0.0) * (x[..., 0] - x[..., 1])
        first = (u[..., 0] - lost1 - passed) / C1
        return np.stack([first, (passed - lost2) / C2], axis=-1)

    def model(given: Mapping[str, float]) -> ph.Model:
        first = "P"
        second = "-g2*(T2 - Ta)"
        if "g1" in given:
            first += " - g1*(T1 - Ta)"
        if "g12" in given:
            first += " - g12*(T1 - T2)"
            second += " + g12*(T1 - T2)"
        free = {key: ph.Parameter(value, lower=0.0) for key, value in given.items()}
        rates = {
            "T1": ph.formula(f"({first})/{C1!r}", **_used(free, first)),
            "T2": ph.formula(f"({second})/{C2!r}", **_used(free, second)),
        }
        return ph.FirstOrder(["T1", "T2"], rates, inputs=["P", "Ta"], kind="thermal")

    return Experiment(
        states=("T1", "T2"),
        seen=(0, 1),
        rates=rates,
        values=values,
        model=model,
        hidden=hidden,
        t=t,
        starts=starts,
        n_train=N_TRAIN,
        row=0,
        time=1.0,
        inputs=("P", "Ta"),
        input_at=inputs,
        hold="zero",
    )


def _used(free: Mapping[str, ph.Parameter], text: str) -> dict[str, ph.Parameter]:
    """The parameters that a formula has."""
    return {name: one for name, one in free.items() if f"{name}*" in text}


def _inputs(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    """Power in steps, and an ambient temperature that goes up and down; (n_runs,
    n_samples) each.
    """
    levels = rng.uniform(*POWER, (N_RUNS, N_LEVELS))
    place = np.arange(len(t)) * N_LEVELS // len(t)
    low, high = AMBIENT
    phases = rng.uniform(0, 2 * np.pi, (N_RUNS, 1))
    day = rng.uniform(0.5, 1.0, (N_RUNS, 1)) * t[-1]
    wave = (1 + np.sin(2 * np.pi * t / day + phases)) / 2
    return levels[:, place], low + (high - low) * wave


def _hidden(name: str, C1: float, C2: float) -> Hidden:
    """The hidden flow of heat, with what a catalogue of single terms says of it.

    A loss to the ambient is an exchange with it, or a loss to the reference beside a
    gain of the ambient temperature.
    """
    if name == LOSS:
        leak = Truth(("heat loss", "heat exchange with Ta"), "T1", 1 / C1)
        ambient = Truth(("input gain of Ta",), "T1", 1 / C1)

        def loss(x: Array, u: Array) -> Array:
            rate = -(x[..., 0] - u[..., 1]) / C1
            return np.stack([rate, np.zeros_like(rate)], axis=-1)

        return Hidden(name, loss, (leak, ambient), LARGEST)
    if name == COUPLING:
        second = Truth(("heat exchange with T1",), "T2", 1 / C2)
        first = Truth(("heat exchange with T2",), "T1", 1 / C1)

        def exchange(x: Array, u: Array) -> Array:
            flow = x[..., 0] - x[..., 1]
            return np.stack([-flow / C1, flow / C2], axis=-1)

        return Hidden(name, exchange, (first, second), LARGEST)

    def radiation(x: Array, u: Array) -> Array:
        rate = -np.abs(x[..., 0]) * x[..., 0] / C1
        return np.stack([rate, np.zeros_like(rate)], axis=-1)

    return Hidden(
        name, radiation, (Truth(("quadratic heat loss",), "T1", 1 / C1),), LARGEST
    )
