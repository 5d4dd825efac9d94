"""An industrial robot, KUKA KR300 R2500 ultra SE: six motor torques to six angles.

A model of each joint, which takes the angles of the others as inputs, is fitted to the
measured angles. A free run is one of all six together.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.io import loadmat
from scipy.linalg import block_diag

import phsi_opt as ph
from phsi_opt.simulation.simulate import free_run
from problems.measured.machines import Array, with_unmeasured
from problems.tools.data_paths import folder

STEP, N_ROWS = 0.1, 605  # s; rows of a movement in the file
JOINTS = range(1, 7)
AT_REST = 54  # samples, at either end of a movement
WINDOW = 25  # samples that are fitted at once
# Movements: the first of each of ten recordings, one for a study and one held out.
FITTED, STUDIED, HELD_OUT = slice(0, None, 6), slice(0, 1), slice(20, 21)
RATIOS = (256.857, 267.429, 252.333, 221.0, 239.619, 154.323)  # Retzler et al. (2024)
# What gravity and the gas spring of joint 2 exert.
PITCH = (
    " + forearm{i}*cos(q2 + q3)"
    " + payload{i}*(cos(q2 + q3)*cos(q5) - sin(q2 + q3)*cos(q4)*sin(q5))"
)
GRAVITY = {
    2: " - spring{i}*sin(q2)" + PITCH,
    3: PITCH,
    4: " - payload{i}*cos(q2 + q3)*sin(q4)*sin(q5)",
    5: " + payload{i}*(cos(q2 + q3)*cos(q4)*cos(q5) - sin(q2 + q3)*sin(q5))",
}
# Rough values by joint: inertia (kg m^2), viscous (N m s) and dry friction (N m).
ROUGH = {
    "J": (1600.0, 2400.0, 1100.0, 140.0, 170.0, 70.0),
    "d": (1900.0, 2300.0, 1200.0, 190.0, 530.0, 330.0),
    "f": (330.0, 380.0, 310.0, 130.0, 120.0, 90.0),
    "spring": (1800.0,) * 6,  # N m, as the weights
    "forearm": (2450.0,) * 6,
    "payload": (540.0,) * 6,
    "c": (0.0,) * 6,
}


class Record(NamedTuple):
    """Angles (rad) and torques (N m) of consecutive samples, each (n_samples, 6)."""

    q: Array
    u: Array


def movements(name: str) -> list[Record]:
    """Of one minute, from rest to rest; each was recorded twice.

    A row of the file holds a torque and the angle one sample later.
    """
    path = folder("industrial_robot") / "forward_identification.mat"
    content = loadmat(path)
    y, u = (content[f"{kind}_{name}"].T.reshape(-1, N_ROWS, 6) for kind in "yu")
    return [Record(*pair) for pair in zip(np.deg2rad(y[:, :-1]), u[:, 1:], strict=True)]


def moving(records: Sequence[Record], n: int) -> list[Record]:
    """Windows of ``n`` steps between the rests, where dry friction tells no torque."""
    last = N_ROWS - AT_REST - n
    return [
        Record(q[i : i + n + 1], u[i : i + n + 1])
        for q, u in records
        for i in range(AT_REST, last, n)
    ]


# --- models


def joint(i: int, is_base: bool = False) -> ph.PseudoHamiltonian:
    """Inertia, viscous friction, gear and gravity; dry friction, which turns over at
    0.02 rad/s, and a constant torque beside them if it is not the base model.
    """
    friction, torque = f"d{i}", f"{RATIOS[i - 1]}*u{i}" + GRAVITY.get(i, "").format(i=i)
    if not is_base:
        friction += f" + f{i}*(dH_dp{i}**4 + 0.02**4)**(-0.25)"
        torque += f" - c{i}"
    others = [f"q{k}" for k in JOINTS if k != i and f"q{k}" in torque]
    model = ph.PseudoHamiltonian(
        states=[f"q{i}", f"p{i}"],
        inputs=[f"u{i}", *others],
        S=ph.canonical(1),
        H=f"p{i}**2/(2*J{i})",
        R={f"p{i}": friction},
        F={f"p{i}": torque},
    )
    rough = {f"{name}{i}": values[i - 1] for name, values in ROUGH.items()}
    return model.with_values({name: rough[name] for name in model.values})


def joints(is_base: bool = False) -> list[ph.PseudoHamiltonian]:
    """A model of each."""
    return [joint(i, is_base) for i in JOINTS]


def joined(models: Sequence[ph.Model]) -> ph.PseudoHamiltonian:
    """One model, in which the angles are states."""
    return ph.PseudoHamiltonian(
        states=[state for model in models for state in model.states],
        inputs=[model.inputs[0] for model in models],
        S=block_diag(*(model.S for model in models)),
        H=sum((model.H for model in models[1:]), models[0].H),
        R={x: terms for model in models for x, terms in model.R.items()},
        F={x: terms for model in models for x, terms in model.F.items()},
        memory=[state for model in models for state in model.memory],
    )


def data(model: ph.Model, records: Sequence[Record]) -> ph.Measurements:
    """What the records have of the joint of a model, and of the angles it takes."""
    own, *others = (int(name[1:]) - 1 for name in model.inputs)
    angles = dict.fromkeys([model.states[0], *model.inputs[1:]], "rad")
    return ph.Measurements.from_arrays(
        [STEP * np.arange(len(q)) for q, _ in records],
        [with_unmeasured(q[:, own], n=model.n_states - 1) for q, _ in records],
        [np.c_[u[:, own], q[:, others]] for q, u in records],
        states=model.states,
        inputs=model.inputs,
        hold="cubic",
        units=angles | {model.inputs[0]: "N m", "t": "s"},
    )


def each_fitted(models: Sequence[ph.Model], train: Sequence[Record]) -> list[ph.Model]:
    """Each joint by maximum likelihood."""
    records = moving(train[FITTED], WINDOW)
    return [ph.identify(model, data(model, records)).model for model in models]


def fitted(models: Sequence[ph.Model], train: Sequence[Record]) -> ph.Model:
    """The robot of the fitted joints."""
    return joined(each_fitted(models, train))


def study(
    models: Sequence[ph.Model], train: Sequence[Record]
) -> tuple[list[ph.Model], list[str]]:
    """The models after a study of each joint, and the effects that were added."""
    first, second = (moving(train[part], WINDOW) for part in (STUDIED, HELD_OUT))
    found: list[ph.Model] = []
    added: list[str] = []
    for model in each_fitted(models, train):
        of_joint = ph.Study(model, data(model, first), held_out=data(model, second))
        of_joint.auto()
        found.append(of_joint.model)
        added += list(of_joint.history["effect"][1:])
    return found, added


def error(model: ph.Model, records: Sequence[Record], n_first: int) -> float:
    """Root mean square error (deg) of free runs; each begins at the last of the first
    samples, with the angles and velocities there.
    """
    places = [model.states.index(f"q{i}") for i in JOINTS]
    squares = []
    for q, u in records:
        q, u, before = q[n_first - 1 :], u[n_first - 1 :], q[n_first - 3 : n_first]
        start = np.zeros(model.n_states)
        start[places] = q[0]
        rates = np.array([0.5, -2, 1.5]) @ before / STEP
        for i, rate in zip(JOINTS, rates, strict=True):
            start[model.states.index(f"p{i}")] = model.values[f"J{i}"] * rate
        found = free_run(model, STEP * np.arange(len(q)), start, u, "cubic")
        squares.append(((found[:, places] - q)[1:] ** 2).ravel())
    return float(np.rad2deg(np.sqrt(np.mean(np.concatenate(squares)))))
