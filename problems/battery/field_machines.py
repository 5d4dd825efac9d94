"""Machines that an engineer meets, each drawn with a hidden effect: masses on springs,
a ship's roll, pendulums, falls, control, circuits, heat, gas.

Each function returns an `Experiment`: the truth, the base model, the inputs. The laws
are from textbooks; nothing is taken from the package.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.battery.experiments import Experiment, Hidden, Law, Values, held_between
from problems.battery.records import Array, Truth, log_uniform

# --- hidden forces on a mass whose states are a position and a momentum

# Dry friction turns over within this share of the typical speed.
CORNER = 0.005


def on_momentum(force: Callable[[Array], Array]) -> Law:
    """The force, from the states, in the second of two rates."""

    def added(x: Array, u: Array) -> Array:
        rates = np.zeros_like(x)
        rates[..., 1] = force(x)
        return rates

    return added


def _hidden(names: tuple[str, ...], law: Law, largest: float, at: str = "p") -> Hidden:
    return Hidden(names[0], law, (Truth(names, (at,), 1.0),), largest)


def viscous(mass: float, largest: float) -> Hidden:
    """-c v; in a storage's equation the same term is a leak."""
    law = on_momentum(lambda x: -x[..., 1] / mass)
    return _hidden(("viscous damping", "linear leak"), law, largest)


def quadratic(mass: float, largest: float) -> Hidden:
    """-c v |v|."""
    law = on_momentum(lambda x: -np.abs(x[..., 1]) * x[..., 1] / mass**2)
    return _hidden(("quadratic drag",), law, largest)


def coulomb(mass: float, speed: float, largest: float) -> Hidden:
    """-f tanh(v/w), w a small share of the typical speed."""
    width = CORNER * speed
    law = on_momentum(lambda x: -np.tanh(x[..., 1] / mass / width))
    return _hidden(("coulomb friction",), law, largest)


def cubic(largest: float) -> Hidden:
    """-b q^3."""
    return _hidden(
        ("cubic stiffness",), on_momentum(lambda x: -(x[..., 0] ** 3)), largest
    )


def _positive(value: float) -> ph.Parameter:
    return ph.Parameter(value, lower=0.0)


def moving(energy: str, q: str = "q", **parts: Any) -> Callable[..., ph.Model]:
    """Makes a model of a position and a momentum from the numbers of its energy."""
    return lambda **numbers: ph.PseudoHamiltonian(
        states=[q, "p"], S=ph.canonical(1), H=ph.formula(energy, **numbers), **parts
    )


# --- a mass on a spring: short runs of an oscillator, a ship's roll

PER_PERIOD = 40  # samples of a short run
PER_ROLL = 24  # samples in a period of a longer record
N_ROLLS = (6, 10)  # periods of a roll decay
LARGEST_DAMPING = 0.3  # damping ratio of a hidden damper
LARGEST_ROLL_DAMPING = 0.12
# Share of the spring's force that a cubic spring or a drag has at the largest swing.
LARGEST_SHARE = 0.7
LARGEST_DRAG = 0.4


def spring(
    mass: float,
    stiffness: float,
    damping: float,
    hidden: Hidden,
    t: Array,
    starts: Array,
    n_train: int,
    seen: tuple[int, ...] = (0,),
) -> Experiment:
    """A mass on a spring; damped unless its damper is hidden. The mass is known."""
    is_damped = hidden.name != "viscous damping"
    values = {"k": stiffness} | ({"c": damping} if is_damped else {})

    def rates(x: Array, u: Array, values: Values) -> Array:
        v = x[..., 1] / mass
        force = -values["k"] * x[..., 0]
        if is_damped:
            force = force - values["c"] * v
        return np.stack([v, force], axis=-1)

    R = {"p": ph.formula("c", c=_positive(damping))} if is_damped else {}
    model = moving(f"k*q**2/2 + p**2/(2*{mass!r})", R=R)(k=_positive(stiffness))
    period = 2 * np.pi / float(np.sqrt(stiffness / mass))
    return Experiment(
        rates, values, model, hidden, t, starts, n_train, row=1, time=period, seen=seen
    )


