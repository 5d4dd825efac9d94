"""Which experiment would tell two fitted models apart that the record does not.

The first model is taken for the truth. It is simulated in experiments derived from the
record, and the second model imitates it as well as it can: its parameters and starting
states are re-fitted to the record and the experiment together, by a few Gauss-Newton
steps within their bounds. What is left, over the noise, is the separation: a difference
that re-fitting removes does not count. Where the second model imitates the first
everywhere (it may contain it), the two change places.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np
import pandas as pd

from phsi_opt.comparison.compare import compare
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.model import Model
from phsi_opt.model.structure import position_rows
from phsi_opt.simulation.free_run import Runs, rates
from phsi_opt.statistics import TINY

FURTHER = (
    0.25,
    0.5,
    2.0,
    3.0,
)  # starts, in distances of the record's start from its mean
LOUDER = (0.5, 2.0, 3.0)  # inputs, in those of the record
FASTER = (0.3, 1.0, 3.0)  # sines, in dominant frequencies of the record
LONGER = 3
SHIFT = 2.0  # another start of a position, in its standard deviations
# of the spread: a start nearer to the mean than this cannot be put further out
SHARE_OF_START = 0.05
# standard deviations of the whole experiment from which two models count as told apart
SEPARATED = 5.0
ALIKE = 1e-3  # standard deviations per value below which two predictions are the same
LONGEST = 1000  # samples of the record that are looked at
ROUNDS, SHRINKING = (
    8,
    (1.0, 0.25, 0.05),
)  # Gauss-Newton steps; shares of a step that are tried
SETTLED = 0.05  # relative fall of the misfit at which they end
Slopes = tuple[
    np.ndarray, np.ndarray
]  # values and their slopes, (n,) and (n, n_unknowns)


@dataclass(frozen=True, eq=False)
class Separation:
    """The experiments that were tried, best first.

    ``table``: experiment, separation (root mean square of the difference that
    re-fitting leaves, in standard deviations of the noise, per value measured),
    separates. ``in_record``: the same in the record itself.
    """

    table: pd.DataFrame = field(repr=False)
    in_record: float
    alike: bool

    @property
    def sentence(self) -> str:
        """The best experiment in words."""
        if self.table.empty:
            return "no experiment could be simulated with both models"
        best = self.table.iloc[0]
        if self.alike:
            return "no experiment of those tried separates them: they are the same model in other words"
        size = f"{best['separation']:.2g} noise standard deviations"
        if not best["separates"]:
            return f"no experiment of those tried separates them; the best is {best['experiment']}, by {size}"
        return f"{best['experiment']}: the two predictions then differ by {size}; in this record by {self.in_record:.2g}."

    def __str__(self) -> str:
        shown = self.table.to_string(index=False, float_format=lambda v: f"{v:.3g}")
        return f"{self.sentence}\n{shown}"

    __repr__ = __str__


@dataclass(frozen=True, eq=False)
class Experiment:
    """One experiment: times, inputs (as in the data), measured states, and how the
    start of the record is changed.

    The start becomes centre + stretch (start - centre) + shift, for the states that
    ``centre`` names.
    """

    name: str
    t: np.ndarray
    u: np.ndarray
    seen: tuple[str, ...]
    stretch: float = 1.0
    centre: Mapping[str, float] = field(default_factory=dict)
    shift: Mapping[str, float] = field(default_factory=dict)

    def start(self, model: Model, x0: np.ndarray) -> np.ndarray:
        """The model's starting state in this experiment, from that in the record."""
        moved = x0.copy()
        for name, centre in self.centre.items():
            k = model.index(name)
            moved[k] = centre + self.stretch * (x0[k] - centre)
        for name, by in self.shift.items():
            moved[model.index(name)] += by
        return moved


def separating(
    first: Fit, second: Fit, data: Measurements, noise: np.ndarray
) -> Separation:
    """Look for an experiment that tells the fitted model ``second`` from ``first``,
    which is taken for the truth.

    Args:
        data: the measurements that both were fitted to; their longest trajectory (its
            first `LONGEST` samples) is what the experiments are derived from. States of
            a model that they do not hold count as not measured.
        noise: standard deviation of the measurement noise per state, in the order of
            the first model's states.

    Raises `DataError` where the noise of a measured state is not positive, `SolveError`
    where the record itself cannot be simulated with both models.
    """
    number = int(np.argmax([run.n_samples for run in data.trajectories]))
    noise_of = _noise_of(first.model, data, noise)
    sides = [_Imitation(fit, data, number) for fit in (first, second)]
    found = _one_way(sides[0], sides[1], data, number, noise_of)
    return (
        _one_way(sides[1], sides[0], data, number, noise_of) if found.alike else found
    )


