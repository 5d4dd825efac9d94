"""The case of a kind and a seed: drawn anew, from the same generator, until the hidden
effect shows.

The noise goes through its levels from seed to seed; every case has a disturbance that
no effect of the catalogue is, unless it is asked for without (a test), or has noise
that lasts in its stead.
"""

import zlib

import numpy as np

from problems.field_machines import disturbances
from problems.field_machines.kinds import NOISE_LEVELS, Kind, coloured
from problems.field_machines.records import Case, Experiment
from problems.field_machines.sensing import Sensing, measured
from problems.field_machines.sizes import Sized, Sizing
from problems.hidden_effects.truth import RunawayError

ATTEMPTS = 60  # experiments drawn, before a case is given up
BESIDE = (disturbances.RANDOM_FORCE, disturbances.FUNCTION)
COLOURED = "coloured noise"


def draw(kind: Kind, seed: int, model_error: float | None = None) -> Case:
    """The case of a kind and a seed.

    ``model_error``: in place of that of the kind.

    Raises:
        ArithmeticError: no experiment shows the effect.
    """
    rng = np.random.default_rng([zlib.crc32(kind.name.encode()), seed])
    model_error = kind.model_error if model_error is None else model_error
    noise = NOISE_LEVELS[seed % len(NOISE_LEVELS)]
    for _ in range(ATTEMPTS):
        which = int(rng.integers(len(kind.draws)))
        e = kind.draws[which](rng)
        beside = str(rng.choice(BESIDE))
        how = kind.sensing(rng, noise)
        if kind.is_complete and rng.random() < 1 / 3:
            beside = disturbances.NONE
            how = coloured(noise)
        sizing = Sizing(e, rng, noise, beside, model_error)
        try:
            sized = sizing.without_effect() if kind.is_complete else sizing.sized()
        except RunawayError:
            continue
        if sized is not None:
            return _case(kind, seed, e, sized, how, rng)
    raise ArithmeticError(
        f"kind {kind.name!r}, seed {seed}: "
        f"no experiment shows the effect in {ATTEMPTS} attempts."
    )


def _case(
    kind: Kind,
    seed: int,
    e: Experiment,
    sized: Sized,
    how: Sensing,
    rng: np.random.Generator,
) -> Case:
    """The measurements of an experiment, and the model that they are given with."""
    train, test = measured(rng, e, sized.motion, how)
    starts = {}
    for name, value in e.values.items():
        starts[name] = value * kind.start(rng)
    nothing_to_name = kind.is_complete or e.is_faint
    hidden = "nothing" if kind.is_complete else e.hidden.name
    if e.is_faint:
        hidden = f"{hidden}, below the noise"
    return Case(
        kind=kind.name,
        seed=seed,
        model=e.model(starts),
        train=train,
        test=test,
        truths=() if nothing_to_name else e.hidden.truths,
        size=sized.size,
        hidden=hidden,
        noise=how.noise,
        disturbance=COLOURED if how.memory else sized.kind,
        ratio=sized.ratio,
        disturbed=sized.disturbed,
        settings=_settings(e, how),
    )


def _settings(e: Experiment, how: Sensing) -> dict[str, object]:
    """What is kept of an experiment in the tables."""
    sensor = "fine"
    if how.n_steps:
        sensor = f"{how.n_steps:.0f} steps"
    if how.is_uneven:
        sensor = "uneven noise"
    return {
        "measured": " ".join(e.states[k] for k in e.seen),
        "inputs": " ".join(e.inputs),
        "free": " ".join(e.values),
        "n_train": int(e.kept[:, : e.n_train].sum()),
        "sensor": sensor,
    }
