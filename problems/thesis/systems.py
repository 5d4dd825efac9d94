"""The four systems of the thesis: truth, data, candidate models and its own training
settings::

    system       | states         | training data                          | noise
    henon_heiles | q1 q2 p1 p2    | 3000 pairs, step 0.1                   | 0.02
    schrodinger  | q1 q2 p1 p2    | 50 x 100 steps of 0.01, 0.2 (-1, 1)    | 5e-4
    mass_spring  | q p            | 50 x 100 steps of 0.1, in a ring       | 0.2
    tanks        | phi1..5 mu1..4 | 60 x 50 steps of 0.01, starts (-1, 1)  | 0.005

The noise of Henon-Heiles is on each end of a pair on its own.

Where the text of the thesis and its code disagree, the code is followed, because its
data are what its results were made from (docs/thesis.md lists every choice).
`System.data` draws new data from the same distributions with any seed;
`System.thesis_data` reads the data of the thesis where they are present.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

import numpy as np

import phsi_opt as ph
from phsi_opt.baselines.gradient_descent import Descent
from phsi_opt.model.terms import Dictionary, Term
from problems.tools.data_paths import folder
from problems.tools.simulation import integrated

Vector = np.ndarray


@dataclass(frozen=True)
class System:
    """One system with its truth.

    ``truth`` are the coefficients of the pseudo-Hamiltonian dictionary that are not
    zero, ``truth_first_order`` those of the dictionary of right-hand sides. ``step``
    and ``n_steps`` describe one training trajectory, ``test_time`` the length of a test
    trajectory (101 samples). ``descent`` and ``descent_noisy`` are how gradient descent
    trains on clean and on noisy data, ``descent_thesis`` as the thesis prints it.
    """

    name: str
    title: str
    states: tuple[str, ...]
    rhs: Callable[[float, Vector], Vector]
    start: Callable[[np.random.Generator], Vector]
    n_trajectories: int
    n_steps: int
    step: float
    noise: float
    test_time: float
    truth: Mapping[str, float]
    truth_first_order: Mapping[str, float]
    model: Callable[[], ph.PseudoHamiltonian]
    first_order: Callable[[], ph.FirstOrder]
    descent: Descent
    descent_noisy: Descent
    descent_thesis: Descent
    l1: Mapping[str, float] = field(default_factory=dict)
    threshold: float = 0.05

    def solve(self, x0: Vector, t: Vector) -> Vector:
        """The true states (n_samples, n_states)."""
        return integrated(self.rhs, t, x0, rtol=1e-12, atol=1e-13)

    def data(
        self,
        seed: int,
        noise: float | None = None,
        n: int | None = None,
        refine: int = 1,
    ) -> ph.Measurements:
        """Training data as the thesis draws them: ``n`` trajectories, ``refine`` times
        as many steps in the same time.

        The starts and the standard normal numbers of the noise depend on the seed
        alone, not on the noise level.
        """
        rng = np.random.default_rng(seed)
        sigma = self.noise if noise is None else noise
        t = np.linspace(0.0, self.n_steps * self.step, self.n_steps * refine + 1)
        runs = []
        for _ in range(n or self.n_trajectories):
            x = self.solve(self.start(rng), t)
            runs.append(x + sigma * rng.normal(size=x.shape))
        return ph.Measurements.from_arrays([t] * len(runs), runs, states=self.states)

    def thesis_data(self, kind: str) -> ph.Measurements:
        """The data of the thesis, ``kind`` "clean" or "noisy" (two different draws)."""
        with np.load(folder("thesis") / f"{self.name}.npz") as stored:
            pairs = (
                stored[f"x_start_{kind}"],
                stored[f"x_end_{kind}"],
                stored["t_start"],
                stored["t_end"],
            )
        return joined_steps(*pairs, self.states)

    def training_data(self, kind: str) -> ph.Measurements:
        """`thesis_data` where they are present, else one draw per ``kind``."""
        if thesis_data_present():
            return self.thesis_data(kind)
        if kind == "clean":
            return self.data(1, 0.0)
        return self.data(2)

    def few(self, kind: str, sizes: Mapping[str, int]) -> ph.Measurements:
        """Newly drawn data of a quick run; the number of trajectories by system, else
        8.
        """
        noise = 0.0 if kind == "clean" else None
        return self.data(1, noise, n=sizes.get(self.name, 8))

    def shortened(self, epochs: int) -> "System":
        """The system of a quick run: a short training, that for clean data, for both
        kinds, and short free runs, since models that were hardly trained diverge.
        """
        short = replace(self.descent, epochs=epochs)
        return replace(
            self,
            descent=short,
            descent_noisy=short,
            descent_thesis=replace(self.descent_thesis, epochs=epochs),
            test_time=self.test_time / 8,
        )

    def tests(self, n: int = 10, seed: int = 1_000_003) -> tuple[Vector, Vector]:
        """Times (101,) and noise-free trajectories (n, 101, n_states) from unseen
        starts, beyond the training time.
        """
        rng = np.random.default_rng(seed)
        t = np.linspace(0.0, self.test_time, 101)
        return t, np.array([self.solve(self.start(rng), t) for _ in range(n)])


def joined_steps(
    x_start: Vector,
    x_end: Vector,
    t_start: Vector,
    t_end: Vector,
    states: Sequence[str],
) -> ph.Measurements:
    """The trajectories of integration steps, (n_steps, n_states) and (n_steps,).

    A step that starts exactly at the end of the step before it continues its
    trajectory; any other step starts a new one.
    """
    starts = np.column_stack([t_start, x_start])
    ends = np.column_stack([t_end, x_end])
    is_new = np.any(starts[1:] != ends[:-1], axis=1)
    runs = np.split(np.arange(len(starts)), np.flatnonzero(is_new) + 1)
    samples = [np.vstack([starts[rows], ends[rows[-1:]]]) for rows in runs]
    t, x = [run[:, 0] for run in samples], [run[:, 1:] for run in samples]
    return ph.Measurements.from_arrays(t, x, states=states)


def thesis_data_present() -> bool:
    """Whether the thesis' own data can be read."""
    return folder("thesis").is_dir()


