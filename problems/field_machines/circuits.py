"""A series circuit of resistor, coil and capacitor at a measured voltage.

States are the capacitor's charge q and the coil's flux; current = dH/dflux. A coil that
saturates adds b flux^4/4 to the energy: current = flux/L + b flux^3.
"""

from collections.abc import Mapping

import numpy as np

import phsi_opt as ph
from problems.field_machines.laws import on_momentum
from problems.field_machines.records import Array, Experiment, Hidden, Truth, Values
from problems.hidden_effects.machines import log_uniform

PER_PERIOD = 28
N_PERIODS = (6, 9)
N_RUNS = 3
N_TRAIN = 2
LARGEST_RESISTANCE = 0.4  # over that of critical damping
LARGEST_SATURATION = 0.7  # of the current, at the largest flux


def circuit(rng: np.random.Generator) -> Experiment:
    """The coil saturates, or a resistance is missing."""
    coil = float(log_uniform(rng, 0.5, 2.0))
    elastance = float(log_uniform(rng, 0.5, 4.0))  # 1 over the capacity
    critical = 2 * np.sqrt(elastance * coil)
    resistance = critical * float(log_uniform(rng, 0.04, 0.12))
    period = 2 * np.pi * np.sqrt(coil / elastance)
    saturates = rng.random() < 0.5
    t = np.arange(int(rng.uniform(*N_PERIODS) * PER_PERIOD)) * period / PER_PERIOD
    # Two sines of voltage beside the resonance, others in every run.
    sizes = elastance * rng.uniform(0.3, 0.7, (N_RUNS, 2))
    frequencies = 2 * np.pi / period * rng.uniform(0.4, 1.4, (N_RUNS, 2))
    phases = rng.uniform(0, 2 * np.pi, (N_RUNS, 2))
    starts = np.stack([rng.normal(size=N_RUNS), np.zeros(N_RUNS)], axis=1)

    def voltage(time: float, x: Array) -> Array:
        waves = sizes * np.sin(frequencies * time + phases)
        return waves.sum(axis=1)[:, None]

    def rates(x: Array, u: Array, values: Values) -> Array:
        current = x[..., 1] / coil
        drop = values["s"] * x[..., 0]
        if saturates:
            drop = drop + values["R"] * current
        return np.stack([current, u[..., 0] - drop], axis=-1)

    def model(given: Mapping[str, float]) -> ph.Model:
        R = {}
        if saturates:
            R = {"flux": ph.formula("R", R=ph.Parameter(given["R"], lower=0.0))}
        s = ph.Parameter(given["s"], lower=0.0)
        return ph.PseudoHamiltonian(
            states=["q", "flux"],
            inputs=["u"],
            S=ph.canonical(1),
            H=ph.formula(f"s*q**2/2 + flux**2/(2*{coil!r})", s=s),
            R=R,
            F={"flux": ph.formula("u")},
            kind="electrical",
        )

    values = {"s": elastance}
    hidden = ohmic(coil, LARGEST_RESISTANCE * critical)
    # Flux is measured as current times L, which a saturating coil does not allow.
    seen = [(0,), (1,), (0, 1)][rng.integers(3)]
    if saturates:
        values["R"] = resistance
        largest_flux = 1.5 * np.sqrt(elastance * coil)
        hidden = saturation(coil, resistance, LARGEST_SATURATION, largest_flux)
        seen = (0,)
    return Experiment(
        states=("q", "flux"),
        seen=seen,
        rates=rates,
        values=values,
        model=model,
        hidden=hidden,
        t=t,
        starts=starts,
        n_train=N_TRAIN,
        row=1,
        time=period,
        inputs=("u",),
        input_at=voltage,
    )


def ohmic(coil: float, largest: float) -> Hidden:
    """-R flux / L in the coil's equation."""
    law = on_momentum(lambda x: -x[..., 1] / coil)
    truth = Truth(("linear resistance",), "flux", 1.0)
    return Hidden("resistance", law, (truth,), largest)


def saturation(coil: float, resistance: float, share: float, flux: float) -> Hidden:
    """More current at a large flux, which the resistor answers too.

    ``share``: of the current that is new at the largest ``flux``.
    """

    def law(x: Array, u: Array) -> Array:
        more = x[..., 1] ** 3
        return np.stack([more, -resistance * more], axis=-1)

    truth = Truth(("coil saturation",), "flux", 1.0)
    return Hidden("saturating coil", law, (truth,), share / coil / flux**2)
