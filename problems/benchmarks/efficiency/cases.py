"""The experiments of `efficiency`: truth, data of a seed, model to fit. No starting
value is the truth.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache, partial

import numpy as np

import phsi_opt as ph
from phsi_opt.model.terms import Dictionary
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

# dq/dt = p, dp/dt = -k q - a q^3 - R_p p + 2 cos(1.3 t): regular, and the cubic force
# is as large as the linear one
DUFFING = {"k": 1.7, "a": 0.6, "R_p": 0.15}
DUFFING_START = np.array([1.5, 0.0])
DUFFING_TIMES = np.linspace(0.0, 50.0, 501)
NOISE_LEVELS = (0.01, 0.1)


# Starting states (n_trajectories, n_states), and standard normal numbers for the noise
# (n_trajectories, n_samples, n_states).
Drawn = tuple[np.ndarray, np.ndarray]


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

    def sample(self, seed: int) -> tuple[ph.Measurements, np.ndarray, np.ndarray]:
        """The data of a seed, the least standard deviation of each parameter, and the
        errors of the efficient estimate.
        """
        states = self.system().states
        starts, normal = self.draw(np.random.default_rng(seed))
        true = _responses(self.system, tuple(map(tuple, starts)), tuple(self.t))
        x = true.states
        spread = x.std(axis=(0, 1)) if self.relative else np.ones(len(states))
        sigma = self.noise * spread
        is_kept = np.random.default_rng([seed, 1]).random(x.shape) < self.kept
        seen = np.broadcast_to(np.isin(states, self.measured), x.shape) & is_kept
        noise = sigma * normal
        y = np.where(seen, x + noise, np.nan)
        data = ph.Measurements.from_arrays([self.t] * len(y), list(y), states=states)
        bound = np.sqrt(np.diag(covariance_bound(true, sigma, seen)))
        return data, bound, efficient_error(true, sigma, noise, seen)


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
        ph.canonical(1),
        "k*q**2/2 + a*q**4/4 + p**2/2",
        {"p": "R_p"},
        {"p": "2*cos(13*t/10)"},
    )
    return TrueSystem(("q", "p"), rates, DUFFING, tuple(DUFFING))


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
    return DUFFING_START[None, :], normal


def duffing_case(noise: float, measured: tuple[str, ...], kept: float = 1.0) -> Case:
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
        80,
        measured,
        relative=True,
        kept=kept,
    )


def thesis_draw(system: System, rng: np.random.Generator) -> Drawn:
    """Starts and noise in the order in which `System.data` draws them."""
    shape = (system.n_steps + 1, len(system.states))
    starts = []
    normal = []
    for _ in range(system.n_trajectories):
        starts.append(system.start(rng))
        normal.append(rng.normal(size=shape))
    return np.array(starts), np.array(normal)


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
    draw = partial(thesis_draw, s)
    return Case(name, title, truth, model, draw, t, s.noise, n_seeds, s.states)


MASS_SPRING = {**SYSTEMS["mass_spring"].truth, "F_p[cos(omega_t*t)]": 0.0}


def on_support(name: str, leak: Dictionary | None = None) -> ph.Model:
    """The model of a system with the terms of its truth alone, without starting values;
    the phase of the mass-spring's force is free. The tanks have a leak if it is given.
    """
    model = tank_model(leak) if name == "tanks" else SYSTEMS[name].model()
    support = MASS_SPRING if name == "mass_spring" else SYSTEMS[name].truth
    terms = {name for name, entry in model.entries.items() if entry.prunable}
    return model.without(terms - set(support))


henon_heiles_model = partial(on_support, "henon_heiles")
schrodinger_model = partial(on_support, "schrodinger")
mass_spring_model = partial(on_support, "mass_spring")


def tanks_leak_model() -> ph.Model:
    """The tanks with the leak; its slope starts at half of the truth.

    At the kinks of the leak steps are halved until they are 64 times as fine.
    """
    return on_support("tanks", known_leak())


def _energy(support: Mapping[str, float]) -> tuple[str, dict[str, float]]:
    """The energy sum_i h_i term_i as text, and the values of h_i."""
    terms = {n[2:-1]: value for n, value in support.items() if n.startswith("H[")}
    texts = [f"h{i}*{term}" for i, term in enumerate(terms)]
    values = {f"h{i}": value for i, value in enumerate(terms.values())}
    return " + ".join(texts), values


@cache
def mass_spring() -> TrueSystem:
    """The mass-spring of the thesis; the phase of the force is free as a pair of sine
    and cosine.
    """
    energy, values = _energy(MASS_SPRING)
    force = "w1*sin(omega*t) + w2*cos(omega*t)"
    rates = pseudo_hamiltonian(
        ("q", "p"), ph.canonical(1), energy, {"p": "r"}, {"p": force}
    )
    names = {
        "r": "R_p",
        "w1": "F_p[sin(omega_t*t)]",
        "omega": "F_p.omega_t",
        "w2": "F_p[cos(omega_t*t)]",
    }
    values |= {symbol: MASS_SPRING[name] for symbol, name in names.items()}
    names_of_model = ("H[q**2]", "H[p**2]", *names.values())
    return TrueSystem(("q", "p"), rates, values, names_of_model)


@cache
def two_particles(name: str) -> TrueSystem:
    """S grad H of two particles, without losses and forces."""
    system = SYSTEMS[name]
    energy, values = _energy(system.truth)
    rates = pseudo_hamiltonian(system.states, ph.canonical(2), energy, {}, {})
    return TrueSystem(system.states, rates, values, tuple(system.truth))


@cache
def tanks() -> TrueSystem:
    """The tanks with the leak shut."""
    truth = SYSTEMS["tanks"].truth
    states = FLOWS + LEVELS
    energy, values = _energy(truth)
    losses = {flow: f"r{i}" for i, flow in enumerate(FLOWS)}
    rates = pseudo_hamiltonian(states, tank_structure(), energy, losses, {})
    values |= {symbol: truth[f"R_{flow}"] for flow, symbol in losses.items()}
    return TrueSystem(states, rates, values, tuple(truth))


def _cases() -> list[Case]:
    cases = []
    for measured in (("q", "p"), ("q",)):
        cases += [duffing_case(noise, measured) for noise in NOISE_LEVELS]
        cases.append(duffing_case(0.1, measured, kept=0.5))
    of_schrodinger = partial(two_particles, "schrodinger")
    of_henon_heiles = partial(two_particles, "henon_heiles")
    shut = partial(on_support, "tanks")
    return [
        *cases,
        thesis_case("mass_spring", mass_spring, mass_spring_model, 40),
        thesis_case("schrodinger", of_schrodinger, schrodinger_model, 40),
        thesis_case("tanks", tanks, shut, 10, remark=" (leak shut)"),
        thesis_case("henon_heiles", of_henon_heiles, henon_heiles_model, 20),
    ]


CASES = {case.name: case for case in _cases()}