# --- Henon-Heiles: H = (q1^2 + q2^2 + p1^2 + p2^2)/2 + q1^2 q2 - q2^3/3


def _henon_heiles(t: float, x: Vector) -> Vector:
    q1, q2, p1, p2 = x
    return np.array([p1, p2, -q1 - 2 * q1 * q2, -q2 - q1**2 + q2**2])


def _henon_heiles_start(rng: np.random.Generator) -> Vector:
    """q1, p1, p2 in (-1, 1), q2 in (-0.5, 1), kept where 1/12 <= H <= 1/6: bounded
    orbits.
    """
    while True:
        x = rng.uniform([-1, -0.5, -1, -1], 1.0)
        q1, q2, p1, p2 = x
        squares = q1**2 + q2**2 + p1**2 + p2**2
        energy = squares / 2 + q1**2 * q2 - q2**3 / 3
        if 1 / 12 <= energy <= 1 / 6:
            return x


# --- Schroedinger, d = 2 (thesis Eq. 6.3): H = ((q1^2 + p1^2)^2 + (q2^2 + p2^2)^2)/4
#     - q1^2 q2^2 - p1^2 p2^2 + q1^2 p2^2 + q2^2 p1^2 - 4 q1 q2 p1 p2


def _schrodinger(t: float, x: Vector) -> Vector:
    q1, q2, p1, p2 = x
    h_q1 = q1 * (q1**2 + p1**2) - 2 * q1 * q2**2 + 2 * q1 * p2**2 - 4 * q2 * p1 * p2
    h_q2 = q2 * (q2**2 + p2**2) - 2 * q1**2 * q2 + 2 * q2 * p1**2 - 4 * q1 * p1 * p2
    h_p1 = p1 * (q1**2 + p1**2) - 2 * p1 * p2**2 + 2 * p1 * q2**2 - 4 * q1 * q2 * p2
    h_p2 = p2 * (q2**2 + p2**2) - 2 * p1**2 * p2 + 2 * p2 * q1**2 - 4 * q1 * q2 * p1
    return np.array([h_p1, h_p2, -h_q1, -h_q2])


# --- mass-spring: dp/dt = -q - c p + alpha sin(omega t)

C = 0.3
ALPHA = 2.0
OMEGA = 0.5


def _mass_spring(t: float, x: Vector) -> Vector:
    return np.array([x[1], -x[0] - C * x[1] + ALPHA * np.sin(OMEGA * t)])