def _one_way(
    truth: "_Imitation",
    other: "_Imitation",
    data: Measurements,
    number: int,
    noise: Mapping[str, float],
) -> Separation:
    run = data.trajectories[number]
    record = Experiment("the record", run.t[:LONGEST], run.u[:LONGEST], data.measured)
    shown = truth.shown(record, data.states)
    if shown is None:
        raise SolveError(_not_simulated(run.name, truth.model))
    spread = dict(zip(data.states, np.std(shown, axis=0), strict=True))
    misfit = _Misfit(
        truth, other, {**_noise_of_unmeasured(data, spread, noise), **noise}, spread
    )
    rest = misfit.in_record(record)
    if rest is None:
        raise SolveError(_not_simulated(run.name, other.model))
    rows = []
    for experiment in _experiments(record, data, truth.model, shown, truth.x0):
        left = misfit.left(experiment, rest)
        if left is not None:
            n = len(experiment.t) * len(experiment.seen)
            rows.append(
                (experiment.name, np.sqrt(left / n), bool(left >= SEPARATED**2))
            )
    table = pd.DataFrame(rows, columns=["experiment", "separation", "separates"])
    table = table.sort_values(
        "separation", ascending=False, kind="stable", ignore_index=True
    )
    in_record = float(np.sqrt(rest.left / (len(record.t) * len(record.seen))))
    return Separation(table, in_record, bool((table["separation"] < ALIKE).all()))


def _not_simulated(run: str, model: Model) -> str:
    return (
        f"trajectory {run!r} cannot be simulated by explicit steps with the model of {', '.join(model.free)}: it is "
        "stiff, or its solution ends; look for the experiment by `simulate` instead."
    )


def _noise_of(model: Model, data: Measurements, noise: np.ndarray) -> dict[str, float]:
    found = dict(
        zip(model.states, np.asarray(noise, dtype=float).tolist(), strict=False)
    )
    for name in data.measured:
        if not 0 < found.get(name, np.nan) < np.inf:
            raise DataError(
                f"noise of {name!r} is {found.get(name)!r}; expected a positive standard deviation per measured state, "
                "such as `Comparison.noise`."
            )
    return {name: found[name] for name in data.measured}


def _noise_of_unmeasured(
    data: Measurements, spread: Mapping[str, float], noise: Mapping[str, float]
) -> dict[str, float]:
    """What a further sensor would have: the same share of the spread as those there
    are, on average.
    """
    share = float(
        np.mean([noise[name] / max(spread[name], TINY) for name in data.measured])
    )
    return {
        name: share * spread[name]
        for name in data.states
        if name not in noise and spread[name] > 0
    }


class _Imitation:
    """A fitted model in a trajectory: what its sensors show in experiments, with slopes
    in parameters and start.
    """

    def __init__(self, fit: Fit, data: Measurements, number: int) -> None:
        self.model, self.hold = fit.model_of(data.trajectories[number].name), data.hold
        known = (
            fit.states
            if len(fit.states) == data.n_trajectories
            else compare(fit, data).simulated
        )
        self.x0 = known[number][0]
        self.inputs = [data.inputs.index(name) for name in self.model.inputs]
        self.theta = self.model.theta
        free = [self.model.entries[name].parameter for name in self.model.free]
        endless = np.full(self.model.n_states, np.inf)
        self.lower, self.upper = (
            np.r_[[p.lower for p in free], -endless],
            np.r_[[p.upper for p in free], endless],
        )

    @cached_property
    def _plain(self) -> tuple[Runs, ca.Function]:
        return Runs(rates(self.model)), self.model.output()

    @cached_property
    def _varied(self) -> tuple[Runs, ca.Function]:
        rhs, output = _varied(self.model)
        return Runs(rhs, self.model.n_states), output

    def shown(
        self, experiment: Experiment, names: Sequence[str], tolerance: float = 1e-4
    ) -> np.ndarray | None:
        """What sensors of the named states show, (n_samples, n_names); None where the
        model cannot be simulated.
        """
        runs, output = self._plain
        u, x0 = experiment.u[:, self.inputs], experiment.start(self.model, self.x0)
        x = runs.run(experiment.t, x0, u, self.hold, tolerance)
        if x is None:
            return None
        y = output.map(len(x))(
            x.T, u.T, experiment.t[None], np.tile(self.theta[:, None], len(x))
        )
        return np.asarray(y.full().T[:, [self.model.index(name) for name in names]])

    def predicted(
        self, experiment: Experiment, z: np.ndarray, tolerance: float
    ) -> Slopes | None:
        """Values of all measured states, sample by sample, and their slopes in z =
        (parameters, starting state).
        """
        n, p, u = self.model.n_states, len(self.theta), experiment.u[:, self.inputs]
        start = np.r_[z[p:], z[:p], np.hstack([np.zeros((n, p)), np.eye(n)]).T.ravel()]
        runs, output = self._varied
        x = runs.run(experiment.t, start, u, self.hold, tolerance)
        if x is None:
            return None
        y, slopes = output.map(len(x))(x.T, u.T, experiment.t[None])
        seen = [self.model.index(name) for name in experiment.seen]
        by_state = slopes.full().T.reshape(len(x), n + p, n)[:, :, seen]
        return np.asarray(y.full().T[:, seen].ravel()), by_state.transpose(
            0, 2, 1
        ).reshape(-1, n + p)


