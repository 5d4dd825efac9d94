"""The cases of `hidden_effects`: a machine with a hidden effect, its data, and the
model that does not know of it.

A case is drawn from its row and seed: one or two masses, parameters within a factor of
three, starts, input, measured channels, noise. The size of the effect is then set so
that the best re-fit of the model without it has a free-run error of a given multiple of
the noise floor, log-uniform from 3 to 30. The re-fit is least squares on the noise-free
samples (Levenberg and Marquardt over the free parameters and starting states; slopes by
differences, all variations integrated together), so that calibrating costs less than
the diagnosis. Where the target would ask for more than the effect can physically be
(`LIMITS`: a dead zone of 80 % of the input, friction that stops the machine within a
period), the effect has the largest size allowed if that still shows three times the
floor; otherwise the case is drawn anew. The error is also kept below 0.7 of the
signal's own standard deviation: at 10 % noise that is 7 times the floor, and 30 times
would be a machine that has nothing in common with its model. Some effects hardly reach
three times a floor of 10 % at all (drag beside a damper that is free): after `PATIENCE`
experiments drawn in vain, 1.5 times is enough.
"""

import zlib
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np

import phsi_opt as ph
from problems.hidden_effects.calibration import calibrated, rounded, shows_held_out
from problems.hidden_effects.machines import (
    Setting,
    draw_setting,
    log_uniform,
    model_of,
)
from problems.hidden_effects.refit import Refit
from problems.hidden_effects.rows import (
    ATTEMPTS,
    FAINTEST,
    LOUDEST,
    N_TRAIN,
    OF_SIGNAL,
    PATIENCE,
    QUIETEST,
    STEPS,
    Aim,
    Case,
    Row,
    Truth,
)
from problems.hidden_effects.sizes import drawn_shape, place_of_effect
from problems.hidden_effects.tanks import tanks_case
from problems.hidden_effects.truth import SENSORS, Array, Hidden, RunawayError, measured


def draw(row: Row, seed: int) -> Case:
    """The case of a row and a seed; drawn anew, from the same generator, until the
    effect shows.
    """
    rng = np.random.default_rng([zlib.crc32(row.name.encode()), seed])
    made = {"tanks": tanks_case, "nothing": _nothing_case, "two": _two_case}.get(
        row.kind, _one_case
    )
    for attempt in range(ATTEMPTS):
        noise = float(rng.choice(row.noise))
        loudest = min(LOUDEST, OF_SIGNAL / noise)
        target = float(log_uniform(rng, QUIETEST, loudest))
        try:
            case = made(
                row,
                seed,
                rng,
                Aim(noise, target, QUIETEST if attempt < PATIENCE else FAINTEST),
            )
        except RunawayError:
            continue
        if case is not None:
            return case
    raise ArithmeticError(
        f"row {row.name!r}, seed {seed}: no experiment shows the effect in {ATTEMPTS} "
        "attempts."
    )


def _one_case(row: Row, seed: int, rng: np.random.Generator, aim: Aim) -> Case | None:
    name = str(rng.choice(row.effects))
    setting = draw_setting(rng, (name,))
    at = place_of_effect(rng, name, setting)
    found = calibrated(
        Hidden(name, at, 0.0, drawn_shape(rng, name, at, setting)), setting, aim
    )
    return (
        None
        if found is None
        else _made(row, seed, rng, aim, setting, (found[0],), found[1])
    )


def _nothing_case(
    row: Row, seed: int, rng: np.random.Generator, aim: Aim
) -> Case | None:
    return _made(
        row, seed, rng, replace(aim, target=1.0), draw_setting(rng, ()), (), 1.0
    )


def _two_case(row: Row, seed: int, rng: np.random.Generator, aim: Aim) -> Case | None:
    """Two effects, each of which alone meets the target; errors of both together are
    computed once more.
    """
    pairs = list(combinations(row.effects, 2))
    names = pairs[rng.integers(len(pairs))]
    setting = draw_setting(rng, names)
    both = []
    for name in names:
        at = place_of_effect(rng, name, setting)
        found = calibrated(
            Hidden(name, at, 0.0, drawn_shape(rng, name, at, setting)), setting, aim
        )
        if found is None:
            return None
        both.append(found[0])
    drive = setting.drive and replace(
        setting.drive, values=setting.drive.values[:N_TRAIN]
    )
    blunt = tuple(rounded(hidden) for hidden in both)
    y = measured(
        setting.machine, blunt, setting.starts[:N_TRAIN], drive, setting.t, 2 * STEPS
    )
    error = Refit(setting).error(y)
    ratio = float(np.sqrt(1 + (error / aim.noise) ** 2))
    return (
        _made(row, seed, rng, aim, setting, tuple(both), ratio)
        if error < 1.3 * OF_SIGNAL
        else None
    )


