"""The design of an experiment as a nonlinear program: the inputs are its variables.

Each model is stepped along the planned times together with its sensitivities,

::

    dX/dt = df/dx X + df/dp,    Y_k = dh/dx X_k + dh/dp,    p = (parameters, start),

so that what re-fitting could do is known without any re-fit: with the residual r of two
predictions and the information L of the present record, all over the noise, the second
model imitates the first up to

::

    d^2 = r'r - r'Y (Y'Y + L)^-1 Y'r,

and d^2 / 2 is the expected log Bayes factor (Box and Hill 1967; Atkinson and Fedorov
1975). One model alone is told best where log det (Y'Y + L) is largest (D-optimality).
The program maximises this; its constraints are the limits of inputs, states and
formulas at every sample. CasADi differentiates it, IPOPT solves it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import casadi as ca
import numpy as np

from phsi_opt.data.checks import Hold, hold_of_each
from phsi_opt.data.trajectory import InputCurve
from phsi_opt.model.model import Model
from phsi_opt.model.symbolic import argument_symbols
from phsi_opt.optimization.ipopt import maximized

Limits = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class PlannedModel:
    """A fitted model and what the record tells of it.

    Attributes:
        model: with its fitted values.
        x0: (n_states,) its start in the record.
        covariance: (n_free, n_free) of its free parameters, from the record.
        spread: (n_states,) sizes of the states, as scales.
        n_steps: integration steps between two samples.
    """

    model: Model
    x0: np.ndarray
    covariance: np.ndarray
    spread: np.ndarray
    n_steps: int


@dataclass(frozen=True, eq=False)
class Plan:
    """What is given: times (n_samples,), inputs, noise by measured state, ranges."""

    t: np.ndarray
    inputs: tuple[str, ...]
    hold: Hold
    noise: Mapping[str, float]
    limits: Limits
    start: Limits


class Signal(NamedTuple):
    """A family of inputs: design variables, their bounds and start, u (n, n_inputs)."""

    kind: str
    variables: ca.MX
    bounds: np.ndarray  # (2, n_variables)
    start: np.ndarray
    u: ca.MX


class Course(NamedTuple):
    """A model along the plan: over the noise what sensors show, and its slopes in p."""

    shown: ca.MX  # (n_measured * n_samples,)
    slopes: ca.MX  # (n_measured * n_samples, n_p), per scale of each p
    states: ca.MX  # (n_states, n_samples)
    information: np.ndarray  # (n_p, n_p) that the record has, in these scales
    scales: np.ndarray  # (n_p,)


class Design(NamedTuple):
    """A solution: the kind of input, u (n_samples, n_inputs), starts by state, gain.

    ``std_errors`` (n_free,) are those that the record and one model's course leave.
    """

    kind: str
    u: np.ndarray
    start: dict[str, float]
    gain: float
    std_errors: np.ndarray


def designs(
    plan: Plan, models: Sequence[PlannedModel], sharpen: int | None, seed: int
) -> Iterator[Design]:
    """The best experiment of each kind of input that keeps within the limits.

    Of two models that which tells them apart, of one that which tells its parameters.
    """
    first = models[0]
    begin = ca.MX.sym("start", len(plan.start))
    places = list(map(first.model.index, plan.start))
    ranges = np.reshape([*plan.start.values()], (-1, 2)).T
    for signal in signals(plan, np.random.default_rng(seed)):
        courses = [course(plan, one, begin, signal.u) for one in models]
        known = information(courses[0])
        gain = (
            separation(*courses)
            if len(models) == 2
            else told(known, len(first.model.free), sharpen)
        )
        kept, g_bounds = within(plan, first.model, courses[0].states, signal.u)
        variables = ca.vertcat(signal.variables, begin)
        bounds = np.hstack([signal.bounds, ranges])
        own = np.clip(first.x0[places], *ranges)
        # The gain has several maxima; a large input may leave the limits at once.
        found = []
        for size, x0 in product((1.0, 0.3), np.unique([own, *ranges], axis=0)):
            start = np.r_[size * signal.start, x0]
            found.append(maximized(variables, gain, kept, start, bounds, g_bounds))
        reached = [one for one in found if one is not None]
        if not reached:
            continue
        value, z = max(reached, key=lambda one: one[0])
        evaluate = ca.Function("found", [variables], [signal.u, known])
        u, of_both = map(np.array, evaluate(z))
        u = np.reshape(u, (len(plan.t), len(plan.inputs)))
        for k, name in enumerate(plan.inputs):  # it keeps bounds but for rounding
            u[:, k] = np.clip(u[:, k], *plan.limits[name])
        x0 = z[len(signal.start) :].tolist()
        sizes = np.sqrt(np.diag(of_both))
        left = np.linalg.pinv(of_both / np.outer(sizes, sizes), hermitian=True)
        std_errors = np.sqrt(np.diag(left)) * courses[0].scales / sizes
        starts = dict(zip(plan.start, x0, strict=True))
        yield Design(signal.kind, u, starts, value, std_errors[: len(first.model.free)])


# ---- criteria ------------------------------------------------------------------------


def separation(first: Course, second: Course) -> ca.MX:
    """Sum of log(1 + d^2), either model taken for the truth and imitated by the other.

    A model that contains the other imitates it everywhere; then the other d counts.
    """
    apart = first.shown - second.shown
    gain: ca.MX = ca.MX(0.0)
    for imitator in (first, second):
        along = imitator.slopes.T @ apart
        imitated = ca.dot(along, ca.solve(information(imitator), along))
        left = ca.dot(apart, apart) - imitated
        gain += ca.log1p(ca.fmax(left, 0.0))
    return gain


def information(only: Course) -> ca.MX:
    """Of record and course together, (n_p, n_p) in the course's scales."""
    return only.slopes.T @ only.slopes + only.information


