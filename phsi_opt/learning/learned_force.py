"""A learned force: a stop-gap for what a model lacks and no known effect explains.

    dx_i/dt = physics_i(x, t, u; theta) + N(v),    v: a few states, efforts dH/dx,
    inputs or the time

N is a small network (`orthogonal`), fitted to what one equation lacks. On the record it
is orthogonal to all that the free parameters can produce there: it takes only what they
cannot explain. They are then re-estimated with N in place. Being a formula, N runs in
the model like any other term, with inputs as they are held. `distil` writes it as
terms.

A learned force knows the range of the data alone; beyond it its variables are held at
the edge.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from phsi_opt.comparison.compare import compare
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, ModelError, did_you_mean
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.estimation.json_file import read_json
from phsi_opt.estimation.missing_force import ForceEstimate, force_deviation
from phsi_opt.estimation.record import Record
from phsi_opt.learning.distillation import short_form
from phsi_opt.learning.orthogonal_network import (
    NOTHING,
    ForceSamples,
    Hidden,
    Output,
    Response,
    chosen,
    features_of,
)
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.statistics import TINY
from phsi_opt.transcription.alignment import aligned
from phsi_opt.transcription.losses import MaximumLikelihood
from phsi_opt.transcription.parameter_vector import Theta

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FORMAT = "phsi_opt learned force 1"
LEAST = 50  # intervals, so that every stretch holds a few


@dataclass(frozen=True, eq=False)
class LearnedForce:
    """A force N(v) in one ``equation`` that was learned from measurements, beside the
    ``physics`` it was learned for.

    Attributes:
        physics: the fit without the force; its parameters are those re-estimated with
            the force in place.
        on: the variables v. shift, spread, hidden, output: N = tanh((v - shift)/spread
            weights' + bias) a + b.
        explains: share of what the fit left in the measurements (the squares of its
            linearised residuals) that the force predicts on stretches of time left out.
            Zero or below: it found nothing, and N is set to zero.
        record: what it was learned from.
    """

    physics: Fit
    equation: str
    on: tuple[str, ...]
    shift: np.ndarray
    spread: np.ndarray
    hidden: Hidden
    output: Output
    explains: float
    record: ForceSamples = field(repr=False)

    @property
    def seen(self) -> np.ndarray:
        """Least and largest value of each variable in the record, (2, n_variables)."""
        return np.stack([self.record.v.min(axis=0), self.record.v.max(axis=0)])

    def at(self, v: Any) -> np.ndarray:
        """The force (n,) at values (n, n_variables) of its variables."""
        z = (np.clip(np.asarray(v, dtype=float), *self.seen) - self.shift) / self.spread
        return np.asarray(
            features_of(z, self.hidden)[:, :-1] @ self.output[0] + self.output[1]
        )

    def force(self, x: Any, u: Any = None, t: Any = 0.0) -> np.ndarray:
        """The force (n,) at states x (n, n_states), inputs u (n, n_inputs) and times t
        (n,), or at one time.
        """
        model, x = self.physics.model, np.atleast_2d(np.asarray(x, dtype=float))
        u = (
            np.zeros((len(x), 0))
            if u is None
            else np.asarray(u, dtype=float).reshape(len(x), -1)
        )
        if x.shape[1] != model.n_states or u.shape[1] != model.n_inputs:
            raise DataError(
                f"x of shape {x.shape} and u of shape {u.shape} do not fit the {model.n_states} states and "
                f"{model.n_inputs} inputs of the model; give a column for each."
            )
        theta = model.theta.reshape(-1, 1).repeat(len(x), axis=1)
        return self.at(
            _along(model.function(*self.on), x, u, np.broadcast_to(t, len(x)), theta)
        )

    @cached_property
    def fit(self) -> Fit:
        """Physics and force as one fit, the force a sum of formulas: for `compare`,
        `diagnose`, equations, files.
        """
        limits = zip(
            self.on,
            *self.seen.tolist(),
            self.shift.tolist(),
            self.spread.tolist(),
            strict=True,
        )
        z = [
            f"(min(max({name}, {low!r}), {high!r}) - {mid!r})/{width!r}"
            for name, low, high, mid, width in limits
        ]
        units = zip(*self.hidden, self.output[0].tolist(), strict=True)
        bodies = [repr(float(self.output[1]))]
        for weights, bias, size in units:
            parts = [
                f"{w!r}*({scaled})"
                for w, scaled in zip(weights.tolist(), z, strict=True)
            ]
            bodies.append(f"{size!r}*tanh({' + '.join(parts)} + {float(bias)!r})")
        terms = Dictionary(tuple(Term(body) for body in bodies))
        model = self.physics.model.add(
            Effect("learned force", "F", self.equation, terms)
        )
        return replace(self.physics, model=model, states=(), steps=())

    def simulate(self, t: Any, x0: Any, u: Any = None) -> np.ndarray:
        """States (n_samples, n_states) from x0 at t[0], physics and learned force."""
        return self.fit.simulate(t, x0, u)

    def free_run_rmse(self, data: Measurements) -> float:
        """Error of the free run on the measurements, starting states estimated from the
        record, as in `compare`.
        """
        return compare(self.fit, data).rmse

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """The learned force over its first variable, or two, with the missing force and
        the range of the data.
        """
        import matplotlib.pyplot as plt

        ax = (
            plt.subplots(figsize=(7.0, 3.8), layout="constrained")[1]
            if ax is None
            else ax
        )
        (_plot_curve if len(self.on) == 1 else _plot_map)(self, ax)
        share = (
            f"explains {100 * self.explains:.0f} % of left-out stretches"
            if self.explains > 0
            else "found nothing"
        )
        ax.set_title(
            f"Learned force in d{self.equation}/dt: {share};\nit does not extrapolate beyond the data"
        )
        return ax

    def save(self, path: str | Path) -> None:
        """Write physics, network and record as JSON: numbers and formulas, no code."""
        arrays = {
            name: getattr(self.record, name).tolist()
            for name in ("v", "w", "std", "physics")
        }
        content = {
            "format": FORMAT,
            "physics": self.physics.content(),
            "equation": self.equation,
            "on": list(self.on),
            "shift": self.shift.tolist(),
            "spread": self.spread.tolist(),
            "explains": self.explains,
            "hidden": [part.tolist() for part in self.hidden],
            "record": arrays,
            "output": [self.output[0].tolist(), self.output[1]],
        }
        Path(path).write_text(json.dumps(content) + "\n", encoding="utf-8")

    @staticmethod
    def load(path: str | Path) -> "LearnedForce":
        """Read what `save` wrote; raises `DataError` for anything else. Never runs code
        from the file.
        """
        return read_json(path, FORMAT, "a learned force", _from_json)

    def __str__(self) -> str:
        seen = ", ".join(
            f"{n} {a:.4g} to {b:.4g}"
            for n, (a, b) in zip(self.on, self.seen.T, strict=True)
        )
        return f"learned force in d{self.equation}/dt, known for {seen}: explains {self.explains:.2f} of what is missing"


def learned_force(
    fit: Fit,
    data: Measurements,
    *,
    equation: str,
    on: Sequence[str],
    seed: int = 0,
    epochs: int = 200,
    loss: MaximumLikelihood | None = None,
) -> LearnedForce:
    """Learn the force that ``fit`` lacks in one equation, as a function of the
    variables ``on``.

    Args:
        on: names of states, efforts (``dH_dp``), inputs, or ``t``.
        epochs: the most; how many are used, and the weight of the ridge, is chosen on
            stretches of time left out.
        loss: how the physics is re-estimated with the force in place, default
            `MaximumLikelihood`.

    Raises `ModelError` for unknown names and `DataError` for fewer than 50 intervals.
    """
    return learned_force_of(
        Record.of(fit, data),
        equation=equation,
        on=on,
        seed=seed,
        epochs=epochs,
        loss=loss,
    )


def learned_force_of(
    along: Record,
    *,
    equation: str,
    on: Sequence[str],
    seed: int = 0,
    epochs: int = 200,
    loss: MaximumLikelihood | None = None,
) -> LearnedForce:
    """`learned_force` for a record that was made before."""
    fit, data, estimate = along.fit, along.data, along.estimate
    on = _checked(fit.model, on, epochs)
    record = _record(along, equation, on)
    shift, spread = record.v.mean(axis=0), np.maximum(record.v.std(axis=0), 1e-12)
    z = (record.v - shift) / spread
    response = Response.of(along, fit.model.index(equation))
    hidden, output, explains = chosen(z, record, response, epochs, seed)
    if explains <= 0:
        return LearnedForce(
            fit,
            equation,
            on,
            shift,
            spread,
            hidden,
            (0 * output[0], 0.0),
            explains,
            record,
        )
    learned = LearnedForce(
        fit, equation, on, shift, spread, hidden, output, explains, record
    )
    return replace(
        learned,
        physics=_re_estimated(learned, data, estimate, loss or MaximumLikelihood()),
    )


def _checked(model: Model, on: Sequence[str], epochs: int) -> tuple[str, ...]:
    known = (*model.states, *model.efforts, *model.inputs, "t")
    if isinstance(on, str) or not on or len(set(on)) < len(on):
        raise ModelError(
            f"on={on!r} of a learned force must be a list of different variables, such as ['q']."
        )
    for name in on:
        if name not in known:
            raise ModelError(
                f"variable {name!r} of a learned force is unknown; known are {', '.join(known)}."
                f"{did_you_mean(str(name), known)}"
            )
    if not isinstance(epochs, int) or epochs < 1:
        raise ModelError(
            f"epochs={epochs!r} of a learned force must be a whole number of at least 1."
        )
    return tuple(on)


def _along(
    function: ca.Function,
    x: np.ndarray,
    u: np.ndarray,
    t: np.ndarray,
    theta: np.ndarray,
) -> np.ndarray:
    """A CasADi function (x, u, t, theta) at every row, (n, n_values)."""
    return np.array(function.map(len(t))(x.T, u.T, np.reshape(t, (1, -1)), theta)).T


def _record(along: Record, equation: str, on: tuple[str, ...]) -> ForceSamples:
    """Variables, missing force and the physics' columns d rhs_i / d theta in the middle
    of every interval.
    """
    estimate = along.estimate
    model, grid = along.model.with_values(estimate.rounded), estimate.grid
    row = model.index(equation, "equation of a learned force")
    if row not in estimate.prior.rows:
        raise ModelError(
            f"d{equation}/dt is kinematics and lacks no force; learn it in the equation of a momentum."
        )
    if grid.n_intervals < LEAST:
        raise DataError(
            f"{grid.n_intervals} intervals are too few to learn a force; at least {LEAST} are needed."
        )
    x, run = (
        (estimate.x[grid.begin] + estimate.x[grid.begin + 1]) / 2,
        grid.trajectory[grid.begin],
    )
    unknown = Theta.of(model, along.trajectories)
    points = (
        x,
        (grid.u0 + grid.u1) / 2,
        grid.t[grid.begin] + grid.h / 2,
        along.theta[:, run],
    )
    symbols = [
        ca.SX.sym("s", n) for n in (model.n_states, model.n_inputs, 1, len(model.free))
    ]
    slope = ca.densify(ca.jacobian(model.rhs()(*symbols)[row], symbols[-1]).T)
    columns = np.zeros((len(x), len(unknown)))
    slopes = _along(ca.Function("slope", symbols, [slope]), *points)
    np.put_along_axis(columns, unknown.table[:, run].T, slopes, axis=1)
    k = estimate.prior.rows.index(row)
    std = np.maximum(force_deviation(estimate)[:, k], TINY)
    basis, sizes, _ = np.linalg.svd(columns / std[:, None], full_matrices=False)
    kept = basis[:, sizes > NOTHING * np.max(sizes, initial=0.0)]
    return ForceSamples(
        _along(model.function(*on), *points), estimate.w[:, k], std, kept
    )


def _re_estimated(
    learned: LearnedForce,
    data: Measurements,
    estimate: ForceEstimate,
    loss: MaximumLikelihood,
) -> Fit:
    """The physics with its parameters estimated beside the force: what is theirs in the
    missing force, they take.
    """
    fit, grid = learned.physics, estimate.grid
    if not fit.model.free:
        return fit
    states = tuple(
        estimate.x[(grid.trajectory == i) & grid.sample]
        for i in range(data.n_trajectories)
    )
    noise = {
        name: float(s)
        for name, s in zip(data.states, estimate.sigma, strict=True)
        if name in data.measured
    }
    start = replace(learned.fit, states=states, noise=noise, steps=fit.steps)
    found = identify(learned.fit.model, data, loss, start=start)
    model = fit.model.with_values({name: found.values[name] for name in fit.model.free})
    return replace(found, model=model, states=(), steps=())


def distil(
    learned: LearnedForce,
    data: Measurements,
    model: Model | None = None,
    *,
    most: int = 3,
    share: float = 0.9,
) -> list[Effect]:
    """The learned force as effects in slot F, to be added to ``model``, identified and
    tested again.

    Powers, sines, dry friction, corners and pulses of one variable and products of two
    are tried (see `short_form`). They are weighed by what they do to the measurements
    ``data``, beside the physics. [] where ``most`` of them explain less than ``share``
    of what the learned force does. ``model`` (default: the physics) says which names
    are free.
    """
    if not np.any(learned.output[0]):
        return []
    fit, data = learned.physics, aligned(learned.physics.model, data)
    along = Record.of(fit, data)
    record = _record(along, learned.equation, learned.on)
    response = Response.of(along, fit.model.index(learned.equation))
    terms = short_form(learned.on, record, response, learned.at(record.v), most, share)
    taken = (model or fit.model).entries
    free = (
        name
        for k in count(1)
        if (name := f"learned_{learned.equation}_{k}") not in taken
    )
    return [
        Effect(
            f"learned {term.body}",
            "F",
            learned.equation,
            Dictionary((replace(term, name=name),)),
        )
        for term, name in zip(terms, free)  # noqa: B905 - names never end
    ]


def _plot_curve(learned: LearnedForce, ax: "Axes") -> None:
    low, high = learned.seen[:, 0].tolist()
    v = np.linspace(low, high, 300)
    ax.plot(
        learned.record.v[:, 0],
        learned.record.beyond_physics,
        ".",
        ms=3,
        color="0.55",
        label="missing force",
    )
    ax.plot(v, learned.at(v[:, None]), "-", color="C0", label="learned force")
    for k, edge in enumerate((low, high)):
        ax.axvline(
            edge, color="C2", ls=":", label="range of the data" if k == 0 else None
        )
    ax.set(xlabel=learned.on[0], ylabel=f"force in d{learned.equation}/dt")
    ax.legend(frameon=False)


def _plot_map(learned: LearnedForce, ax: "Axes") -> None:
    """Over the first two variables, the others at their means; the points of the data
    mark its range.
    """
    v = learned.record.v
    a, b = (np.linspace(low, high, 60) for low, high in learned.seen.T[:2])
    points = np.tile(learned.shift, (3600, 1))
    points[:, 0], points[:, 1] = np.tile(a, 60), np.repeat(b, 60)
    force = learned.at(points).reshape(60, 60)
    most = float(np.max(np.abs(force)))
    shades = ax.pcolormesh(
        a, b, force, shading="gouraud", cmap="coolwarm", vmin=-most, vmax=most
    )
    ax.figure.colorbar(shades, ax=ax, label=f"learned force in d{learned.equation}/dt")
    ax.plot(v[:, 0], v[:, 1], ".", ms=2, color="0.3", label="data")
    ax.set(xlabel=learned.on[0], ylabel=learned.on[1])
    ax.legend(frameon=False)


def _from_json(content: dict[str, Any]) -> LearnedForce:
    physics, on = (
        Fit.from_content(content["physics"]),
        tuple(str(name) for name in content["on"]),
    )
    arrays = {
        name: np.array(values, dtype=float)
        for name, values in content["record"].items()
    }
    record = ForceSamples(**arrays)
    shift, spread = (
        np.array(content["shift"], dtype=float),
        np.array(content["spread"], dtype=float),
    )
    weights, bias = (np.array(part, dtype=float) for part in content["hidden"])
    output = np.array(content["output"][0], dtype=float), float(content["output"][1])
    n, m = len(_checked(physics.model, on, 1)), len(bias)
    shapes = {
        (record.v.shape[1:], shift.shape, spread.shape): ((n,),) * 3,
        (weights.shape, output[0].shape): ((m, n), (m,)),
    }
    if any(found != expected for found, expected in shapes.items()) or len(
        record.v
    ) != len(record.w):
        raise DataError(
            "the layers of the network do not fit together or to its variables."
        )
    equation, explains = str(content["equation"]), float(content["explains"])
    physics.model.index(equation, "equation of the learned force")
    return LearnedForce(
        physics, equation, on, shift, spread, (weights, bias), output, explains, record
    )
