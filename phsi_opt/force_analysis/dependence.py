"""What a missing force follows: the state, input, pair of states or time that predicts
it best.

Whether it follows a variable is judged on stretches of time that were left out: a
function of that variable is fitted to the other stretches and has to predict the force
on these, so that nothing is earned by flexibility. The estimate is smooth where the
record is noisy, dry friction has lost its corners; so a function is looked at as the
same estimate would show it.

What to keep in mind: parameters of the model were fitted without the effect and have
imitated what they could of it. Dry friction comes as friction less the damping that
stood in for it, a cubic spring as the cubic less a linear one. So the model's
parameters move along here: what other values of them would explain is counted apart,
under 'parameters'. Size and sign of the force in the tables are those of the
difference.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.stats import rankdata

from phsi_opt.criteria import NAMED_CAUSE
from phsi_opt.force_analysis.force_record import ForceRecord, spectrum
from phsi_opt.statistics import TINY, local_maxima

N_FOLDS, N_STRETCHES = (
    5,
    40,
)  # the record is cut into stretches; every fifth is left out in turn
N_KNOTS, N_PAIR_KNOTS, N_TIME_KNOTS = (
    12,
    7,
    6,
)  # of piecewise linear functions of one variable, of two, of the time
RIDGE = 1e-3  # weight of the smallness of coefficients, in samples per knot
MOST_PAIRS = 6  # pairs of states that are looked at
# intervals (drawn at random where there are more) on which a frequency is refined
SCANNED = 3000


def depends_on(path: ForceRecord) -> pd.DataFrame:
    """What every missing force follows, best first: equation, variable, share,
    explained.

    ``variable`` is a state, an effort that is not a monotone function of a state, an
    input, the time ``t`` (slow changes, and a wave with its second harmonic, of one
    phase in all trajectories), or a pair of states ('q, p'). ``share`` is the part of
    the force's variance, beside what the model's own parameters would explain, that a
    piecewise linear function of the variable predicts on stretches of time that were
    left out; 0 where it predicts worse than the mean. Two rows stand behind the
    variables that add a tenth to them: 'constant' and 'parameters', with the parts of
    the mean square that the mean alone, and other values of the model's parameters
    alone, predict. ``explained`` is the rms of what is predicted, of the mean and the
    parameters as well.
    """
    return pd.concat(
        [dependence(path, name) for name in path.equations], ignore_index=True
    )


def dependence(path: ForceRecord, equation: str) -> pd.DataFrame:
    """`depends_on` for one equation."""
    w, fold, base = (
        path.force_on(equation),
        folds(path.run),
        path.by_parameters(equation),
    )
    total, mean = float(np.sum(w**2)), path.as_estimated(equation, np.ones((len(w), 1)))
    constant = left_out([mean], w, fold)
    rows = [("constant", share_of(constant, total), constant, NAMED_CAUSE)]
    left, fixed = constant, [mean]
    if base.shape[1]:
        parameters = left_out([base], w, fold)
        rows.append(
            ("parameters", share_of(parameters, total), parameters, NAMED_CAUSE)
        )
        if (both := left_out([mean, base], w, fold)) < left:
            left, fixed = both, [mean, base]
    rows.sort(key=lambda row: row[2])
    for variable in variables(path, equation):
        if variable == "t":
            error = left_out_of_time(path, fixed, w, fold)
        else:
            error = left_out(
                [*fixed, path.as_estimated(equation, _functions(path, variable))],
                w,
                fold,
            )
        error = min(error, left)
        rows.append(
            (
                variable,
                share_of(error, left),
                error,
                (left - error) / max(total, TINY),
            )
        )
    frame = pd.DataFrame(rows, columns=["variable", "share", "error", "adds"])
    frame.insert(0, "equation", equation)
    frame["explained"] = np.sqrt(np.maximum(total - frame.pop("error"), 0.0) / len(w))
    return frame.sort_values("adds", ascending=False, kind="stable").drop(
        columns="adds"
    )


def variables(path: ForceRecord, equation: str) -> list[str]:
    """Names of what the force of an equation may follow; its own effort and position
    come first.
    """
    model = path.fit.model
    single = [name for name in model.states if np.ptp(path.variable(name)) > 0]
    ranks = [_ranks(path.variable(name)) for name in single]
    for name in model.efforts:
        rank = _ranks(path.variable(name))
        if np.ptp(path.variable(name)) > 0 and not any(
            abs(rank @ other) > 0.9999 for other in ranks
        ):
            single.append(name)
            ranks.append(rank)
    moving = [name for name in model.inputs if np.ptp(path.variable(name)) > 0]
    states = [name for name in single if name in model.states]
    pairs = [f"{a}, {b}" for i, a in enumerate(states) for b in states[i + 1 :]]
    own = [pair for pair in pairs if equation in pair.split(", ")]
    return [
        *single,
        *moving,
        "t",
        *(own + [p for p in pairs if p not in own])[:MOST_PAIRS],
    ]


def _ranks(z: np.ndarray) -> np.ndarray:
    """Centred ranks of length 1, of at most 2000 of the values: their product is the
    rank correlation.
    """
    rank = rankdata(z[:: max(1, len(z) // 2000)])
    rank = rank - rank.mean()
    return np.asarray(rank / max(float(np.linalg.norm(rank)), TINY))


def folds(run: np.ndarray) -> np.ndarray:
    """Which of the folds leaves each interval out: stretches of each trajectory, dealt
    in turn.
    """
    count = np.bincount(run)
    n_stretches = np.clip(
        np.round(N_STRETCHES * count / len(run)), 1, np.maximum(count, 1)
    ).astype(int)
    place = np.arange(len(run)) - (np.cumsum(count) - count)[run]
    before = np.cumsum(n_stretches) - n_stretches
    return np.asarray((before[run] + place * n_stretches[run] // count[run]) % N_FOLDS)


def left_out(columns: Sequence[np.ndarray], w: np.ndarray, fold: np.ndarray) -> float:
    """Sum of squares that a least-squares fit to the other stretches leaves on those
    left out.
    """
    joined = np.hstack(columns)
    parts = [(joined[fold == f], w[fold == f]) for f in np.unique(fold)]
    grams, slopes = (
        [part.T @ part for part, _ in parts],
        [part.T @ y for part, y in parts],
    )
    error = 0.0
    for i, (part, y) in enumerate(parts):
        c = _solved(sum(grams) - grams[i], sum(slopes) - slopes[i])
        error += float(np.sum((y - part @ c) ** 2))
    return error


def _solved(gram: np.ndarray, slope: np.ndarray) -> np.ndarray:
    weight = RIDGE * np.trace(gram) / max(len(gram), 1) + TINY
    return np.asarray(np.linalg.solve(gram + weight * np.eye(len(gram)), slope))


def share_of(error: float, total: float) -> float:
    """Part of the total that is not error; zero where there is more error than that."""
    return max(0.0, 1 - error / total) if total > 0 else 0.0


def cleaned(path: ForceRecord, equation: str, variable: str) -> np.ndarray:
    """The force less what the model's parameters explain beside functions of the
    variable: what to plot against it.
    """
    w, functions, base = (
        path.force_on(equation),
        _functions(path, variable),
        path.by_parameters(equation),
    )
    functions = path.as_estimated(equation, functions)
    beside = base - functions @ np.linalg.lstsq(functions, base, rcond=1e-6)[0]
    joint = np.hstack([functions, beside])
    c = np.linalg.lstsq(joint, w, rcond=1e-6)[0]
    return np.asarray(w - beside @ c[functions.shape[1] :])


def _functions(path: ForceRecord, variable: str) -> np.ndarray:
    names = variable.split(", ")
    if len(names) == 1:
        return hats(path.variable(variable), N_KNOTS)
    return pair_of(path.variable(names[0]), path.variable(names[1]))


def left_out_of_time(
    path: ForceRecord, fixed: Sequence[np.ndarray], w: np.ndarray, fold: np.ndarray
) -> float:
    """As `_left_out`, with functions of the time whose frequency is found anew for
    every fold.
    """
    error = 0.0
    for f in np.unique(fold):
        kept, columns = fold != f, np.hstack([*fixed, of_time(path, w, fold != f)])
        c = _solved(columns[kept].T @ columns[kept], columns[kept].T @ w[kept])
        error += float(np.sum((w[~kept] - columns[~kept] @ c) ** 2))
    return error


def _knots(z: np.ndarray, n_knots: int) -> np.ndarray:
    """Half way between even spacing and even occupation; the extreme hundredths share
    the outer knots.
    """
    share = np.linspace(0.01, 0.99, n_knots)
    quantiles = np.quantile(z, share)
    return np.asarray(
        np.unique((quantiles + np.linspace(quantiles[0], quantiles[-1], n_knots)) / 2)
    )


def hats(z: np.ndarray, n_knots: int) -> np.ndarray:
    """Piecewise linear functions of z, constant beyond the outer knots, as columns that
    sum to one.
    """
    knots = _knots(z, n_knots)
    if len(knots) < 2:
        return np.ones((len(z), 1))
    right = np.clip(np.searchsorted(knots, z), 1, len(knots) - 1)
    fraction = np.clip((z - knots[right - 1]) / (knots[right] - knots[right - 1]), 0, 1)
    columns = np.zeros((len(z), len(knots)))
    columns[np.arange(len(z)), right - 1] = 1 - fraction
    columns[np.arange(len(z)), right] += fraction
    return columns


def pair_of(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of piecewise linear functions of two variables."""
    of_a, of_b = hats(a, N_PAIR_KNOTS), hats(b, N_PAIR_KNOTS)
    return np.asarray((of_a[:, :, None] * of_b[:, None, :]).reshape(len(a), -1))


