"""A gas chamber that leaks: one storage without losses, whose gas is measured.

    dn/dt = b u - leak(P),   P = n/C

with the inflow u in some; without it the model has nothing that is free.
"""

from collections.abc import Mapping

import numpy as np

import phsi_opt as ph
from problems.field_machines.records import Array, Experiment, Hidden, Truth, Values
from problems.hidden_effects.machines import log_uniform

N_SAMPLES = 150
N_RUNS = 3
N_TRAIN = 2
LAMINAR = 1e-3  # share of the first pressure below which a turbulent leak is linear
LARGEST_LOSS = 1.5  # of the first gas, in a run at the first rate
N_LEVELS = 6  # of the inflow in a run


def chamber(rng: np.random.Generator, has_inflow: bool | None = None) -> Experiment:
    """A linear, a turbulent or a quadratic leak.

    ``has_inflow``: None: every other time.
    """
    capacity = float(log_uniform(rng, 0.5, 2.0))
    pressure = float(log_uniform(rng, 1.0, 5.0))
    duration = float(log_uniform(rng, 5.0, 50.0))
    name = str(rng.choice(["linear leak", "turbulent leak", "quadratic leak"]))
    drawn_inflow = rng.random() < 0.5
    is_fed = drawn_inflow if has_inflow is None else has_inflow
    shares = np.array([1.0, rng.uniform(0.5, 0.7), 0.85])
    starts = capacity * pressure * shares[:, None]
    t = np.linspace(0.0, duration, N_SAMPLES)
    mean_rate = capacity * pressure / duration
    levels = mean_rate * rng.uniform(0.0, 1.5, (N_RUNS, N_LEVELS))
    place = np.arange(N_SAMPLES) * N_LEVELS // N_SAMPLES
    inflow = levels[:, place]
    gain = float(rng.uniform(0.8, 1.25))

    def fed(time: float, x: Array) -> Array:
        k = min(int(time / t[1] + 1e-9), N_SAMPLES - 1)
        return inflow[:, k, None]

    def rates(x: Array, u: Array, values: Values) -> Array:
        if not is_fed:
            return np.zeros_like(x)
        return np.zeros_like(x) + (values["b"] * u[..., 0])[..., None]

    def model(given: Mapping[str, float]) -> ph.Model:
        H = ph.formula(f"n**2/(2*{capacity!r})")
        if not is_fed:
            return ph.PseudoHamiltonian(
                states=["n"], S=np.zeros((1, 1)), H=H, kind="hydraulic"
            )
        b = ph.Parameter(given["b"], lower=0.0)
        F = {"n": ph.formula("b*u", b=b)}
        return ph.PseudoHamiltonian(
            states=["n"],
            inputs=["u"],
            S=np.zeros((1, 1)),
            H=H,
            F=F,
            kind="hydraulic",
        )

    return Experiment(
        states=("n",),
        seen=(0,),
        rates=rates,
        values={"b": gain} if is_fed else {},
        model=model,
        hidden=_leak(name, capacity, pressure, LARGEST_LOSS * mean_rate),
        t=t,
        starts=starts,
        n_train=N_TRAIN,
        row=0,
        time=duration / 3,
        inputs=("u",) if is_fed else (),
        input_at=fed if is_fed else None,
        hold="zero",
    )


def _leak(name: str, capacity: float, pressure: float, largest_rate: float) -> Hidden:
    """The leak whose rate at the first pressure is at most as given."""
    powers = {"linear leak": 1.0, "turbulent leak": 0.5, "quadratic leak": 2.0}
    names = {
        "linear leak": ("linear leak", "viscous damping"),
        "turbulent leak": ("turbulent leak",),
        "quadratic leak": ("quadratic leak", "quadratic drag"),
    }
    power = powers[name]
    laminar = LAMINAR * pressure

    def law(x: Array, u: Array) -> Array:
        P = x / capacity
        return -P * (P**2 + laminar**2) ** ((power - 1) / 2)

    truth = Truth(names[name], "n", 1.0)
    return Hidden(name, law, (truth,), largest_rate / pressure**power)
