"""Machines and records that several tests are about."""

import numpy as np

import phsi_opt as ph

TIMES = np.linspace(0.0, 14.0, 141)
STARTS = ([1.0, 0.0], [-0.6, 0.8], [0.4, -1.1])
NOISE = 0.01


def pushed_mass(m: float | ph.Parameter) -> ph.PseudoHamiltonian:
    """m d^2q/dt^2 = u."""
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("p**2/(2*m)", m=m),
        F={"p": "u"},
    )


def damped_spring(
    energy: str = "2.3*q**2/2 + p**2/2",
    loss: str = "0.1",
    force: str = "",
    **free: ph.Parameter,
) -> ph.PseudoHamiltonian:
    """A unit mass on a spring; the parameters ``free`` are those of its energy."""
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula(energy, **free),
        R={"p": ph.formula(loss)},
        F={"p": ph.formula(force)} if force else {},
    )


def driven_spring(
    k: ph.Parameter | float, c: ph.Parameter | float, force: str = "u"
) -> ph.PseudoHamiltonian:
    """A unit mass on a spring with viscous damping and the input u."""
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=k),
        R={"p": ph.formula("c", c=c)},
        F={"p": ph.formula(force)},
    )


def swings(
    model: ph.Model, seed: int, *, shows_p: bool = False, n: int = 141
) -> ph.Measurements:
    """Three noisy runs of a model without inputs; perhaps p is measured too."""
    rng = np.random.default_rng(seed)
    t = np.linspace(TIMES[0], TIMES[-1], n)
    runs = []
    for start in STARTS:
        x = ph.simulate(model, t, start)
        x = x + NOISE * rng.normal(size=x.shape)
        if not shows_p:
            x[:, 1] = np.nan
        runs.append(x)
    return ph.Measurements.from_arrays([t] * 3, runs, states=["q", "p"])
