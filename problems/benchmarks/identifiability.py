"""Verdicts on what can be identified: published ones, random models, seconds.

    python -m problems.benchmarks.identifiability [--quick]

A verdict "not identifiable" on a random model is checked by fits of SciPy to records
without noise, each of which holds one parameter at another value: if the model explains
the record all the same, no record tells the parameter. The fits know nothing of the
verdict.
"""

import time
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.optimize import least_squares

import phsi_opt as ph
from phsi_opt.estimation.identifiability import structural
from problems.benchmarks.published_models import PUBLISHED
from problems.tools.command_line import flag
from problems.tools.pages import publish, render

FIRST_SEED = 70_000
MODELS = 200
SAMPLES = 60
SPACING = 0.15  # s
# A parameter over its truth, one after the other, up or, where that leads out of what
# others can make good, down.
HELD = ((1.05, 1.1), (0.95, 0.9))
# Of a record's standard deviation: below it a model explains the record, and above it
# does not.
EXPLAINED = 1e-7

Row = dict[str, object]


@dataclass(frozen=True, eq=False)
class Case:
    """A random model with its sensors.

    Args:
        model: all of its parameters are unknown.
        measured: the states that have sensors.
    """

    model: ph.Model
    measured: tuple[str, ...]


def draw(seed: int) -> Case:
    """A chain of masses, tanks or a heated house, some states of which are measured."""
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 4))
    kind = (masses, tanks, rooms)[random.integers(3)]
    model = kind(n, random)
    candidates = [name for name in model.states if not name.startswith("p")]
    n_sensors = int(random.integers(1, len(candidates) + 1))
    measured = random.choice(candidates, n_sensors, replace=False).tolist()
    return Case(model, tuple(measured))


def masses(n: int, random: np.random.Generator) -> ph.Model:
    """Springs, some of them hard, dampers and drag, with an input or without."""
    energies, losses = [], {}
    for i in range(n):
        stretch = f"(q{i} - q{i - 1})" if i else "q0"
        energies += [f"p{i}**2/(2*m{i})", f"k{i}*{stretch}**2/2"]
        if random.random() < 0.3:
            energies.append(f"h{i}*{stretch}**4/4")
        if random.random() < 0.7:
            losses[f"p{i}"] = f"c{i}"
        if random.random() < 0.3:
            losses[f"p{i}"] = f"c{i} + d{i}*abs(dH_dp{i})"
    force = random.choice(["", "u", "g*u"])
    return ph.PseudoHamiltonian(
        states=[f"q{i}" for i in range(n)] + [f"p{i}" for i in range(n)],
        S=ph.canonical(n),
        H=" + ".join(energies),
        R=losses,
        F={"p0": force} if force else {},
        inputs=["u"] if force else [],
    )


def tanks(n: int, random: np.random.Generator) -> ph.Model:
    """Each flows into the next by the square root of its level."""
    rates = {"h0": random.choice(["u", "b*u"])}
    for i in range(n):
        outflow = random.choice([f"a{i}*sqrt(h{i})", f"a{i}*sqrt(h{i})/A{i}"])
        rates[f"h{i}"] += f" - {outflow}"
        if i + 1 < n:
            rates[f"h{i + 1}"] = f"a{i}*sqrt(h{i})" + random.choice(["", f"/A{i + 1}"])
    return ph.FirstOrder(list(rates), rates, inputs=["u"])


def rooms(n: int, random: np.random.Generator) -> ph.Model:
    """Capacities in a row that lose heat to an outside temperature."""
    rates = {}
    for i in range(n):
        heat = ["u"] if i == 0 else [f"g{i}*(T{i - 1} - T{i})"]
        if i + 1 < n:
            heat.append(f"g{i + 1}*(T{i + 1} - T{i})")
        if random.random() < 0.5 or n == 1:
            heat.append(f"l{i}*(Tout - T{i})")
        rates[f"T{i}"] = f"({' + '.join(heat)})/C{i}"
    known = random.random() < 0.7
    inputs = ["u", "Tout"] if known else ["u"]
    used = [name for name in inputs if any(name in rate for rate in rates.values())]
    return ph.FirstOrder(list(rates), rates, inputs=used)


