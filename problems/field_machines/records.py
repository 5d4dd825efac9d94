"""What the parts of the battery hand to each other: an experiment, its hidden effect,
the truth in the catalogue's words, and the case that is examined.

Arrays of states are (..., n_runs, n_states), of inputs (..., n_runs, n_inputs);
parameters may have leading axes, so that variations of a machine are integrated
together.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

import phsi_opt as ph
from phsi_opt.model.model import Model

Array = np.ndarray
Values = Mapping[str, float | Array]
# dx/dt of the model without the hidden effect, from states, inputs and parameters.
Rates = Callable[[Array, Array, Values], Array]
# What a hidden effect of size one adds to dx/dt, from states and inputs.
Law = Callable[[Array, Array], Array]
# Inputs (n_runs, n_inputs) at a time, which a controller makes from the states.
InputAt = Callable[[float, Array], Array]


@dataclass(frozen=True)
class Truth:
    """A hidden effect as the catalogue would call it.

    ``names`` are all that are the same term in the equation; ``coefficient`` is the
    catalogue's, NaN where it counts something else.
    """

    names: tuple[str, ...]
    equation: str
    coefficient: float = np.nan

    @property
    def places(self) -> set[str]:
        """The names that are right, as a diagnosis prints them."""
        return {f"{name} on {self.equation}" for name in self.names}


@dataclass(frozen=True, eq=False)
class Hidden:
    """The law of a hidden effect, and what it is called.

    ``truths`` have the coefficients of size one. ``least`` and ``largest`` enclose its
    size; where ``is_drawn`` it is drawn between them, else it is set by how it shows.
    """

    name: str
    law: Law
    truths: tuple[Truth, ...]
    largest: float
    least: float = 0.0
    is_drawn: bool = False


@dataclass(frozen=True, eq=False)
class Experiment:
    """A machine, what is done with it, and the model that lacks the hidden effect.

    ``values``: true values of the model's free parameters; ``model`` makes the model
    from its starting values. ``row``: the equation in which the machine is not quite
    the model. ``time``: a period, or a time constant. ``n_kept``: samples of each run;
    empty: all. ``is_sampled``: inputs are made at the samples, and held. ``loudest``:
    largest free-run error of the model, as a share of the signal. ``is_faint``: the
    effect is there, and below the noise.
    """

    states: tuple[str, ...]
    seen: tuple[int, ...]
    rates: Rates
    values: Mapping[str, float]
    model: Callable[[Mapping[str, float]], Model]
    hidden: Hidden
    t: Array
    starts: Array
    n_train: int
    row: int
    time: float
    inputs: tuple[str, ...] = ()
    input_at: InputAt | None = None
    hold: str = "linear"
    is_sampled: bool = False
    n_kept: tuple[int, ...] = ()
    loudest: float = 0.9
    is_faint: bool = False

    @property
    def n_runs(self) -> int:
        """Number of runs, for training and held out."""
        return len(self.starts)

    @property
    def kept(self) -> Array:
        """Whether a sample belongs to its run, (n_samples, n_runs)."""
        n_kept = np.array(self.n_kept or [len(self.t)] * self.n_runs)
        return np.arange(len(self.t))[:, None] < n_kept


@dataclass(frozen=True, eq=False)
class Motion:
    """States (n_samples, n_runs, n_states) and inputs (n_samples, n_runs, n_inputs)."""

    x: Array
    u: Array


@dataclass(frozen=True, eq=False)
class Case:
    """What one kind and seed give.

    ``truths``: none where nothing is missing; their coefficients are those of the
    effect at ``size`` one. ``ratio``: free-run error of the best
    re-fit of the model over the noise; ``disturbed``: what the model error does to the
    same runs, over the noise.
    """

    kind: str
    seed: int
    model: Model
    train: ph.Measurements
    test: ph.Measurements
    truths: tuple[Truth, ...]
    size: float
    hidden: str
    noise: float
    disturbance: str
    ratio: float
    disturbed: float
    settings: Mapping[str, object] = field(default_factory=dict)

    @property
    def places(self) -> set[str]:
        """All names that are right, as a diagnosis prints them."""
        return set().union(*(truth.places for truth in self.truths))

    @property
    def is_listed(self) -> bool:
        """Whether the catalogue of the model has one of the right names."""
        listed = {str(effect) for effect in ph.catalogue(self.model)}
        return bool(self.places & listed)