def drawn_spring(
    rng: np.random.Generator,
    ratios: tuple[float, float],
    names: list[str],
    largest_ratio: float,
    is_short: bool = False,
) -> Experiment:
    """A spring with one of the effects hidden.

    Long runs are released nearly at rest from several angles, the last of them held
    out; short ones begin at a random phase, and may measure the momentum too.
    """
    m = float(log_uniform(rng, 0.5, 2.0))
    k = float(log_uniform(rng, 0.5, 8.0))
    ratio = float(log_uniform(rng, *ratios))
    damping = 2 * ratio * np.sqrt(k * m)
    swing = float(rng.uniform(0.5, 1.5))
    frequency = float(np.sqrt(k / m))
    period = 2 * np.pi / frequency
    name = str(rng.choice(names))
    if name == "viscous damping":
        hidden = viscous(m, 2 * largest_ratio * np.sqrt(k * m))
    elif name == "quadratic drag":
        hidden = quadratic(m, LARGEST_DRAG * m / swing)
    else:
        hidden = cubic(LARGEST_SHARE * k / swing**2)
    if is_short:
        seen = (0, 1) if rng.random() < 0.5 else (0,)
        t = np.arange(int(rng.uniform(1, 3) * PER_PERIOD)) * period / PER_PERIOD
        shares = np.array([1.0, 0.8])
        phase = rng.uniform(0, 2 * np.pi, len(shares))
        q = swing * shares * np.cos(phase)
        p = m * (swing * shares * frequency * np.sin(phase))
        starts = np.stack([q, p], axis=1)
        return spring(m, k, damping, hidden, t, starts, 1, seen)
    t = np.arange(int(rng.uniform(*N_ROLLS) * PER_ROLL)) * period / PER_ROLL
    q = swing * (np.array([1.0, -0.75, 0.5, 0.85]) * rng.uniform(0.9, 1.0, 4))
    p = 0.03 * m * frequency * swing * rng.normal(size=4)
    return spring(m, k, damping, hidden, t, np.stack([q, p], axis=1), 3)


def short_run(rng: np.random.Generator) -> Experiment:
    """One run of one to three periods; another one held out."""
    names = ["viscous damping", "cubic stiffness"]
    return drawn_spring(rng, (0.02, 0.08), names, LARGEST_DAMPING, is_short=True)


def long_runs(rng: np.random.Generator) -> Experiment:
    """Runs of several periods, as `short_run` else."""
    names = ["viscous damping", "cubic stiffness"]
    return drawn_spring(rng, (0.01, 0.03), names, LARGEST_DAMPING / 2)


def roll_decay(rng: np.random.Generator) -> Experiment:
    """A ship that rolls out from a list; its roll angle alone is measured."""
    names = ["viscous damping", "quadratic drag", "cubic stiffness"]
    return drawn_spring(rng, (0.01, 0.04), names, LARGEST_ROLL_DAMPING)


# --- a pendulum: energy over that of the top, and samples

OVER_THE_TOP = (1.15, 2.5)
N_PENDULUM = 220
PENDULUM_PERIODS = (4.0, 6.0)


def pendulum(rng: np.random.Generator) -> Experiment:
    """A pendulum that goes over the top before it swings; friction is hidden.

    With dry friction it may stick before the record ends.
    """
    inertia = float(log_uniform(rng, 0.5, 2.0))
    torque = float(log_uniform(rng, 2.0, 10.0))  # of gravity, when level
    frequency = float(np.sqrt(torque / inertia))
    energy = 2 * torque * rng.uniform(*OVER_THE_TOP, 4)
    momentum = np.sqrt(2 * inertia * energy) * np.array([1.0, -1.0, 1.0, -1.0])
    starts = np.stack([0.1 * rng.normal(size=4), momentum], axis=1)
    end = rng.uniform(*PENDULUM_PERIODS) * 2 * np.pi / frequency
    speed = float(np.sqrt(energy.mean() / inertia))
    if rng.random() < 0.5:
        least, largest = 2 * inertia * frequency * np.array([0.02, 0.1])
        hidden = viscous(inertia, largest)
    else:
        least, largest = torque * np.array([0.05, 0.2])
        hidden = coulomb(inertia, speed, largest)

    def rates(x: Array, u: Array, values: Values) -> Array:
        force = -values["G"] * np.sin(x[..., 0])
        return np.stack([x[..., 1] / inertia, force], axis=-1)

    return Experiment(
        rates,
        values={"G": torque},
        model=moving(f"p**2/(2*{inertia!r}) - G*cos(q)")(G=_positive(torque)),
        hidden=replace(hidden, least=least, is_drawn=True),
        t=np.linspace(0, end, N_PENDULUM),
        starts=starts,
        n_train=3,
        row=1,
        time=2 * np.pi / frequency,
        loudest=np.inf,
    )


