"""The experiments of `efficiency`: truth, data of a seed, model to fit. No starting
value is the truth.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

import phsi_opt as ph
from problems.benchmarks.efficiency.cramer_rao import (
    Sensitivities,
    TrueSystem,
    covariance_bound,
    efficient_error,
    pseudo_hamiltonian,
)
from problems.thesis.systems import (
    FLOWS,
    LEVELS,
    SYSTEMS,
    System,
    known_leak,
    tank_model,
    tank_structure,
)

# dq/dt = p, dp/dt = -k q - a q^3 - c p + 2 cos(1.3 t): regular, and the cubic force is
# as large as the linear one
DUFFING = {"k": 1.7, "a": 0.6, "c": 0.15}
DUFFING_START = np.array([1.5, 0.0])
DUFFING_TIMES = np.linspace(0.0, 50.0, 501)
NOISE_LEVELS = (0.01, 0.1)


@dataclass(frozen=True)
class Sample:
    """What one seed measured: data, the least covariance of the parameters, the error
    of the efficient estimate.
    """

    data: ph.Measurements
    covariance: np.ndarray
    efficient: np.ndarray

    @property
    def bound(self) -> np.ndarray:
        """Least standard deviation of each parameter."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is random in an experiment: starting states (n_trajectories, n_states), and
    standard normal numbers for the noise (n_trajectories, n_samples, n_states).
    """

    starts: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class Case:
    """An experiment. ``draw`` gives what is random in it.

    ``relative``: the noise is ``noise`` times each channel's standard deviation.
    ``measured``: the states that are measured. ``kept``: the share of their samples
    that is kept, drawn at random per channel.
    """

    name: str
    title: str
    system: Callable[[], TrueSystem]
    model: Callable[[], ph.Model]
    draw: Callable[[np.random.Generator], Drawn]
    t: np.ndarray
    noise: float
    n_seeds: int
    measured: tuple[str, ...]
    relative: bool = False
    kept: float = 1.0

    @property
    def one_step(self) -> bool:
        """Whether the one-step loss can be used: every sample is there."""
        return self.kept == 1.0 and self.measured == self.system().states

    def sample(self, seed: int) -> Sample:
        """The data of a seed with their bound."""
        states = self.system().states
        experiment = self.draw(np.random.default_rng(seed))
        starts = tuple(map(tuple, experiment.starts))
        true = _responses(self.system, starts, tuple(self.t))
        x = true.states
        spread = x.std(axis=(0, 1)) if self.relative else np.ones(len(states))
        sigma = self.noise * spread
        is_kept = np.random.default_rng([seed, 1]).random(x.shape) < self.kept
        seen = np.broadcast_to(np.isin(states, self.measured), x.shape) & is_kept
        noise = sigma * experiment.normal
        y = np.where(seen, x + noise, np.nan)
        data = ph.Measurements.from_arrays([self.t] * len(y), list(y), states=states)
        bound = covariance_bound(true, sigma, seen)
        return Sample(data, bound, efficient_error(true, sigma, noise, seen))


@lru_cache(maxsize=1)  # the starts of an experiment may be the same for every seed
def _responses(
    system: Callable[[], TrueSystem],
    starts: tuple[tuple[float, ...], ...],
    t: tuple[float, ...],
) -> Sensitivities:
    return system().sensitivities(np.array(starts), np.array(t))


@cache
def duffing() -> TrueSystem:
    """The driven Duffing oscillator."""
    rates = pseudo_hamiltonian(
        ("q", "p"),
        np.array([[0, 1], [-1, 0]]),
        "k*q**2/2 + a*q**4/4 + p**2/2",
        {"p": "c"},
        {"p": "2*cos(13*t/10)"},
    )
    return TrueSystem(("q", "p"), rates, DUFFING, ("k", "a", "R_p"))


def duffing_model() -> ph.PseudoHamiltonian:
    """Stiffness, cubic stiffness and damping unknown; mass and drive known."""
    stiffness, cubic = ph.Parameter(1.0), ph.Parameter(1.0)
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + a*q**4/4 + p**2/2", k=stiffness, a=cubic),
        R=ph.damping("p"),
        F={"p": ph.formula("2*cos(1.3*t)")},
    )


def _duffing_draw(rng: np.random.Generator) -> Drawn:
    normal = rng.normal(size=(1, len(DUFFING_TIMES), 2))
    return Drawn(DUFFING_START[None, :], normal)


def duffing_case(
    noise: float, measured: tuple[str, ...], kept: float = 1.0, n_seeds: int = 80
) -> Case:
    """A Duffing experiment at a noise level relative to the channels' standard
    deviations.
    """
    title = f"Duffing, {100 * noise:g} % noise, {' and '.join(measured)} measured"
    name = f"duffing_{''.join(measured)}_{noise:g}"
    if kept < 1.0:
        title += f", {100 * (1 - kept):g} % of the samples removed"
        name += "_gaps"
    return Case(
        name,
        title,
        duffing,
        duffing_model,
        _duffing_draw,
        DUFFING_TIMES,
        noise,
        n_seeds,
        measured,
        relative=True,
        kept=kept,
    )


def thesis_draw(system: System) -> Callable[[np.random.Generator], Drawn]:
    """Starts and noise in the order in which `System.data` draws them."""

    def draw(rng: np.random.Generator) -> Drawn:
        shape = (system.n_steps + 1, len(system.states))
        starts = []
        normal = []
        for _ in range(system.n_trajectories):
            starts.append(system.start(rng))
            normal.append(rng.normal(size=shape))
        return Drawn(np.array(starts), np.array(normal))

    return draw


def thesis_case(
    name: str,
    truth: Callable[[], TrueSystem],
    model: Callable[[], ph.Model],
    n_seeds: int,
    remark: str = "",
) -> Case:
    """An experiment with the data of the thesis: size, starts, noise."""
    s = SYSTEMS[name]
    size = f"{s.n_trajectories} trajectories x {s.n_steps} steps"
    title = f"{s.title}{remark}, noise {s.noise:g}, {size}"
    t = np.linspace(0.0, s.n_steps * s.step, s.n_steps + 1)
    return Case(
        name, title, truth, model, thesis_draw(s), t, s.noise, n_seeds, s.states
    )


def on_support(model: ph.Model, support: Mapping[str, float]) -> ph.Model:
    """The model without the terms that are not in ``support``."""
    terms = {name for name, entry in model.entries.items() if entry.prunable}
    return model.without(terms - set(support))


@dataclass(frozen=True)
class Energy:
    """The energy sum_i h_i term_i as text, and the values of h_i."""

    text: str
    values: dict[str, float]


def _energy(support: Mapping[str, float]) -> Energy:
    terms = {n[2:-1]: value for n, value in support.items() if n.startswith("H[")}
    texts = [f"h{i}*{term}" for i, term in enumerate(terms)]
    values = {f"h{i}": value for i, value in enumerate(terms.values())}
    return Energy(" + ".join(texts), values)


MASS_SPRING = {**SYSTEMS["mass_spring"].truth, "F_p[cos(omega_t*t)]": 0.0}


@cache
def mass_spring() -> TrueSystem:
    """The mass-spring of the thesis; the phase of the force is free as a pair of sine
    and cosine.
    """
    energy = _energy(MASS_SPRING)
    rates = pseudo_hamiltonian(
        ("q", "p"),
        np.array([[0, 1], [-1, 0]]),
        energy.text,
        {"p": "r"},
        {"p": "w1*sin(omega*t) + w2*cos(omega*t)"},
    )
    names = {
        "r": "R_p",
        "w1": "F_p[sin(omega_t*t)]",
        "omega": "F_p.omega_t",
        "w2": "F_p[cos(omega_t*t)]",
    }
    others = {symbol: MASS_SPRING[name] for symbol, name in names.items()}
    values = {**energy.values, **others}
    names_of_model = ("H[q**2]", "H[p**2]", *names.values())
    return TrueSystem(("q", "p"), rates, values, names_of_model)


def mass_spring_model() -> ph.Model:
    """No starting values; the frequency is found by the scan."""
    return on_support(SYSTEMS["mass_spring"].model(), MASS_SPRING)


@cache
def schrodinger() -> TrueSystem:
    """The Schroedinger system of the thesis."""
    return _hamiltonian(SYSTEMS["schrodinger"])


def schrodinger_model() -> ph.Model:
    """All coefficients of the true support, without starting values."""
    return on_support(SYSTEMS["schrodinger"].model(), SYSTEMS["schrodinger"].truth)


@cache
def henon_heiles() -> TrueSystem:
    """Henon-Heiles as in the thesis."""
    return _hamiltonian(SYSTEMS["henon_heiles"])


def henon_heiles_model() -> ph.Model:
    """All coefficients of the true support, without starting values."""
    return on_support(SYSTEMS["henon_heiles"].model(), SYSTEMS["henon_heiles"].truth)


def _hamiltonian(system: System) -> TrueSystem:
    """S grad H of two particles, without losses and forces."""
    energy = _energy(system.truth)
    zero = np.zeros((2, 2))
    one = np.eye(2)
    S = np.block([[zero, one], [-one, zero]])
    rates = pseudo_hamiltonian(system.states, S, energy.text, {}, {})
    return TrueSystem(system.states, rates, energy.values, tuple(system.truth))


@cache
def tanks() -> TrueSystem:
    """The tanks with the leak shut."""
    truth = SYSTEMS["tanks"].truth
    states = FLOWS + LEVELS
    energy = _energy(truth)
    losses = {flow: f"r{i}" for i, flow in enumerate(FLOWS)}
    rates = pseudo_hamiltonian(states, tank_structure(), energy.text, losses, {})
    damping = {symbol: truth[f"R_{flow}"] for flow, symbol in losses.items()}
    return TrueSystem(states, rates, {**energy.values, **damping}, tuple(truth))


def tanks_model() -> ph.Model:
    """All coefficients of the true support and the damping of the pipes, without
    starting values.
    """
    return on_support(tank_model(), SYSTEMS["tanks"].truth)


def tanks_leak_model() -> ph.Model:
    """The same with the leak; its slope starts at half of the truth.

    At the kinks of the leak steps are halved until they are 64 times as fine.
    """
    return on_support(tank_model(known_leak()), SYSTEMS["tanks"].truth)


def _cases() -> list[Case]:
    cases = []
    for measured in (("q", "p"), ("q",)):
        cases += [duffing_case(noise, measured) for noise in NOISE_LEVELS]
        cases.append(duffing_case(0.1, measured, kept=0.5))
    return [
        *cases,
        thesis_case("mass_spring", mass_spring, mass_spring_model, 40),
        thesis_case("schrodinger", schrodinger, schrodinger_model, 40),
        thesis_case("tanks", tanks, tanks_model, 10, remark=" (leak shut)"),
        thesis_case("henon_heiles", henon_heiles, henon_heiles_model, 20),
    ]


CASES = {case.name: case for case in _cases()}