def _ring(rng: np.random.Generator) -> Vector:
    radius = 1 + 3.5 * np.sqrt(rng.random())
    angle = 2 * np.pi * rng.random()
    return radius * np.array([np.cos(angle), np.sin(angle)])


# --- tanks and pipes: pipes join tanks (1,2) (1,3) (1,4) (2,3) (3,4); tank 4 leaks

FLOWS = ("phi1", "phi2", "phi3", "phi4", "phi5")
LEVELS = ("mu1", "mu2", "mu3", "mu4")
# In the order of the columns of the data.
PIPES = ((1, 2), (1, 3), (1, 4), (2, 3), (3, 4))
DENSITY = 1.0
GRAVITY = 9.81
INERTIA = 0.02
AREA = 1.0
DAMPING = np.array([0.03, 0.03, 0.09, 0.05, 0.05])
LEAK_SLOPE = 10.0
LEAK_LIMIT = 0.3


def incidence() -> Vector:
    """Oriented incidence matrix B (4 tanks x 5 pipes): -1 at the tank named first, +1
    at the other.
    """
    B = np.zeros((4, 5))
    for pipe, (first, second) in enumerate(PIPES):
        B[first - 1, pipe] = -1.0
        B[second - 1, pipe] = 1.0
    return B


def tank_structure() -> Vector:
    """S = [[0, B'], [-B, 0]], as in the thesis' code: a flow counts from the second
    tank of a pipe to the first.
    """
    B = incidence()
    return np.block([[np.zeros((5, 5)), B.T], [-B, np.zeros((4, 4))]])


def leak(level: Vector | float) -> Vector | float:
    """Flow out of tank 4: 10 times its level, limited to +-3. (The text prints a
    constant; its code means this.)
    """
    return -LEAK_SLOPE * np.clip(level, -LEAK_LIMIT, LEAK_LIMIT)


def tank_matrix() -> Vector:
    """The right-hand side of the tanks with the leak shut, dx/dt = matrix x."""
    losses = np.diag(np.r_[DAMPING, np.zeros(4)])
    efforts = np.r_[np.full(5, 1 / INERTIA), np.full(4, DENSITY * GRAVITY / AREA)]
    return (tank_structure() - losses) @ np.diag(efforts)


_TANK_MATRIX = tank_matrix()


def _tanks(t: float, x: Vector) -> Vector:
    dx = _TANK_MATRIX @ x
    dx[8] += leak(x[8])
    return dx


def closed_tanks(t: float, x: Vector) -> Vector:
    """The tanks with the leak shut."""
    return _TANK_MATRIX @ x


def tank_model(force: Dictionary | None = None) -> ph.PseudoHamiltonian:
    """All polynomials of degree 2 in the nine states, damping in the five pipes;
    ``force`` on tank 4.
    """
    states = FLOWS + LEVELS
    return ph.PseudoHamiltonian(
        states=states,
        S=tank_structure(),
        H=ph.polynomials(states, degree=2),
        R=ph.damping(*FLOWS),
        F={} if force is None else {"mu4": force},
    )


def known_leak() -> Dictionary:
    """The leak with its form and limit known and its size unknown."""
    return ph.formula(
        "-slope*min(max(mu4, -limit), limit)",
        slope=ph.Parameter(5.0, lower=0.0),
        limit=LEAK_LIMIT,
    )


# --- candidate models and truths by coefficient


def _polynomial_energy(
    states: tuple[str, ...], degree: int
) -> Callable[[], ph.PseudoHamiltonian]:
    return lambda: ph.PseudoHamiltonian(
        states=states, S=ph.canonical(2), H=ph.polynomials(states, degree=degree)
    )


def _polynomial_rates(
    states: tuple[str, ...], degree: int
) -> Callable[[], ph.FirstOrder]:
    return lambda: ph.FirstOrder(
        states, {x: ph.polynomials(states, degree=degree) for x in states}
    )


def _mass_spring_model() -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.polynomials(["q", "p"], degree=3),
        R=ph.damping("p"),
        F={"p": ph.polynomials(["t"], degree=3) + ph.trigonometric("t")},
    )