class Record:
    """What the sensors of a case show, and fits to it.

    Args:
        case: the model.
        random: draws the truth.
    """

    def __init__(self, case: Case, random: np.random.Generator) -> None:
        model = case.model
        n = model.n_states
        x = ca.SX.sym("x", n)
        theta = ca.SX.sym("theta", len(model.free))
        t = ca.SX.sym("t")
        waves = [
            1.1 + ca.sin((i + 1.3) * t) / 2 + ca.cos(2.6 * t) / 3 for i in range(2)
        ]
        u = ca.vertcat(*waves[: model.n_inputs])
        rate = ca.Function("f", [x, t, theta], [model.rhs()(x, u, t, theta)])
        h = SPACING / 4
        there, at = x, t
        for _ in range(4):
            k1 = rate(there, at, theta)
            k2 = rate(there + h / 2 * k1, at + h / 2, theta)
            k3 = rate(there + h / 2 * k2, at + h / 2, theta)
            k4 = rate(there + h * k3, at + h, theta)
            there, at = there + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), at + h
        step = ca.Function("step", [x, t, theta], [there]).mapaccum(SAMPLES)
        z = ca.MX.sym("z", n + len(model.free))
        times = ca.DM(SPACING * np.arange(SAMPLES)).T
        states = step(z[:n], times, ca.repmat(z[n:], 1, SAMPLES))
        places = list(map(model.index, case.measured))
        y = ca.vec(states[places, :])
        self._shown = ca.Function("y", [z], [y])
        self._slopes = ca.Function("J", [z], [ca.jacobian(y, z)])
        self.truth = random.uniform(0.7, 1.6, n + len(model.free))
        self.y = np.array(self._shown(self.truth)).ravel()
        self._size = float(np.std(self.y))
        self._first = n

    def left(self, parameter: int) -> float:
        """The error of the best fit that holds a parameter at another value."""
        errors = []
        for factors in HELD:
            errors.append(self._left(self._first + parameter, factors))
            if errors[-1] < EXPLAINED:
                break
        return min(errors)

    def _left(self, place: int, factors: tuple[float, ...]) -> float:
        moving = np.delete(np.arange(len(self.truth)), place)
        z = self.truth.copy()

        def residual(moved: np.ndarray) -> np.ndarray:
            z[moving] = moved
            shown = np.array(self._shown(z)).ravel() - self.y
            return np.clip(np.nan_to_num(shown / self._size, nan=1e3), -1e3, 1e3)

        def slopes(moved: np.ndarray) -> np.ndarray:
            z[moving] = moved
            return np.nan_to_num(np.array(self._slopes(z))[:, moving] / self._size)

        error = np.inf
        tolerances = dict.fromkeys(["ftol", "xtol", "gtol"], 1e-15)
        for factor in factors:
            z[place] = factor * self.truth[place]
            for _ in range(4):  # again from where it ended, as its region had shrunk
                done = least_squares(
                    residual,
                    z[moving].copy(),
                    slopes,
                    method="lm",
                    max_nfev=100,
                    **tolerances,
                )
                z[moving] = done.x
                error = float(np.sqrt(2 * done.cost / len(self.y)))
                if error < EXPLAINED or error > 1e-3:
                    break
        return error


def judged(seed: int) -> Row:
    """The verdict on a random model, and what fits say of it."""
    case = draw(seed)
    began = time.process_time()
    verdict = structural(case.model, case.measured)
    seconds = time.process_time() - began
    record = Record(case, np.random.default_rng(seed))
    wrong: list[str] = []
    unseen: list[str] = []
    for place, name in enumerate(case.model.free):
        is_explained = record.left(place) < EXPLAINED
        if name in verdict.unidentifiable and not is_explained:
            wrong.append(name)
        if name not in verdict.unidentifiable and is_explained:
            unseen.append(name)
    return {
        "seed": seed,
        "states": case.model.n_states,
        "parameters": len(case.model.free),
        "not identifiable": len(verdict.unidentifiable),
        "wrong": wrong,
        "unseen": unseen,
        "seconds": seconds,
    }


def published() -> list[Row]:
    """A row per published verdict."""
    rows: list[Row] = []
    for one in PUBLISHED:
        model = one.model()
        began = time.process_time()
        found = structural(model, tuple(one.sensors), one.runs)
        seconds = time.process_time() - began
        combinations = {c for group in found.groups for c in group.combinations}
        agrees = set(found.unidentifiable) == one.unidentifiable
        rows.append(
            {
                "model": one.name,
                "states": model.n_states,
                "parameters": len(model.free),
                "not identifiable": ", ".join(found.unidentifiable) or "-",
                "identifiable of them": "; ".join(sorted(combinations)) or "-",
                "as published": agrees and one.combinations <= combinations,
                "seconds": round(seconds, 3),
            }
        )
    return rows


def chains() -> list[Row]:
    """Seconds for chains of masses with ten states and more, by what is measured."""
    rows: list[Row] = []
    for n in (5, 8):
        energy = ["k0*q0**2/2", *(f"k{i}*(q{i} - q{i - 1})**2/2" for i in range(1, n))]
        energy += [f"p{i}**2/(2*m{i})" for i in range(n)]
        for force in ({}, {"p0": "u"}):
            model = ph.PseudoHamiltonian(
                states=[f"q{i}" for i in range(n)] + [f"p{i}" for i in range(n)],
                S=ph.canonical(n),
                H=" + ".join(energy),
                R={f"p{i}": f"c{i}" for i in range(n)},
                F=force,
                inputs=list("u" if force else ""),
            )
            for measured in (("q0",), tuple(f"q{i}" for i in range(n))):
                began = time.process_time()
                found = structural(model, measured)
                rows.append(
                    {
                        "states": 2 * n,
                        "parameters": len(model.free),
                        "measured": "one position" if len(measured) == 1 else "all",
                        "force": "measured" if force else "none",
                        "not identifiable": len(found.unidentifiable),
                        "seconds": round(time.process_time() - began, 2),
                    }
                )
    return rows


def main(quick: bool) -> None:
    """All models; the page is written unless ``quick``."""
    seeds = range(FIRST_SEED, FIRST_SEED + (3 if quick else MODELS))
    rows = list(map(judged, seeds))
    text = render(
        "benchmarks/pages/identifiability.md",
        published=published(),
        chains=chains(),
        first=FIRST_SEED,
        n_models=len(rows),
        n_parameters=sum(int(str(row["parameters"])) for row in rows),
        n_open=sum(int(str(row["not identifiable"])) for row in rows),
        n_models_open=sum(row["not identifiable"] != 0 for row in rows),
        wrong=[row for row in rows if row["wrong"]],
        unseen=[row for row in rows if row["unseen"]],
        seconds=max(float(str(row["seconds"])) for row in rows),
        explained=EXPLAINED,
    )
    publish("identifiability.md", text, not quick)


if __name__ == "__main__":
    main(flag("quick"))
