"""Systems that tests are about: models, and records of their motion with noise."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import phsi_opt as ph

Number = ph.Parameter | float
Part = Any  # the text of a formula, or what a slot of a model may be

TIMES = np.linspace(0.0, 14.0, 141)
STARTS = ([1.0, 0.0], [-0.6, 0.8], [0.4, -1.1])
NOISE = 0.01


def positive(start: float | None = None, **about: Any) -> ph.Parameter:
    """A free parameter above zero, unless a bound is given."""
    return ph.Parameter(start, **{"lower": 0.0, **about})


def pair(
    H: Part,
    R: Part = None,
    F: Part = None,
    inputs: Any = None,
    sensor: Any = None,
    **parameters: Number,
) -> ph.PseudoHamiltonian:
    """A canonical pair (q, p) whose loss R and force F act on the momentum.

    Each part knows those of the parameters that it names; u in a force is the input.
    """

    def formula(text: Part) -> Part:
        if not isinstance(text, str):
            return text
        names = set(re.findall(r"\w+", text))
        known = {n: v for n, v in parameters.items() if n in names}
        return ph.formula(text, **known) if known else text

    def of_momentum(part: Part) -> Part:
        if part is None or isinstance(part, Mapping):
            return part or {}
        return {"p": part}

    if inputs is None:
        inputs = ["u"] if isinstance(F, str) and re.search(r"\bu\b", F) else []
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=inputs,
        S=ph.canonical(1),
        H=formula(H),
        R=of_momentum(formula(R)),
        F=of_momentum(formula(F)),
        sensor=sensor or {},
    )


def spring(
    k: Number,
    c: Number | None = None,
    m: Number | None = None,
    F: Part = None,
    **slots: Any,
) -> ph.PseudoHamiltonian:
    """A mass, one unless given, on a spring with a damper, R_p unless it is given."""
    energy = "k*q**2/2 + " + ("p**2/2" if m is None else "p**2/(2*m)")
    given: dict[str, Any] = {"k": k, "c": c, "m": m}
    known = {name: value for name, value in given.items() if value is not None}
    return pair(energy, ph.damping("p") if c is None else "c", F, **known, **slots)


def pushed_mass(m: Number) -> ph.PseudoHamiltonian:
    """m d^2q/dt^2 = u."""
    return pair("p**2/(2*m)", F="u", m=m)


def damped_spring(
    energy: str = "2.3*q**2/2 + p**2/2",
    loss: str = "0.1",
    force: str = "",
    **free: ph.Parameter,
) -> ph.PseudoHamiltonian:
    """A unit mass on a spring; the parameters ``free`` are those of its energy."""
    return pair(energy, loss, force or None, **free)


def recorded(
    model: ph.Model,
    t: np.ndarray,
    *starts: Sequence[float],
    u: Any = None,
    noise: Any = NOISE,
    seed: int = 0,
    shown: Sequence[str] | None = None,
    hold: Any = "linear",
    **about: Any,
) -> ph.Measurements:
    """A noisy run from each start; states that are not ``shown`` were not measured."""
    rng = np.random.default_rng(seed)
    is_hidden = [shown is not None and name not in shown for name in model.states]
    runs = []
    for start in starts:
        x = ph.simulate(model, t, start, u, hold=hold)
        x = x + noise * rng.normal(size=x.shape)
        x[:, is_hidden] = np.nan
        runs.append(x)
    n = len(runs)
    return ph.Measurements.from_arrays(
        [t] * n,
        runs,
        None if u is None else [u] * n,
        states=model.states,
        inputs=model.inputs,
        hold=hold,
        **about,
    )


def swings(
    model: ph.Model, seed: int, *, shows_p: bool = False, n: int = 141
) -> ph.Measurements:
    """Three noisy runs of a model without inputs; perhaps p is measured too."""
    t = np.linspace(TIMES[0], TIMES[-1], n)
    return recorded(model, t, *STARTS, seed=seed, shown="qp" if shows_p else "q")