def mass_spring_descent_model() -> ph.PseudoHamiltonian:
    """The mass-spring as thesis Eq. 5.5 has it: the sine and the cosine have a
    frequency each.
    """
    waves = tuple(
        Term(f"{wave}({omega}*t)", ph.Parameter(), {omega: ph.Parameter(lower=0.0)})
        for wave, omega in (("sin", "omega_s"), ("cos", "omega_c"))
    )
    return replace(
        _mass_spring_model(),
        F={"p": ph.polynomials(["t"], degree=3) + Dictionary(waves)},
    )


def _mass_spring_rates() -> ph.FirstOrder:
    """Polynomials in the states and in the time in both equations; the wave, as in
    PHSI, in that of the momentum.
    """
    both = ph.polynomials(["q", "p"], degree=3, constant=True) + ph.polynomials(
        ["t"], degree=3
    )
    return ph.FirstOrder(["q", "p"], {"q": both, "p": both + ph.trigonometric("t")})


# --- how gradient descent trains: Adam in batches of 32

# The weight decay of all experiments (appendix B).
THESIS_DECAY = 1e-4


def tuned_descent(
    rate: float, epochs: int, every: int, threshold: float, l1_of_energy: float = 0.0
) -> Descent:
    """Rate, epochs and pruning of the thesis, from twice the first interval on, as its
    code has it. Tuned (on System.data(seed=101)): the rate decays along a cosine.

    L1 on H, which ends after half of the epochs, is that of this package's loss, a sum
    over the states.
    """
    return Descent(
        rate,
        epochs,
        decay="cosine",
        prune_every=every,
        prune_from=2 * every,
        threshold=threshold,
        l1={"H": l1_of_energy} if l1_of_energy else {},
    )


def printed_descent(tuned: Descent, n_states: int, **changes: Any) -> Descent:
    """Appendix B as it is printed: the rate is constant to the end, with weight decay.

    The loss of the thesis is a mean over the states, so that its weights are multiplied
    by their number.
    """
    weight_decay = THESIS_DECAY * n_states
    return replace(tuned, decay="none", weight_decay=weight_decay, **changes)


_Q = ("q1", "q2", "p1", "p2")


def coefficients(slot: str, text: str) -> dict[str, float]:
    """Coefficients by name, of a text such as "q1**2 1/2, q2**3 -1/3"."""
    entries = [entry.split() for entry in text.split(",")]
    return {f"{slot}[{term}]": float(Fraction(value)) for term, value in entries}


def _rates(**texts: str) -> dict[str, float]:
    """The same for the right-hand side of each state."""
    found: dict[str, float] = {}
    for state, text in texts.items():
        found |= coefficients(f"F_{state}", text)
    return found


def _tank_rates_truth() -> dict[str, float]:
    states = FLOWS + LEVELS
    return {
        f"F_{states[i]}[{states[j]}]": float(entry)
        for (i, j), entry in np.ndenumerate(_TANK_MATRIX)
        if entry
    }


_HENON_HEILES = System(
    name="henon_heiles",
    title="Henon-Heiles",
    states=_Q,
    rhs=_henon_heiles,
    start=_henon_heiles_start,
    n_trajectories=3000,
    n_steps=1,
    step=0.1,
    noise=0.02,
    test_time=8.0,
    truth=coefficients(
        "H", "q1**2 1/2, q2**2 1/2, p1**2 1/2, p2**2 1/2, q1**2*q2 1, q2**3 -1/3"
    ),
    truth_first_order=_rates(
        q1="p1 1", q2="p2 1", p1="q1 -1, q1*q2 -2", p2="q2 -1, q1**2 -1, q2**2 1"
    ),
    model=_polynomial_energy(_Q, 3),
    first_order=_polynomial_rates(_Q, 2),
    # The cosine is all that was tuned.
    descent=tuned_descent(3e-3, 60, 5, 0.05),
    descent_noisy=tuned_descent(1e-3, 60, 5, 0.05),
    descent_thesis=printed_descent(tuned_descent(3e-3, 60, 5, 0.05), 4),
)