def _made(
    row: Row,
    seed: int,
    rng: np.random.Generator,
    aim: Aim,
    s: Setting,
    hidden: tuple[Hidden, ...],
    ratio: float,
) -> Case | None:
    y = np.moveaxis(
        measured(s.machine, hidden, s.starts, s.drive, s.t), 0, 1
    )  # (n_runs, n_times, n_states)
    if hidden and not shows_held_out(
        y[..., list(s.seen)], np.moveaxis(s.nominal, 0, 1)[..., list(s.seen)], N_TRAIN
    ):
        return None
    deviation = aim.noise * y[:N_TRAIN].std(axis=(0, 1))
    unseen = [k for k in range(y.shape[-1]) if k not in s.seen]
    noises = deviation * rng.normal(size=y.shape)
    y[..., unseen] = np.nan
    settings = {
        "masses": s.machine.n,
        "measured": "qp" if not unseen else "q",
        "input": "none"
        if s.drive is None
        else {"linear": "multisine", "zero": "steps"}[s.drive.hold],
        "free": " ".join(s.free),
        "known": " ".join(name for name in s.present if name not in s.free),
        "n_train": N_TRAIN * len(s.t),
    }
    u = None if s.drive is None else [run[:, None] for run in s.drive.values]
    hold = "linear" if s.drive is None else s.drive.hold

    def data(runs: Array, chosen: slice, sigma: Array | None = None) -> ph.Measurements:
        given = (
            None if sigma is None else {s.states[k]: float(sigma[k]) for k in s.seen}
        )
        return ph.Measurements.from_arrays(
            [s.t] * len(runs[chosen]),
            list(runs[chosen]),
            None if u is None else u[chosen],
            states=s.states,
            inputs=None if u is None else ["u"],
            hold=hold,
            noise=given,
            names=[f"run {i + 1}" for i in range(len(runs))][chosen],
        )

    train, test = slice(0, N_TRAIN), slice(N_TRAIN, None)
    return Case(
        row,
        seed,
        model_of(s, rng),
        data(y + noises, train),
        data(y + noises, test),
        data(y, train, deviation),
        deviation,
        noises[test],
        aim.noise,
        tuple(_truth(h, s) for h in hidden),
        settings,
        aim.target,
        ratio,
    )


# What the catalogue's coefficient is in terms of the size; where it counts something
# else, none is compared.
COEFFICIENTS: dict[str, Callable[[Hidden], float]] = {
    **dict.fromkeys(
        (
            "viscous damping",
            "coulomb friction",
            "quadratic drag",
            "cubic drag",
            "position-dependent damping",
            "linear stiffness",
            "cubic stiffness",
            "coupling stiffness",
            "gap",
            "harmonic force",
            "parametric stiffness",
            "input dead zone",
            "input lag",
            "input delay",
            "sensor delay",
        ),
        lambda h: h.size,
    ),
    **dict.fromkeys(
        (
            "quadratic stiffness",
            "gravity torque",
            "constant force",
            "drifting force",
            "input gain",
            "quadratic input",
            "sensor offset",
            "sensor gain",
            "sensor drift",
        ),
        lambda h: h.shape["sign"] * h.size,
    ),
    "hysteresis": lambda h: (
        h.size / (h.shape["beta"] + h.shape["gamma"])
    ),  # the force where it has yielded
    "input saturation": lambda h: (1 - h.size) * h.shape["largest"],
    "sensor clipping": lambda h: (1 - h.size) * h.shape["largest"],
}


def _truth(hidden: Hidden, s: Setting) -> Truth:
    n = s.machine.n
    if hidden.name in SENSORS:
        equations: tuple[str, ...] = (s.states[hidden.at],)
    elif hidden.name == "coupling stiffness":  # the spring pulls at both
        equations = s.states[n:]
    else:
        equations = (s.states[n + hidden.at],)
    return Truth(
        hidden.name, equations, COEFFICIENTS.get(hidden.name, lambda h: np.nan)(hidden)
    )
