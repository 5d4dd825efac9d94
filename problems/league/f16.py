"""The F-16 on the ground: a wing with a payload at its tip, shaken by a force.

Four modes of vibration: one below the excited band of 2 to 15 Hz, two of wing and
payload, and one of the bolted joint between them. The displacement r of the joint is a
coordinate of the model, so a force in the joint acts on its momentum alone. Three
accelerations are measured, no state: they follow from dx/dt, so an effect that is added
shows in them.
"""

import re
from collections.abc import Sequence

import casadi as ca
import numpy as np
from scipy.optimize import least_squares
from scipy.signal import resample

import phsi_opt as ph
from phsi_opt.model.terms import Dictionary
from phsi_opt.simulation.simulate import free_run, rates
from problems.measured.machines import Array
from problems.measured.vibrations import (
    FITTED,
    JUDGED,
    PERIOD,
    RATE,
    Shaken,
    inside,
    period,
)

LAG = PERIOD // 2
BAND = (2.0, 45.0)  # Hz, the force and its harmonics
POSITIONS, MOMENTA = ("e1", "e2", "e3", "r"), ("p1", "p2", "p3", "pr")
N = len(POSITIONS)
NAMES = r"\b([kcbsj]\d|[kc]j)\b"  # of parameters
# Rough values by mode with the joint loose, of unit modal mass: stiffness (1/s^2),
# damping (1/s), and how far shaker, wing and joint move with it (kg^-1/2); then the
# stiffness (N/m) and damping (N s/m) of the joint, and what its friction starts from.
START = {
    "k": (3.5, 2020.0, 3230.0, 12500.0),
    "c": (6.7, 0.1, 0.5, 0.1),
    "b": (0.116, -0.038, -0.017, 0.058),
    "s": (0.028, -0.082, -0.065, -0.023),
    "j": (0.0026, 0.0083, 0.0068, 0.0076),
}
JOINT = {"kj": 4e5, "cj": 2e4}
FRICTION = {
    "hysteresis_force_pr": 300.0,  # N
    "hysteresis_width_pr": 6e-5,  # m
    "hysteresis_slow_pr": 1e-5,  # m/s
}


# --- models


def base() -> ph.PseudoHamiltonian:
    """Four modes with the joint loose, and a spring and a damper in the joint.

    With the modal displacements e_i, r = sum j_i e_i gives the last one. Sensors show
    the velocities of shaker (b) and wing (s).
    """
    last = f"(r - {_sum('j{i}*e{i}')})/j{N}"
    rate = f"(dH_dpr - {_sum('j{i}*dH_dp{i}')})/j{N}"
    energy = _sum("(k{i}*e{i}**2 + (p{i} + j{i}*pr)**2)/2")
    F = {"pr": f"b{N}/j{N}*u - c{N}/j{N}*{rate} - cj*dH_dpr"}
    for i in range(1, N):
        F[f"p{i}"] = (
            f"(b{i} - j{i}*b{N}/j{N})*u - c{i}*dH_dp{i} + c{N}*j{i}/j{N}*{rate}"
        )
    sensor = {}
    for state, shape in (("p1", "b"), ("p2", "s")):
        others = _sum(f"{shape}{{i}}*(p{{i}} + j{{i}}*pr)")
        sensor[state] = _formula(f"{others} + {shape}{N}*j{N}*pr - {state}")
    return ph.PseudoHamiltonian(
        states=[*POSITIONS, *MOMENTA],
        inputs=["u"],
        S=ph.canonical(N),
        H=_formula(f"{energy} + (k{N}*({last})**2 + j{N}**2*pr**2 + kj*r**2)/2"),
        F={state: _formula(text) for state, text in F.items()},
        sensor=sensor,
    )


def _sum(term: str) -> str:
    """Of a term of each mode but the last, in brackets."""
    return f"({' + '.join(term.format(i=i) for i in range(1, N))})"


def _formula(text: str) -> Dictionary:
    """With the parameters that it names."""
    names = sorted(set(re.findall(NAMES, text)))
    return ph.formula(text, **{name: _parameter(name) for name in names})


def _parameter(name: str) -> ph.Parameter:
    value = JOINT[name] if name in JOINT else START[name[0]][int(name[1:]) - 1]
    lower = 1e-6 if name[0] in "kc" or name == f"j{N}" else -np.inf
    return ph.Parameter(value, lower=lower, fixed=name == "k1")  # below the band


def physics() -> ph.Model:
    """Dry friction in the joint, which sticks before it slides: Bouc and Wen's."""
    return with_effects(base(), ["hysteresis on p"])


def with_effects(model: ph.Model, effects: Sequence[str]) -> ph.Model:
    """With effects of the main resonance ("hysteresis on p") in the joint."""
    for effect in effects:
        model = model.add(effect.removesuffix(" on p"), "pr")
    known = FRICTION.keys() & model.values.keys()
    return model.with_values({name: FRICTION[name] for name in known})


# --- free runs