def told(known: ca.MX, n_free: int, sharpen: int | None) -> ca.MX:
    """Log of the information on a parameter, by its place, or their determinant."""
    inverse = ca.inv(known)[:n_free, :n_free]
    if sharpen is not None:
        return -ca.log(inverse[sharpen, sharpen])
    return -ca.log(ca.det(inverse))


def within(
    plan: Plan, model: Model, states: ca.MX, u: ca.MX
) -> tuple[ca.MX, np.ndarray]:
    """The limited quantities at every sample, and their bounds (2, n)."""
    names = [name for name in plan.limits if name != "t"]
    columns = [plan.inputs.index(name) for name in model.inputs]
    now = u[:, columns].T
    late = ca.MX(2 * len(model.delays), now.shape[1])
    formulas = model.function(*names).map(len(plan.t))
    theta = ca.repmat(ca.DM(model.theta), 1, len(plan.t))
    values = formulas(states, ca.vertcat(now, late), ca.DM(plan.t).T, theta)
    bounds = np.array([plan.limits[name] for name in names]).T
    return ca.vec(values), np.tile(bounds, len(plan.t))


# ---- inputs --------------------------------------------------------------------------


def signals(plan: Plan, rng: np.random.Generator) -> Iterator[Signal]:
    """Multisines, steps and chirps between the limits of each input."""
    if not plan.inputs:
        nothing = ca.MX(len(plan.t), 0)
        yield Signal("start", ca.MX(0, 1), np.zeros((2, 0)), np.zeros(0), nothing)
        return
    t = plan.t - plan.t[0]
    ranges = np.array([plan.limits[name] for name in plan.inputs])
    middle = ranges.mean(axis=1)
    half = np.ptp(ranges, axis=1) / 2
    n = len(t)
    n_inputs = len(plan.inputs)
    # Up to ten samples in a period, in steps that a resonance does not fall between.
    highest = max(n / 10, 1.0)
    lines = np.unique(np.round(np.geomspace(1.0, highest, 10)))
    turns = 2 * np.pi * np.outer(t, lines) / t[-1]
    waves = np.hstack([np.ones((n, 1)), np.cos(turns), np.sin(turns)])
    holds = np.repeat(np.eye(16), -(-n // 16), axis=0)[:n]
    for kind, basis in (("multisine", waves), ("steps", holds)):
        start = rng.normal(size=(basis.shape[1], n_inputs))
        if kind == "multisine":
            start[0] = 0.0
            start /= np.max(np.abs(basis @ start), axis=0)
        else:
            start = np.sign(start) * 0.9
        size = ca.MX.sym(kind, basis.shape[1], n_inputs)
        free = np.full((2, start.size), [[-2.0], [2.0]])
        scaled = ca.DM(basis) @ size
        u = scaled * ca.repmat(ca.DM(half).T, n, 1) + ca.repmat(ca.DM(middle).T, n, 1)
        yield Signal(kind, ca.vec(size), free, start.ravel(order="F"), u)
    # Size, logarithm of the first and of the last frequency, in 1 / duration.
    shape = ca.MX.sym("chirp", 3, n_inputs)
    ends = np.log([1.0, highest])
    columns = []
    for k in range(n_inputs):
        low, high = ca.exp(shape[1, k]), ca.exp(shape[2, k])
        cycles = low * t / t[-1] + (high - low) * (t / t[-1]) ** 2 / 2
        columns.append(middle[k] + half[k] * shape[0, k] * ca.sin(2 * np.pi * cycles))
    box = np.array([[-1.0, ends[0], ends[0]], [1.0, ends[1], ends[1]]])
    start = np.tile([0.9, *ends], n_inputs)
    yield Signal(
        "chirp", ca.vec(shape), np.tile(box, n_inputs), start, ca.horzcat(*columns)
    )


# ---- a model along the plan ----------------------------------------------------------


def course(plan: Plan, one: PlannedModel, begin: ca.MX, u: ca.MX) -> Course:
    """A model along the plan; those of ``plan.start`` start at ``begin``."""
    model = one.model
    n_free = len(model.free)
    n_states = model.n_states
    n = len(plan.t)
    x0 = ca.MX(ca.DM(one.x0))
    for place, name in enumerate(plan.start):
        x0[model.index(name)] = begin[place]
    columns = _columns(plan, model, u)
    theta = ca.repmat(ca.DM(model.theta), 1, n)
    # Alone, without sensitivities: their slopes in every variable are constraints.
    alone = _after(model, one.n_steps).mapaccum(n)(x0, columns, theta)
    step = _step(model, plan, one.n_steps)
    n_p = n_free + n_states
    slopes0 = ca.horzcat(ca.DM(n_states, n_free), ca.DM.eye(n_states))
    start = ca.vertcat(x0, ca.vec(slopes0))
    _, shown, slopes = step.mapaccum(n)(start, columns, theta)
    deviations = np.sqrt(np.diag(one.covariance))
    deviations = np.where(deviations > 0, deviations, 1.0)
    scales = np.r_[deviations, np.where(one.spread > 0, one.spread, 1.0)]
    by_p = [
        ca.vec(slopes[:, list(range(k, n_p * n, n_p))]) * scales[k] for k in range(n_p)
    ]
    known = np.eye(n_p) * 1e-6  # a start is free within some thousand spreads
    correlation = one.covariance / np.outer(deviations, deviations)
    known[:n_free, :n_free] = np.linalg.pinv(correlation, rcond=1e-10, hermitian=True)
    states = ca.horzcat(x0, alone[:, :-1])
    return Course(ca.vec(shown), ca.horzcat(*by_p), states, known, scales)


def _after(model: Model, n_steps: int) -> ca.Function:
    """CasADi function (x, column, theta) -> the states a sample later."""
    n = model.n_states
    n_inputs = len(model.inputs) + 2 * len(model.delays)
    column = ca.SX.sym("column", 2 + 2 * n_inputs)
    t, h, u0, u1 = ca.vertsplit(column, [0, 1, 2, 2 + n_inputs, 2 + 2 * n_inputs])
    theta = ca.SX.sym("theta", len(model.free))
    s = ca.SX.sym("s", n + 1)  # states and the share of the interval
    u = u0 + s[n] * (u1 - u0)
    rate = ca.vertcat(h * model.rhs()(s[:n], u, t + s[n] * h, theta), 1.0)
    known = ca.vertcat(column, theta)
    f = ca.Function("f", [s, known], [rate])
    x = ca.SX.sym("x", n)
    after = ca.simpleRK(f, n_steps, 4)(ca.vertcat(x, 0.0), known, 1.0)[:n]
    return ca.Function("after", [x, column, theta], [after], {"cse": True})


def _step(model: Model, plan: Plan, n_steps: int) -> ca.Function:
    """CasADi function of a sample: (state and slopes, column, theta) -> those of the
    next sample, what sensors show at this one, and its slopes.
    """
    n = model.n_states
    n_free = len(model.free)
    step = _after(model, n_steps)
    _, column, theta = argument_symbols(step)
    z = ca.SX.sym("z", n * (1 + n_free + n))
    x = z[:n]
    slopes = ca.reshape(z[n:], n, n_free + n)
    now = column[2 : 2 + len(model.inputs) + 2 * len(model.delays)]
    rows = [model.index(name) for name in plan.noise]
    noise = ca.DM(list(plan.noise.values()))
    after = step(x, column, theta)
    shown = model.output()(x, now, column[0], theta)[rows] / noise
    moved = []
    for value in (after, shown):
        change = ca.jacobian(value, x) @ slopes
        change[:, :n_free] += ca.jacobian(value, theta)
        moved.append(change)
    results = [ca.vertcat(after, ca.vec(moved[0])), shown, moved[1]]
    return ca.Function("step", [z, column, theta], results, {"cse": True})


def _columns(plan: Plan, model: Model, u: ca.MX) -> ca.MX:
    """Time, length and inputs of each interval at its begin and end, a column each."""
    t = plan.t
    h = np.append(np.diff(t), 0.0)  # the last sample is measured only
    holds = hold_of_each(plan.hold, plan.inputs)
    firsts: list[ca.MX] = []
    lasts: list[ca.MX] = []
    for name in model.inputs:
        k = plan.inputs.index(name)
        firsts.append(u[:, k])
        is_held = holds[k] == "zero"
        lasts.append(u[:, k] if is_held else ca.vertcat(u[1:, k], u[-1, k]))
    slopes: list[list[ca.MX]] = [[], []]
    for name, delay in model.delays:
        k = plan.inputs.index(name)
        tau = model.values[delay]
        ends = _late(t, str(holds[k]), tau) @ u[:, k]
        n = len(t)
        for place, values in enumerate((firsts, lasts)):
            moved = -ends[(2 + place) * n : (3 + place) * n]
            values.append(ends[place * n : (place + 1) * n] - tau * moved)
            slopes[place].append(moved)
    return ca.horzcat(ca.DM(t), ca.DM(h), *firsts, *slopes[0], *lasts, *slopes[1]).T


def _late(t: np.ndarray, hold: str, tau: float) -> ca.DM:
    """What a delayed input is over each interval, linear in its samples: (4 n, n).

    At begin and end of the interval, and how fast both change with the time.
    """
    begin = t - tau
    end = np.append(begin[1:], begin[-1] + (t[-1] - t[-2]))
    ends = np.array(
        [InputCurve(t, one, hold).lines(begin, end) for one in np.eye(len(t))]
    )
    return ca.DM(ca.sparsify(ends.reshape(len(t), -1).T))