def of_time(path: ForceRecord, w: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Slow functions of the time, and the wave (with its second harmonic) that fits
    best where ``kept``.
    """
    phase = 2 * np.pi * wave_of(path, w, kept) * (path.t - path.t[0])
    waves = [f(n * phase) for n in (1, 2) for f in (np.sin, np.cos)]
    return np.column_stack([hats(path.t, N_TIME_KNOTS), *waves])


def wave_of(path: ForceRecord, w: np.ndarray, kept: np.ndarray) -> float:
    """Frequency of the wave that fits best where ``kept``, in cycles per unit of time,
    one phase in all runs.
    """
    left = np.where(kept, w - w[kept].mean(), 0.0)
    f, amplitude = spectrum(path.t, path.run, left)
    peaks = f[np.argsort(-amplitude * local_maxima(amplitude))[:3]]
    rng, places = np.random.default_rng(0), np.flatnonzero(kept)
    chosen = (
        places
        if len(places) <= SCANNED
        else np.sort(rng.choice(places, SCANNED, replace=False))
    )
    t, y = path.t[chosen] - path.t[0], left[chosen]
    width = 4 * (f[1] - f[0]) if len(f) > 1 else 0.0  # one resolved frequency
    for reach in (1.0, 0.1):  # about the peaks, then about the best
        tried = np.concatenate(
            [peak + reach * width * np.linspace(-1, 1, 21) for peak in peaks]
        )
        tried = tried[tried > 0] if (tried > 0).any() else peaks
        peaks = tried[[int(np.argmax(_fall(t, y, tried)))]]
    return float(peaks[0])


def _fall(t: np.ndarray, y: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Fall of the sum of squares of y by a wave of each frequency."""
    phase = 2 * np.pi * np.outer(f, t)
    s, c = np.sin(phase), np.cos(phase)
    ss, cc, sc = np.sum(s * s, axis=1), np.sum(c * c, axis=1), np.sum(s * c, axis=1)
    a, b = s @ y, c @ y
    determinant = np.maximum(ss * cc - sc**2, 1e-9 * ss * cc + TINY)
    return np.asarray((a**2 * cc - 2 * a * b * sc + b**2 * ss) / determinant)


def leading(found: pd.DataFrame, equation: str) -> pd.Series | None:
    """The row of `depends_on` to name: the best variable, a single one where a pair of
    states is hardly better.
    """
    listed = found[
        (found["equation"] == equation)
        & ~found["variable"].isin(["constant", "parameters"])
    ]
    good = listed[listed["share"] > listed["share"].max() - NAMED_CAUSE]
    alone = good[~good["variable"].str.contains(",")]
    return (alone if len(alone) else good).iloc[0] if len(good) else None