# --- falling bodies

EARTH = 9.81
N_FALL = 120  # samples of the highest drop
# Terminal speed over the speed at the ground without drag, at least.
SLOWEST = 0.4


def falling(rng: np.random.Generator, is_heavy: bool | None = None) -> Experiment:
    """Drops from several heights; the height is measured, the drag is hidden."""
    mass = float(log_uniform(rng, 0.05, 2.0))
    highest = float(log_uniform(rng, 3.0, 40.0))
    shares = np.array([1.0, rng.uniform(0.6, 0.8), rng.uniform(0.4, 0.6), 0.9])
    speed = float(np.sqrt(2 * EARTH * highest))
    duration = speed / EARTH
    momenta = 0.02 * mass * speed * rng.normal(size=4)
    slowest = SLOWEST * speed
    if rng.random() < 0.5:
        hidden = viscous(mass, mass * EARTH / slowest)
    else:
        hidden = quadratic(mass, mass * EARTH / slowest**2)
    knows_gravity = rng.random() < 0.5
    drawn_heavy = rng.random() < 0.3

    def rates(x: Array, u: Array, values: Values) -> Array:
        force = np.zeros_like(x[..., 1]) - mass * values.get("g", EARTH)
        return np.stack([x[..., 1] / mass, force], axis=-1)

    model = moving(f"{mass!r}*g*h + p**2/(2*{mass!r})", "h")
    return Experiment(
        rates,
        values={} if knows_gravity else {"g": EARTH},
        model=model(g=EARTH if knows_gravity else _positive(EARTH)),
        hidden=hidden,
        t=np.linspace(0.0, duration, N_FALL),
        starts=np.stack([highest * shares, momenta], axis=1),
        n_train=3,
        row=1,
        time=duration,
        n_kept=tuple(int(N_FALL * np.sqrt(share)) for share in shares),
        is_faint=drawn_heavy if is_heavy is None else is_heavy,
    )


# --- a mass that a controller moves

N_CONTROLLED = 160
N_MOVES = (2.0, 3.0)  # periods of the reference in a run
DAMPING = 0.7  # of the closed loop
# Friction over the largest inertial force of the reference.
FRICTION = (0.2, 0.8)


def closed_loop(rng: np.random.Generator) -> Experiment:
    """Proportional and differential control along two sines; its force and the position
    are measured, friction is hidden.

    The controller answers at every sample, so force, speed and input go together.
    """
    n_runs = 4
    mass = float(log_uniform(rng, 0.5, 5.0))
    slow = float(log_uniform(rng, 1.0, 4.0))  # frequency of the reference
    stiff = slow * rng.uniform(3.0, 5.0)  # of the closed loop
    gain = mass * stiff**2
    rate_gain = 2 * DAMPING * mass * stiff
    sizes = rng.uniform(0.5, 1.0, (n_runs, 2)) * np.array([1.0, 0.3])
    phases = rng.uniform(0, 2 * np.pi, (n_runs, 2))
    frequencies = slow * np.array([1.0, 2.3])

    def reference(t: float) -> Array:
        return np.sum(sizes * np.sin(frequencies * t + phases), axis=1)

    def control(t: float, x: Array) -> Array:
        force = gain * (reference(t) - x[:, 0]) - rate_gain * x[:, 1] / mass
        return force[:, None]

    def rates(x: Array, u: Array, values: Values) -> Array:
        v = x[..., 1] / values["m"]
        return np.stack([v, np.broadcast_to(u[..., 0], v.shape)], axis=-1)

    speed = float(np.sqrt(np.mean((sizes * frequencies) ** 2)))
    force = mass * slow**2 * float(sizes[:, 0].mean())
    if rng.random() < 0.5:
        hidden = viscous(mass, FRICTION[1] * force / speed)
    else:
        hidden = coulomb(mass, speed, FRICTION[1] * force)
    least = hidden.largest * FRICTION[0] / FRICTION[1]
    end = rng.uniform(*N_MOVES) * 2 * np.pi / slow
    model = moving("p**2/(2*m)", inputs=["u"], F={"p": ph.formula("u")})
    return Experiment(
        rates,
        values={"m": mass},
        model=model(m=_positive(mass)),
        hidden=replace(hidden, least=least, is_drawn=True),
        t=np.linspace(0.0, end, N_CONTROLLED),
        starts=np.stack([reference(0.0), np.zeros(n_runs)], axis=1),
        n_train=3,
        row=1,
        time=2 * np.pi / slow,
        input_at=control,
        hold="zero",
        is_sampled=True,
        loudest=np.inf,
    )


