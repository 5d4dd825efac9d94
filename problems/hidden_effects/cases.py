"""The cases of the battery: a machine with a hidden effect, its data, and the
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
from dataclasses import replace
from itertools import combinations

import numpy as np

from problems.hidden_effects.calibration import (
    LOUDEST_OF_SIGNAL,
    Calibrated,
    calibrated,
    ratio_of,
    shows_held_out,
    training_samples,
)
from problems.hidden_effects.expectation import truth_of
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
    Aim,
    Case,
    Draw,
    Row,
)
from problems.hidden_effects.samples import HELD_OUT, TRAINING, Samples
from problems.hidden_effects.sizes import drawn_shape, place_of_effect
from problems.hidden_effects.tanks import tanks_case
from problems.hidden_effects.truth import Hidden, RunawayError, measured

INPUTS = {"linear": "multisine", "zero": "steps"}  # by how they are held


def draw(row: Row, seed: int) -> Case:
    """The case of a row and a seed; drawn anew, from the same generator, until the
    effect shows.

    Raises:
        ArithmeticError: no experiment shows the effect.
    """
    rng = np.random.default_rng([zlib.crc32(row.name.encode()), seed])
    kinds = {"tanks": tanks_case, "nothing": _nothing_case, "two": _two_case}
    case_of = kinds.get(row.kind, _one_case)
    for attempt in range(ATTEMPTS):
        noise = float(rng.choice(row.noise))
        loudest = min(LOUDEST, OF_SIGNAL / noise)
        target = float(log_uniform(rng, QUIETEST, loudest))
        least = QUIETEST if attempt < PATIENCE else FAINTEST
        try:
            case = case_of(Draw(row, seed, rng, Aim(noise, target, least)))
        except RunawayError:
            continue
        if case is not None:
            return case
    raise ArithmeticError(
        f"row {row.name!r}, seed {seed}: "
        f"no experiment shows the effect in {ATTEMPTS} attempts."
    )


def _one_case(draw: Draw) -> Case | None:
    name = str(draw.rng.choice(draw.row.effects))
    setting = draw_setting(draw.rng, (name,))
    found = _placed(draw, name, setting)
    if found is None:
        return None
    return _case(draw, setting, (found.hidden,), found.ratio)


def _nothing_case(draw: Draw) -> Case | None:
    setting = draw_setting(draw.rng, ())
    quiet = replace(draw, aim=replace(draw.aim, target=1.0))
    return _case(quiet, setting, (), ratio=1.0)


def _two_case(draw: Draw) -> Case | None:
    """Two effects, each of which alone meets the target; errors of both together are
    computed once more.
    """
    pairs = list(combinations(draw.row.effects, 2))
    names = pairs[draw.rng.integers(len(pairs))]
    setting = draw_setting(draw.rng, names)
    both = []
    for name in names:
        found = _placed(draw, name, setting)
        if found is None:
            return None
        both.append(found.hidden)
    hidden = tuple(both)
    error = Refit(setting).error(training_samples(hidden, setting))
    if not error < LOUDEST_OF_SIGNAL:
        return None
    return _case(draw, setting, hidden, ratio_of(error, draw.aim))


def _placed(draw: Draw, name: str, s: Setting) -> Calibrated | None:
    """An effect at a random place, at the size that meets the aim."""
    at = place_of_effect(draw.rng, name, s)
    shape = drawn_shape(draw.rng, name, at, s)
    return calibrated(Hidden(name, at, 0.0, shape), s, draw.aim)


def _case(
    draw: Draw, s: Setting, hidden: tuple[Hidden, ...], ratio: float
) -> Case | None:
    """The case of a setting with its effects; None where they do not show held out.

    ``ratio``: free-run error over the noise floor, as calibrated.
    """
    shown = measured(s.machine, hidden, s.starts, s.drive, s.t)
    y = np.moveaxis(shown, 0, 1)  # (n_runs, n_times, n_states)
    seen = list(s.seen)
    without = np.moveaxis(s.nominal, 0, 1)
    if hidden and not shows_held_out(y[..., seen], without[..., seen], N_TRAIN):
        return None
    noise = draw.aim.noise
    samples = Samples.drawn(draw.rng, y, noise, s.t, s.states, s.seen, s.drive)
    return Case(
        row=draw.row,
        seed=draw.seed,
        model=model_of(s, draw.rng),
        train=samples.noisy(TRAINING),
        test=samples.noisy(HELD_OUT),
        clean=samples.without_noise(TRAINING),
        sigma=samples.sigma,
        test_noise=samples.noise[HELD_OUT],
        noise=noise,
        truths=tuple(truth_of(effect, s) for effect in hidden),
        settings=_settings(s),
        target=draw.aim.target,
        base_ratio=ratio,
    )


def _settings(s: Setting) -> dict[str, object]:
    """What is kept of a setting in the tables."""
    known = [name for name in s.present if name not in s.free]
    return {
        "masses": s.machine.n,
        "measured": "qp" if len(s.seen) == len(s.states) else "q",
        "input": "none" if s.drive is None else INPUTS[s.drive.hold],
        "free": " ".join(s.free),
        "known": " ".join(known),
        "n_train": N_TRAIN * len(s.t),
    }