_SCHRODINGER_DESCENT = tuned_descent(1e-2, 100, 20, 0.04)
_SCHRODINGER = System(
    name="schrodinger",
    title="Schroedinger",
    states=_Q,
    rhs=_schrodinger,
    start=lambda rng: 0.2 * rng.uniform(-1, 1, 4),
    n_trajectories=50,
    n_steps=100,
    step=0.01,
    noise=5e-4,
    test_time=8.0,
    truth=coefficients(
        "H",
        "q1**4 1/4, p1**4 1/4, q1**2*p1**2 1/2, q2**4 1/4, p2**4 1/4, "
        "q2**2*p2**2 1/2, q1**2*q2**2 -1, p1**2*p2**2 -1, q1**2*p2**2 1, "
        "q2**2*p1**2 1, q1*q2*p1*p2 -4",
    ),
    truth_first_order=_rates(
        q1="q1**2*p1 1, p1**3 1, p1*p2**2 -2, q2**2*p1 2, q1*q2*p2 -4",
        q2="q2**2*p2 1, p2**3 1, p1**2*p2 -2, q1**2*p2 2, q1*q2*p1 -4",
        p1="q1**3 -1, q1*p1**2 -1, q1*q2**2 2, q1*p2**2 -2, q2*p1*p2 4",
        p2="q2**3 -1, q2*p2**2 -1, q1**2*q2 2, q2*p1**2 -2, q1*p1*p2 4",
    ),
    model=_polynomial_energy(_Q, 4),
    first_order=_polynomial_rates(_Q, 3),
    threshold=0.04,
    # The cosine is all that was tuned.
    descent=_SCHRODINGER_DESCENT,
    descent_noisy=_SCHRODINGER_DESCENT,
    # The text's threshold is 0.05, its code's 0.04, which is taken.
    descent_thesis=printed_descent(_SCHRODINGER_DESCENT, 4),
)

# Tuned: no L1 on F (the thesis: 0.01) and no weight decay (1e-4), which only shrink the
# wave. The rate is that of the thesis' code (its text: 3e-3).
_MASS_SPRING_DESCENT = tuned_descent(5e-3, 150, 20, 0.05, 0.1 * 2)
_WAVE = {"F_p[sin(omega_t*t)]": ALPHA, "F_p.omega_t": OMEGA}
_MASS_SPRING = System(
    name="mass_spring",
    title="Mass-spring",
    states=("q", "p"),
    rhs=_mass_spring,
    start=_ring,
    n_trajectories=50,
    n_steps=100,
    step=0.1,
    noise=0.2,
    test_time=20.0,
    truth={**coefficients("H", "q**2 1/2, p**2 1/2"), "R_p": C, **_WAVE},
    truth_first_order={**_rates(q="p 1", p="q -1"), "F_p[p]": -C, **_WAVE},
    model=_mass_spring_model,
    first_order=_mass_spring_rates,
    l1={"H": 0.01, "F": 0.01},
    descent=_MASS_SPRING_DESCENT,
    descent_noisy=_MASS_SPRING_DESCENT,
    descent_thesis=printed_descent(
        _MASS_SPRING_DESCENT, 2, learning_rate=3e-3, l1={"H": 0.1 * 2, "F": 0.01 * 2}
    ),
)

# Tuned: no weight decay. Appendix B's lambda_1 = 0.5 is read as that of H (the order of
# Eq. 5.6); the other way round, circulations, which S does not see, stay in H.
_TANK_DESCENT = tuned_descent(3e-2, 100, 10, 0.05, 0.5 * 9)
_TANKS = System(
    name="tanks",
    title="Tanks and pipes",
    states=FLOWS + LEVELS,
    rhs=_tanks,
    start=lambda rng: rng.uniform(-1, 1, 9),
    n_trajectories=60,
    n_steps=50,
    step=0.01,
    noise=0.005,
    test_time=1.0,
    truth={
        **{f"H[{s}**2]": 0.5 / INERTIA for s in FLOWS},
        **{f"H[{s}**2]": 0.5 * DENSITY * GRAVITY / AREA for s in LEVELS},
        **{f"R_{s}": float(r) for s, r in zip(FLOWS, DAMPING, strict=True)},
    },
    truth_first_order=_tank_rates_truth(),
    model=tank_model,
    first_order=_polynomial_rates(FLOWS + LEVELS, 1),
    l1={"H": 1e-3},
    descent=_TANK_DESCENT,
    descent_noisy=_TANK_DESCENT,
    descent_thesis=printed_descent(_TANK_DESCENT, 9),
)

SYSTEMS = {s.name: s for s in (_HENON_HEILES, _SCHRODINGER, _MASS_SPRING, _TANKS)}