# --- a series circuit: current = dH/dflux

PER_RESONANCE = 28  # samples
N_PERIODS = (6, 9)
LARGEST_RESISTANCE = 0.4  # over that of critical damping
LARGEST_SATURATION = 0.7  # of the current, at the largest flux


def circuit(rng: np.random.Generator) -> Experiment:
    """Resistor, coil and capacitor at a measured voltage; the coil saturates, or the
    resistance is missing.

    A coil that saturates adds b flux^4/4 to the energy: current = flux/L + b flux^3,
    which the resistor answers too.
    """
    n_runs = 3
    coil = float(log_uniform(rng, 0.5, 2.0))
    elastance = float(log_uniform(rng, 0.5, 4.0))  # 1 over the capacity
    critical = 2 * np.sqrt(elastance * coil)
    resistance = critical * float(log_uniform(rng, 0.04, 0.12))
    period = 2 * np.pi * np.sqrt(coil / elastance)
    saturates = rng.random() < 0.5
    n_samples = int(rng.uniform(*N_PERIODS) * PER_RESONANCE)
    # Two sines of voltage beside the resonance, others in every run.
    sizes = elastance * rng.uniform(0.3, 0.7, (n_runs, 2))
    frequencies = 2 * np.pi / period * rng.uniform(0.4, 1.4, (n_runs, 2))
    phases = rng.uniform(0, 2 * np.pi, (n_runs, 2))
    starts = np.stack([rng.normal(size=n_runs), np.zeros(n_runs)], axis=1)

    def voltage(time: float, x: Array) -> Array:
        waves = sizes * np.sin(frequencies * time + phases)
        return waves.sum(axis=1)[:, None]

    def rates(x: Array, u: Array, values: Values) -> Array:
        current = x[..., 1] / coil
        drop = values["s"] * x[..., 0]
        if saturates:
            drop = drop + values["R"] * current
        return np.stack([current, u[..., 0] - drop], axis=-1)

    def saturation(x: Array, u: Array) -> Array:
        more = x[..., 1] ** 3
        return np.stack([more, -resistance * more], axis=-1)

    seen = [(0,), (1,), (0, 1)][rng.integers(3)]
    if saturates:
        # Flux is measured as current times L, which a saturating coil does not allow.
        seen = (0,)
        largest_flux = 1.5 * np.sqrt(elastance * coil)
        largest = LARGEST_SATURATION / coil / largest_flux**2
        truth = Truth(("coil saturation",), ("flux",), 1.0)
        hidden = Hidden("saturating coil", saturation, (truth,), largest)
    else:
        truth = Truth(("linear resistance",), ("flux",), 1.0)
        law = on_momentum(lambda x: -x[..., 1] / coil)
        hidden = Hidden("resistance", law, (truth,), LARGEST_RESISTANCE * critical)
    model = ph.PseudoHamiltonian(
        states=["q", "flux"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula(f"s*q**2/2 + flux**2/(2*{coil!r})", s=_positive(elastance)),
        R={"flux": ph.formula("R", R=_positive(resistance))} if saturates else {},
        F={"flux": ph.formula("u")},
        kind="electrical",
    )
    return Experiment(
        rates,
        values={"s": elastance} | ({"R": resistance} if saturates else {}),
        model=model,
        hidden=hidden,
        t=np.arange(n_samples) * period / PER_RESONANCE,
        starts=starts,
        n_train=2,
        row=1,
        time=period,
        seen=seen,
        input_at=voltage,
    )


# --- two bodies, one heated

N_HEATED = 150  # samples
N_CONSTANTS = (3.0, 6.0)  # time constants in a run
LOSS, COUPLING, RADIATION = "loss to ambient", "heat exchange", "quadratic loss"
LARGEST = 3.0  # hidden conductance over that of a body that is known
POWER = (0.0, 8.0)
AMBIENT = (0.2, 1.5)  # above the reference, as all temperatures
N_POWERS = 8  # levels of the power in a run


def thermal(rng: np.random.Generator) -> Experiment:
    """Temperatures above a reference; heater power and the ambient temperature are
    inputs. One of the three ways that heat leaves the first body is hidden.

        C1 dT1/dt = P - g1 (T1 - Ta) - g12 (T1 - T2)
        C2 dT2/dt =   - g2 (T2 - Ta) - g12 (T2 - T1)
    """
    n_runs = 3
    name = str(rng.choice([LOSS, COUPLING, RADIATION]))
    C1 = float(log_uniform(rng, 0.5, 2.0))
    C2 = float(log_uniform(rng, 0.5, 2.0))
    true = {key: float(log_uniform(rng, 0.5, 1.5)) for key in ("g1", "g2", "g12")}
    t = np.linspace(0.0, rng.uniform(*N_CONSTANTS), N_HEATED)
    # Power in steps, and an ambient temperature that goes up and down.
    levels = rng.uniform(*POWER, (n_runs, N_POWERS))
    power = levels[:, np.arange(len(t)) * N_POWERS // len(t)]
    low, high = AMBIENT
    phases = rng.uniform(0, 2 * np.pi, (n_runs, 1))
    day = rng.uniform(0.5, 1.0, (n_runs, 1)) * t[-1]
    ambient = low + (high - low) * ((1 + np.sin(2 * np.pi * t / day + phases)) / 2)
    recorded = np.stack([power.T, ambient.T], axis=-1)
    starts = rng.uniform(1.0, 4.0, (n_runs, 2))
    absent = {LOSS: "g1", COUPLING: "g12"}.get(name, "")
    values = {key: value for key, value in true.items() if key != absent}

    def inputs(time: float, x: Array) -> Array:
        return held_between(recorded, t, time)

    def rates(x: Array, u: Array, values: Values) -> Array:
        lost1 = values.get("g1", 0.0) * (x[..., 0] - u[..., 1])
        lost2 = values.get("g2", 0.0) * (x[..., 1] - u[..., 1])
        passed = values.get("g12", 0.0) * (x[..., 0] - x[..., 1])
        first = (u[..., 0] - lost1 - passed) / C1
        return np.stack([first, (passed - lost2) / C2], axis=-1)

    return Experiment(
        rates,
        values,
        model=_heated(values, C1, C2),
        hidden=_hidden_heat(name, C1, C2),
        t=t,
        starts=starts,
        n_train=2,
        row=0,
        time=1.0,
        seen=(0, 1),
        input_at=inputs,
        hold="zero",
    )


def _heated(values: Mapping[str, float], C1: float, C2: float) -> ph.Model:
    flows = {
        "g1": (" - g1*(T1 - Ta)", ""),
        "g2": ("", "-g2*(T2 - Ta)"),
        "g12": (" - g12*(T1 - T2)", " + g12*(T1 - T2)"),
    }
    texts = {"T1": "P", "T2": ""}
    free: dict[str, dict[str, ph.Parameter]] = {"T1": {}, "T2": {}}
    for name, value in values.items():
        parameter = _positive(value)
        for state, flow in zip(texts, flows[name], strict=True):
            texts[state] += flow
            if flow:
                free[state][name] = parameter
    first = ph.formula(f"({texts['T1']})/{C1!r}", **free["T1"])
    second = ph.formula(f"({texts['T2']})/{C2!r}", **free["T2"])
    rates = {"T1": first, "T2": second}
    return ph.FirstOrder(["T1", "T2"], rates, inputs=["P", "Ta"], kind="thermal")


def _hidden_heat(name: str, C1: float, C2: float) -> Hidden:
    """The hidden flow of heat, with what a catalogue of single terms says of it.

    A loss to the ambient is an exchange with it, or a loss to the reference beside a
    gain of the ambient temperature.
    """

    def law(x: Array, u: Array) -> Array:
        if name == COUPLING:
            flow = x[..., 0] - x[..., 1]
            return np.stack([-flow / C1, flow / C2], axis=-1)
        if name == LOSS:
            rate = -(x[..., 0] - u[..., 1]) / C1
        else:
            rate = -np.abs(x[..., 0]) * x[..., 0] / C1
        return np.stack([rate, np.zeros_like(rate)], axis=-1)

    truths = {
        LOSS: (
            Truth(("heat loss", "heat exchange with Ta"), ("T1",), 1 / C1),
            Truth(("input gain of Ta",), ("T1",), 1 / C1),
        ),
        COUPLING: (
            Truth(("heat exchange with T2",), ("T1",), 1 / C1),
            Truth(("heat exchange with T1",), ("T2",), 1 / C2),
            Truth(("exchange of heat between T1 and T2",), ("",)),
        ),
        RADIATION: (Truth(("quadratic heat loss",), ("T1",), 1 / C1),),
    }
    return Hidden(name, law, truths[name], LARGEST)


# --- a gas chamber that leaks

N_GAS = 150  # samples
LAMINAR = 1e-3  # share of the first pressure below which a turbulent leak is linear
LARGEST_LOSS = 1.5  # of the first gas, in a run at the first rate
N_INFLOWS = 6  # levels of the inflow in a run
LEAKS = {  # power of the pressure, and the names that are right
    "linear leak": (1.0, ("linear leak", "viscous damping")),
    "turbulent leak": (0.5, ("turbulent leak",)),
    "quadratic leak": (2.0, ("quadratic leak", "quadratic drag")),
}


def chamber(rng: np.random.Generator, has_inflow: bool | None = None) -> Experiment:
    """One storage without losses, whose gas is measured; a leak is hidden.

    dn/dt = b u - leak(P),   P = n/C
    """
    n_runs = 3
    capacity = float(log_uniform(rng, 0.5, 2.0))
    pressure = float(log_uniform(rng, 1.0, 5.0))
    duration = float(log_uniform(rng, 5.0, 50.0))
    name = str(rng.choice(list(LEAKS)))
    drawn_inflow = rng.random() < 0.5
    is_fed = drawn_inflow if has_inflow is None else has_inflow
    shares = np.array([1.0, rng.uniform(0.5, 0.7), 0.85])
    t = np.linspace(0.0, duration, N_GAS)
    mean_rate = capacity * pressure / duration
    levels = mean_rate * rng.uniform(0.0, 1.5, (n_runs, N_INFLOWS))
    inflow = levels[:, np.arange(N_GAS) * N_INFLOWS // N_GAS]
    gain = float(rng.uniform(0.8, 1.25))
    power, names = LEAKS[name]
    laminar = LAMINAR * pressure

    def fed(time: float, x: Array) -> Array:
        return held_between(inflow.T[..., None], t, time)

    def rates(x: Array, u: Array, values: Values) -> Array:
        if not is_fed:
            return np.zeros_like(x)
        return np.zeros_like(x) + (values["b"] * u[..., 0])[..., None]

    def leak(x: Array, u: Array) -> Array:
        P = x / capacity
        return -P * (P**2 + laminar**2) ** ((power - 1) / 2)

    model = ph.PseudoHamiltonian(
        states=["n"],
        inputs=["u"] if is_fed else [],
        S=np.zeros((1, 1)),
        H=ph.formula(f"n**2/(2*{capacity!r})"),
        F={"n": ph.formula("b*u", b=_positive(gain))} if is_fed else {},
        kind="hydraulic",
    )
    # At the first pressure the leak's rate is at most as given.
    largest = LARGEST_LOSS * mean_rate / pressure**power
    return Experiment(
        rates,
        values={"b": gain} if is_fed else {},
        model=model,
        hidden=_hidden(names, leak, largest, "n"),
        t=t,
        starts=capacity * pressure * shares[:, None],
        n_train=2,
        row=0,
        time=duration / 3,
        input_at=fed if is_fed else None,
        hold="zero",
    )