def _varied(model: Model) -> tuple[ca.Function, ca.Function]:
    """The model with its parameters and slopes as further states (x, theta, vec X), and
    what its sensors show of them.

    X = dx/d(theta, x0) obeys dX/dt = (df/dx) X + (df/dtheta, 0).
    """
    n, p = model.n_states, len(model.free)
    x, theta, X = ca.SX.sym("x", n), ca.SX.sym("theta", p), ca.SX.sym("X", n, p + n)
    u, t = ca.SX.sym("u", model.n_inputs), ca.SX.sym("t")
    every = ca.vertcat(x, theta, ca.vec(X))

    def followed(value: ca.SX) -> ca.SX:
        return ca.densify(
            ca.jacobian(value, x) @ X
            + ca.horzcat(ca.jacobian(value, theta), ca.SX(n, n))
        )

    f, y = model.rhs()(x, u, t, theta), model.output()(x, u, t, theta)
    rhs = ca.Function(
        "varied",
        [every, u, t],
        [ca.densify(ca.vertcat(f, ca.SX(p, 1), ca.vec(followed(f))))],
    )
    return rhs, ca.Function("shown", [every, u, t], [y, ca.vec(followed(y))])


@dataclass(frozen=True, eq=False)
class _Rest:
    """The record's misfit near the best imitation in it, as |value + slope (theta -
    theta0)|^2, and its least.
    """

    z: np.ndarray
    value: np.ndarray
    slope: np.ndarray
    left: float


class _Misfit:
    """Differences between the truth and its imitation, in standard deviations of the
    noise.
    """

    def __init__(
        self,
        truth: _Imitation,
        other: _Imitation,
        noise: Mapping[str, float],
        spread: Mapping[str, float],
    ) -> None:
        self.truth, self.other, self.noise = truth, other, noise
        share = min(noise[name] / max(spread[name], TINY) for name in noise)
        self.tolerance = float(
            np.clip(0.3 * share, 1e-6, 1e-3)
        )  # of the coarser run: the finer one is 30 times better

    def in_record(self, record: Experiment) -> _Rest | None:
        """The best imitation in the record; starting states of the record follow the
        parameters from then on.
        """
        other, p = self.other, len(self.other.theta)
        of = self._of(record)
        found = (
            None
            if of is None
            else _closest(of, np.r_[other.theta, other.x0], other.lower, other.upper)
        )
        if found is None:
            return None
        z, (r, slope) = found
        own, _ = np.linalg.qr(slope[:, p:])
        columns = np.column_stack([slope[:, :p], r])
        small = np.asarray(np.linalg.qr(columns - own @ (own.T @ columns), mode="r"))
        return _Rest(z, small[:, p], small[:, :p], float(r @ r))

    def left(self, experiment: Experiment, rest: _Rest) -> float | None:
        """Sum of squares that the experiment adds to the misfit of the best imitation
        in both; None: not simulated.
        """
        other, p = self.other, len(self.other.theta)
        of = self._of(experiment)
        if of is None:
            return None

        def both(z: np.ndarray) -> Slopes | None:
            here = of(z)
            if here is None:
                return None
            there = rest.value + rest.slope @ (z[:p] - rest.z[:p])
            slope = np.hstack([rest.slope, np.zeros((len(there), len(z) - p))])
            return np.r_[here[0], there], np.vstack([here[1], slope])

        start = np.r_[rest.z[:p], experiment.start(other.model, rest.z[p:])]
        found = _closest(both, start, other.lower, other.upper)
        return (
            None
            if found is None
            else max(float(found[1][0] @ found[1][0]) - rest.left, 0.0)
        )

    def _of(
        self, experiment: Experiment
    ) -> Callable[[np.ndarray], Slopes | None] | None:
        """Weighted differences of prediction and truth as a function of z, with slopes;
        None: no truth.
        """
        y = self.truth.shown(experiment, experiment.seen, self.tolerance)
        if y is None:
            return None
        weight = np.tile([1 / self.noise[name] for name in experiment.seen], len(y))

        def of(z: np.ndarray) -> Slopes | None:
            made = self.other.predicted(experiment, z, self.tolerance)
            return (
                None
                if made is None
                else (weight * (made[0] - y.ravel()), weight[:, None] * made[1])
            )

        return of


