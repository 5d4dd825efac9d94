"""A learned force: a stop-gap for what a model lacks and no known effect explains.

::

    dx_i/dt = physics_i(x, t, u; theta) + N(v)

with v a few states, efforts dH/dx, inputs or the time. N is a small network
(`orthogonal_network`), fitted to what one equation lacks. On the record it is
orthogonal to all that the free parameters can produce there: it takes only what they
cannot explain. They are then re-estimated with N in place. Being a formula, N runs in
the model like any other term, with inputs as they are held. `distil` writes it as
terms.

A learned force knows the range of the data alone; beyond it its variables are held at
the edge.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count, filterfalse
from typing import Any

import numpy as np

from phsi_opt.arguments import require_count, require_known
from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import ModelError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.estimation.record import Record
from phsi_opt.learning.distillation import short_form
from phsi_opt.learning.network import Network
from phsi_opt.learning.orthogonal_network import (
    ForceSamples,
    Response,
    orthogonal_network,
)
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.transcription.losses import MaximumLikelihood


@dataclass(frozen=True, eq=False)
class LearnedForce:
    """A force N(v) in one equation, learned from measurements beside the physics.

    Attributes:
        physics: the fit without the force; its parameters are those re-estimated with
            the force in place.
        equation: the state in whose equation the force acts.
        on: names of the variables v.
        network: N.
        explains: share of what the fit left in the measurements (the squares of its
            linearised residuals) that the force predicts on stretches of time left out.
            Zero or below: it found nothing, and N is set to zero.
    """

    physics: Fit
    equation: str
    on: tuple[str, ...]
    network: Network
    explains: float

    def at(self, v: Any) -> np.ndarray:
        """The force (n,) at values (n, n_variables) of its variables."""
        return self.network.at(np.asarray(v, dtype=float))[:, 0]

    @cached_property
    def fit(self) -> Fit:
        """Physics and force as one fit, for `compare`, `diagnose`, equations, `save`.

        The force is a sum of formulas.
        """
        dictionary = Dictionary(tuple(map(Term, self._bodies())))
        effect = Effect("learned force", "F", self.equation, dictionary)
        model = self.physics.model.add(effect)
        return replace(self.physics, model=model, states=(), steps=())

    def _bodies(self) -> list[str]:
        """The bias and the weighted units, as formulas of the variables."""
        # These are standardised, and held at the edge of the data.
        network = self.network
        scales = np.array([*network.seen, network.shift, network.spread])
        variables = []
        for name, scale in zip(self.on, scales.T.tolist(), strict=True):
            lower, upper, shift, spread = scale
            inside = f"min(max({name}, {lower!r}), {upper!r})"
            variables.append(f"({inside} - {shift!r})/{spread!r}")
        (weights, bias), (sizes, (constant,)) = network.layers
        bodies = [repr(float(constant))]
        units = np.column_stack([sizes[0], bias, weights])
        for size, own, *row in units.tolist():
            parts = [f"{w!r}*({z})" for w, z in zip(row, variables, strict=True)]
            bodies.append(f"{size!r}*tanh({' + '.join(parts)} + {own!r})")
        return bodies

    def __str__(self) -> str:
        ranges = []
        for name, (lower, upper) in zip(self.on, self.network.seen.T, strict=True):
            ranges.append(f"{name} {lower:.4g} to {upper:.4g}")
        return (
            f"learned force in d{self.equation}/dt, known for {', '.join(ranges)}: "
            f"explains {self.explains:.2f} of the missing force"
        )


def learned_force(
    record: Record,
    *,
    equation: str,
    on: Sequence[str],
    seed: int = 0,
    epochs: int = 200,
) -> LearnedForce:
    """Learn the force that a fit lacks in one equation, as a function of variables.

    Args:
        record: the fit along the measurements to learn from.
        equation: the state whose equation lacks the force.
        on: names of states, efforts (``dH_dp``), inputs, or ``t``.
        seed: of the network's first weights.
        epochs: the most; how many are used, and the weight of the ridge, is chosen on
            stretches of time left out.

    Raises:
        ModelError: a name is unknown, the equation is one of kinematics, a setting is
            not possible, or torch is not installed.
        DataError: there are fewer than 50 intervals.
        SolveError: the physics could not be estimated.
    """
    model = record.fit.model
    on = _checked_names(model, on)
    require_count("epochs", epochs)
    samples = ForceSamples.of(record, equation, on)
    response = Response.of(record, model.index(equation))
    network, explains = orthogonal_network(samples, response, epochs, seed)
    learned = LearnedForce(record.fit, equation, on, network, explains)
    if explains <= 0:
        return learned
    return replace(learned, physics=_re_estimated(learned, record))


def _checked_names(model: Model, on: Sequence[str]) -> tuple[str, ...]:
    if isinstance(on, str) or not on or len(set(on)) < len(on):
        raise ModelError(
            f"on={on!r} of a learned force must be a list of different variables, "
            "such as ['q']."
        )
    known = (*model.states, *model.efforts, *model.inputs, "t")
    for name in on:
        said = f"variable {name!r} of a learned force is unknown"
        require_known(name, known, said)
    return tuple(on)


def _re_estimated(learned: LearnedForce, record: Record) -> Fit:
    """The physics with its parameters estimated beside the force."""
    # What is theirs in the missing force, they take.
    fit = record.fit
    if not fit.model.free:
        return fit
    data = record.data
    grid = record.estimate.grid
    states = []
    for x, is_sample in zip(record.start, grid.split(grid.sample), strict=True):
        states.append(x[is_sample])
    of_states = zip(data.states, record.estimate.sigma.tolist(), strict=True)
    noise = {name: sigma for name, sigma in of_states if name in data.measured}
    start = replace(learned.fit, states=tuple(states), noise=noise, steps=fit.steps)
    found = identify(learned.fit.model, data, MaximumLikelihood(), start=start)
    values = {name: found.values[name] for name in fit.model.free}
    return replace(found, model=fit.model.with_values(values), states=(), steps=())


def distil(
    learned: LearnedForce,
    data: Measurements,
    model: Model | None = None,
    *,
    most: int = 3,
    share: float = 0.9,
) -> list[Effect]:
    """Write a learned force as effects in slot F.

    They are to be added to the model, identified and tested again. Powers, sines, dry
    friction, corners and pulses of one variable and products of two are tried (see
    `short_form`), and weighed by what they do to the measurements, beside the physics.

    Args:
        learned: the force.
        data: the measurements it was learned from.
        model: says which names are free; default: the physics.
        most: number of effects.
        share: of what the learned force does, that they must explain.

    Returns:
        The effects; [] where none of so few explain so much.

    Raises:
        DataError: the measurements do not fit the model.
        SolveError: the missing force could not be estimated.
    """
    if not np.any(learned.network.layers[-1][0]):
        return []
    fit = learned.physics
    equation = learned.equation
    record = Record.of(fit, data)
    samples = ForceSamples.of(record, equation, learned.on)
    response = Response.of(record, fit.model.index(equation))
    curve = learned.at(samples.v)
    terms = short_form(learned.on, samples, response, curve, most, share)
    taken = (model or fit.model).entries
    free = filterfalse(
        taken.__contains__, map(f"learned_{equation}_{{}}".format, count(1))
    )
    effects = []
    for term, name in zip(terms, free, strict=False):
        dictionary = Dictionary((replace(term, name=name),))
        effects.append(Effect(f"learned {term.body}", "F", equation, dictionary))
    return effects