def fitted(model: ph.Model, _: ph.Measurements) -> ph.Model:
    """The model whose free runs over a period of each level have the least error.

    A run begins at rest half a period earlier. Errors count within the band, over the
    size of each acceleration at the level.
    """
    linear = {name for name in model.values if re.fullmatch(NAMES, name)}
    model = model.with_free(linear - {"k1"})
    run = _runner(model.rhs(), PERIOD + LAG)
    records = [period(level) for level in sorted(FITTED + JUDGED)]
    inputs = [_with_midpoints(record.u) for record in records]

    def misfit(values: Array) -> Array:
        present = model.with_values(dict(zip(model.free, values, strict=True)))
        found = []
        for record, u in zip(records, inputs, strict=True):
            of_positions = run(np.zeros(model.n_states), u, present.theta).full().T
            simulated = shown(present, of_positions[LAG:])
            measured, found_there = (_lines(a) for a in (record.a, simulated))
            error = (found_there - measured) / np.linalg.norm(measured, axis=0)
            found.append(np.nan_to_num(error, nan=1e3))
        return np.concatenate(found).ravel()

    parameters = [model.entries[name].parameter for name in model.free]
    solution = least_squares(
        misfit,
        [parameter.value for parameter in parameters],
        bounds=([p.lower for p in parameters], [p.upper for p in parameters]),
        x_scale="jac",
        max_nfev=30,
        ftol=1e-4,
    )
    return model.with_values(dict(zip(model.free, solution.x.tolist(), strict=True)))


def _lines(a: Array) -> Array:
    """Real and imaginary parts (n, 3) of accelerations of a period in the band."""
    lines = np.fft.rfft(a, axis=0)[inside(BAND)]
    return np.concatenate([lines.real, lines.imag])


def _with_midpoints(u: Array) -> Array:
    """Force at the samples, between them, and at the next ones, (3, n_samples)."""
    finer = resample(u[:, 0], 2 * PERIOD)
    finer = np.r_[finer[-2 * LAG :], finer, finer[0]]
    return np.array([finer[:-1:2], finer[1::2], finer[2::2]])


def _runner(rhs: ca.Function, n: int) -> ca.Function:
    """(x0, u (3, n), theta) -> accelerations of the positions (N, n), by Runge and
    Kutta's steps of a sample.
    """
    x, u = ca.SX.sym("x", rhs.size1_in(0)), ca.SX.sym("u", 3)
    theta = ca.SX.sym("theta", rhs.size1_in(3))
    h = 1 / RATE
    first = rhs(x, u[0], 0, theta)
    second = rhs(x + h / 2 * first, u[1], 0, theta)
    third = rhs(x + h / 2 * second, u[1], 0, theta)
    last = rhs(x + h * third, u[2], 0, theta)
    after = x + h / 6 * (first + 2 * second + 2 * third + last)
    a = ca.jtimes(first[:N], x, first)
    step = ca.Function("step", [x, u, theta], [after, a]).mapaccum(n)
    x0, us = ca.MX.sym("x0", x.numel()), ca.MX.sym("us", 3, n)
    of = ca.MX.sym("theta", theta.numel())
    return ca.Function("run", [x0, us, of], [step(x0, us, ca.repmat(of, 1, n))[1]])


def shown(model: ph.Model, of_positions: Array) -> Array:
    """Accelerations (n_samples, 3) of shaker, wing and payload."""
    b, s, j = (_shape(model, kind) for kind in "bsj")
    others, r = of_positions[:, :-1], of_positions[:, -1:]
    modes = np.c_[others, (r[:, 0] - others @ j[:-1]) / j[-1]]
    return np.c_[modes @ b, modes @ s, modes @ (s + j)]


def _shape(model: ph.Model, kind: str) -> Array:
    return np.array([model.values[f"{kind}{i}"] for i in range(1, N + 1)])


def error(model: ph.Model, record: Shaken, n_first: int) -> float:
    """Root mean square error (m/s^2) of one free run, from the first samples on.

    Its starting state is estimated from these alone; what they do not tell stays small
    against the state after a second from rest.
    """
    function = rates(model.rhs(), model.theta)
    x, u = ca.SX.sym("x", model.n_states), ca.SX.sym("u")
    dx = function(x, u, 0)
    of_positions = ca.Function("a", [x, u], [ca.jtimes(dx[:N], x, dx)])

    def accelerations(start: Array, n: int) -> Array:
        states = free_run(model, record.t[:n], start, record.u[:n], "cubic")
        found = of_positions(states.T, record.u[:n].T).full().T
        return shown(model, found) - record.a[:n]

    rest = np.zeros(model.n_states)
    scale = np.std(free_run(model, record.t[:RATE], rest, record.u[:RATE], "cubic"), 0)
    size = record.a[:n_first].std()

    def misfit(relative: Array) -> Array:
        a = accelerations(scale * relative, n_first)
        return np.r_[a.ravel() / size, 0.03 * relative]

    start = scale * least_squares(misfit, rest).x
    a = accelerations(start, len(record.t))[n_first:]
    return float(np.sqrt(np.mean(a**2)))