def _closest(
    of: Callable[[np.ndarray], Slopes | None],
    z: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> tuple[np.ndarray, Slopes] | None:
    """Least squares by Gauss-Newton steps within bounds, shortened until the misfit
    falls; None: no value at z.
    """
    z = np.clip(z, lower, upper)
    found = of(z)
    if found is None:
        return None
    for _ in range(ROUNDS):
        r, slope = found
        norms = np.linalg.norm(slope, axis=0)
        norms = np.where(norms > 0, norms, 1.0)
        step = -np.linalg.lstsq(slope / norms, r, rcond=1e-9)[0] / norms
        for share in SHRINKING:
            trial = np.clip(z + share * step, lower, upper)
            made = of(trial)
            if made is not None and made[0] @ made[0] < r @ r:
                break
        else:
            return z, found
        z, found = trial, made
        if found[0] @ found[0] > (1 - SETTLED) * (r @ r):
            break
    return z, found


def _experiments(
    record: Experiment,
    data: Measurements,
    model: Model,
    shown: np.ndarray,
    x0: np.ndarray,
) -> Iterator[Experiment]:
    """What could be done otherwise than in the record, in words and as an experiment."""
    mean, spread = np.mean(shown, axis=0), np.std(shown, axis=0)
    centre = dict(zip(data.states, mean.tolist(), strict=True))
    away = [
        abs(x0[model.index(n)] - m) / max(s, TINY)
        for n, m, s in zip(data.states, mean, spread, strict=True)
    ]
    if max(away) > SHARE_OF_START:
        for times in FURTHER:
            yield replace(
                record,
                name=f"start {times:g} times as far out",
                stretch=times,
                centre=centre,
            )
    for k in position_rows(model) or range(len(data.states)):
        name = model.states[k]
        by = SHIFT * float(spread[data.states.index(name)])
        yield replace(
            record,
            name=f"start with {name} higher by {_sized(by, data, name)}",
            shift={name: by},
        )
    yield from _with_other_inputs(record, data, _dominant(record, data, shown))
    t, lap = record.t, record.t[-1] - record.t[0] + float(np.median(np.diff(record.t)))
    laps = np.concatenate([t + k * lap for k in range(LONGER)])
    yield replace(
        record,
        name=f"a record {LONGER} times as long",
        t=laps,
        u=np.tile(record.u, (LONGER, 1)),
    )
    for name, s in zip(data.states, spread, strict=True):
        if name not in data.measured and s > 0:
            yield replace(
                record, name=f"measuring {name} too", seen=(*record.seen, name)
            )


def _with_other_inputs(
    record: Experiment, data: Measurements, frequency: float
) -> Iterator[Experiment]:
    t, since = record.t, record.t - record.t[0]
    for j, name in enumerate(data.inputs):
        mean, size = (
            float(np.mean(record.u[:, j])),
            float(np.std(record.u[:, j]) or abs(np.mean(record.u[:, j]))),
        )
        if size == 0:
            continue
        for times in LOUDER:
            yield replace(
                record,
                name=f"{name} times {times:g}",
                u=_changed(record.u, j, times * record.u[:, j]),
            )
        wave = np.sqrt(2) * size
        for times in FASTER:
            f = times * frequency
            if f < 0.25 / float(np.median(np.diff(t))):  # four samples in a period
                u = _changed(record.u, j, mean + wave * np.sin(2 * np.pi * f * since))
                yield replace(
                    record,
                    name=f"{name} a sine of period {_sized(1 / f, data, 't')} and the same rms",
                    u=u,
                )
        low, high = FASTER[0] * frequency, FASTER[-1] * frequency
        swept = np.sin(
            2 * np.pi * (low * since + (high - low) * since**2 / (2 * since[-1]))
        )
        name = f"{name} a sweep of periods {1 / low:.3g} to {_sized(1 / high, data, 't')} and the same rms"
        yield replace(record, name=name, u=_changed(record.u, j, mean + wave * swept))


def _changed(u: np.ndarray, j: int, column: np.ndarray) -> np.ndarray:
    new = u.copy()
    new[:, j] = column
    return new


def _sized(value: float, data: Measurements, name: str) -> str:
    return f"{value:.3g} {data.units.get(name, '')}".rstrip()


def _dominant(record: Experiment, data: Measurements, shown: np.ndarray) -> float:
    """Frequency (per unit of time) of most power in the measured states; at least one
    period in the record.
    """
    even = np.linspace(record.t[0], record.t[-1], len(record.t))
    power = np.zeros(len(even) // 2 + 1)
    for name in data.measured:
        y = np.interp(even, record.t, shown[:, data.states.index(name)])
        y = (y - y.mean()) / max(float(y.std()), TINY)
        power += np.abs(np.fft.rfft(y * np.hanning(len(y)))) ** 2
    return float(
        np.fft.rfftfreq(len(even), even[1] - even[0])[1 + int(np.argmax(power[1:]))]
    )
