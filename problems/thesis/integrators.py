"""Which integrator belongs inside the PHSI loss? (thesis Section 5.1 and Appendix A)

Euler, midpoint, RK4 and SRK4 make the defect (x1 - x0)/h - Psi of the loss. Measured
here: the order of the defect of the true right-hand side, the symmetry (Table A.1), and
what models found with each are worth, at three noise levels and over five draws (one
for the tanks)::

    system       | trajectories x steps | step | noise            | free runs
    henon_heiles | 200 x 10             | 0.1  | 1e-5, 1e-3, 0.01 | 20, t = 0 to 1
    tanks        |  60 x 50             | 0.01 | 0, 0.01, 0.05    | 10, t = 0 to 0.5

The leak of the tanks is a neural network, as in the thesis, trained by the hybrid with
the same integrator as the dictionary; beside it, with its known form (its size free).

    python -m problems.thesis.integrators [--quick]
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from phsi_opt.learning.hybrid import Hybrid, hybrid
from phsi_opt.learning.hybrid_network import NeuralForce
from phsi_opt.transcription.integrators import INTEGRATORS
from problems.thesis.figures import EXAMPLES, INSIDE, TANK_4, TRUTH, around, simulated
from problems.thesis.scores import free_run, score
from problems.thesis.systems import (
    LEAK_SLOPE,
    SYSTEMS,
    System,
    closed_tanks,
    known_leak,
    tank_model,
)
from problems.tools.command_line import flag
from problems.tools.kept_tables import rewrite
from problems.tools.pages import render
from problems.tools.pictures import plt, save
from problems.tools.provenance import RESULTS, write

# The sum of the levels is a Casimir: c (mu1 + .. + mu4)^2 in H moves nothing, so
# without any L1 the data leave c open.
LEAST = {"H": 1e-3}
PRUNING = ph.Pruning(0.05, significance=0.01)
N_SAMPLES = 501  # of a trajectory that is drawn
HALVINGS = (1, 2, 4, 8)
LENGTHS = {"henon_heiles": 1.0, "tanks": 0.5}  # of the exact records
BEST = "srk4"  # what the others are compared with
ORDER_WITHIN = 0.1  # the slope over the last halving still holds terms of higher order
HYBRID = "Tanks, neural leak"
FIGURES = {"Henon-Heiles": "A.2", HYBRID: "A.4"}  # of trajectories
COLOURS = dict(zip(INTEGRATORS, ("C3", "C1", "C0", "C2"), strict=True))
# Lines that lie on each other stay visible.
WIDTHS = dict(zip(INTEGRATORS, (1.2, 3.0, 2.0, 1.0), strict=True))
# The pipe of the third flow ends at tank 4.
SHOWN = {
    "henon_heiles": {0: "position q1", 2: "momentum p1"},
    "tanks": {TANK_4: "level of tank 4", 2: "flow in the pipe\nbetween tanks 1 and 4"},
}
LABELS = {
    "l2": "mean l2 error of free runs\n(units of the states)",
    "coefficient": "largest relative\ncoefficient error (-)",
}
Tables = dict[str, pd.DataFrame]


@dataclass(frozen=True)
class Case:
    """A system as Appendix A uses it; its truth is that of the model."""

    system: System
    model: ph.PseudoHamiltonian
    noise: tuple[float, ...]
    n_tests: int
    seeds: range
    l1: dict[str, float] = field(default_factory=dict)
    settings: ph.SolverSettings = field(default_factory=ph.SolverSettings)
    force: NeuralForce | None = None
    max_turns: int = 20

    @property
    def title(self) -> str:
        """Name in tables and figures."""
        if self.system.name != "tanks":
            return self.system.title
        return HYBRID if self.force else "Tanks, leak of known form"

    def example(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and true states of the thesis' example, to beyond the training time."""
        # Of the tanks: to twice the training time.
        found = EXAMPLES.get(self.system.name, replace(INSIDE, end=1.0))
        t = np.linspace(0.0, found.end, N_SAMPLES)
        return t, self.system.solve(np.array(found.start), t)

    def fitted(self, data: ph.Measurements, integrator: str) -> Any:
        """The model that an integrator finds."""
        if self.force is not None:
            return hybrid(
                self.model,
                data,
                self.force,
                self.l1,
                PRUNING,
                integrator=integrator,
                max_turns=self.max_turns,
            )
        return ph.identify(
            self.model,
            data,
            ph.PHSILoss(integrator=integrator),
            self.l1,
            PRUNING,
            settings=self.settings,
            raise_on_failure=False,
        )


def cases(quick: bool = False) -> tuple[Case, ...]:
    """Henon-Heiles and the tanks.

    ``quick``: few trajectories of the first, and of the tanks with a small network that
    has too few turns to settle.
    """
    oscillator = Case(
        replace(
            SYSTEMS["henon_heiles"],
            n_steps=10,
            n_trajectories=15 if quick else 200,
            test_time=1.0,
        ),
        SYSTEMS["henon_heiles"].model(),
        noise=(1e-5, 0.01) if quick else (1e-5, 1e-3, 0.01),
        n_tests=3 if quick else 20,
        seeds=range(1 if quick else 5),
    )
    tanks = replace(SYSTEMS["tanks"], n_steps=50, test_time=0.5)
    network = Case(
        tanks,
        tank_model(),
        noise=(0.0, 0.01, 0.05),
        n_tests=10,
        seeds=range(1),  # minutes per fit
        l1=LEAST,
        settings=ph.SolverSettings(max_iterations=100),
        force=NeuralForce(("mu4",), ("mu4",)),
    )
    known = replace(
        network,
        system=replace(tanks, truth={**tanks.truth, "slope": LEAK_SLOPE}),
        model=tank_model(known_leak()),
        force=None,
    )
    if not quick:
        return oscillator, network, known
    small = replace(
        network,
        system=replace(tanks, n_trajectories=4),
        noise=(0.0,),
        n_tests=1,
        force=NeuralForce(("mu4",), ("mu4",), hidden=(10,), epochs=10),
        max_turns=3,
    )
    return oscillator, small


# --- order and symmetry of the defects


def orders(n: int = 10) -> pd.DataFrame:
    """Rms defect of the true right-hand side on exact data at h, h/2, h/4 and h/8.

    The order is the slope over the last halving.
    """
    closed = replace(SYSTEMS["tanks"], title="Tanks, leak shut", rhs=closed_tanks)
    rows = []
    for system in (SYSTEMS["henon_heiles"], SYSTEMS["tanks"], closed):
        shortened = replace(system, n_steps=round(LENGTHS[system.name] / system.step))
        exact = shortened.data(0, noise=0.0, n=n, refine=HALVINGS[-1])
        for name in INTEGRATORS:
            sizes = [
                _rms_defect(system, name, exact, HALVINGS[-1] // k) for k in HALVINGS
            ]
            row = {"system": system.title, "integrator": name, "h": system.step}
            row |= {f"h/{k}": size for k, size in zip(HALVINGS, sizes, strict=True)}
            rows.append(row | {"order": np.log2(sizes[-2] / sizes[-1])})
    return pd.DataFrame(rows)


def _rms_defect(
    system: System, integrator: str, data: ph.Measurements, every: int
) -> float:
    psi = INTEGRATORS[integrator].psi
    squares = []
    for run in data.trajectories:
        t, x = run.t[::every], run.x[::every]
        for i, h in enumerate(np.diff(t)):
            increment = psi(partial(_at, system, t[i], h), x[i], x[i + 1], h)
            squares.append(np.sum(((x[i + 1] - x[i]) / h - increment) ** 2))
    return float(np.sqrt(np.mean(squares)))


def _at(system: System, t: float, h: float, x: np.ndarray, c: float) -> np.ndarray:
    return system.rhs(t + c * h, x)


def symmetry(n: int = 20) -> pd.DataFrame:
    """Largest relative change of Psi when the ends are swapped and h -> -h.

    Over the first steps of ``n`` noisy trajectories of all four systems.
    """
    rows = []
    for name, scheme in INTEGRATORS.items():
        changes = [0.0]
        for system in SYSTEMS.values():
            for run in system.data(0, n=n).trajectories:
                (x0, x1), (t0, t1) = run.x[:2], run.t[:2]
                h = t1 - t0
                there = scheme.psi(partial(_at, system, t0, h), x0, x1, h)
                back = scheme.psi(partial(_at, system, t1, -h), x1, x0, -h)
                size = np.linalg.norm(there)
                changes.append(float(np.linalg.norm(there - back) / size))
        row = {"integrator": name, "symmetric": scheme.symmetric}
        rows.append(row | {"largest change": max(changes)})
    return pd.DataFrame(rows)


# --- models found with each integrator


def fits(
    case: Case, seeds: range, paths: dict[tuple[str, float, str], Any]
) -> pd.DataFrame:
    """A row per noise, seed and integrator with what the model is worth; the
    trajectories of the first seed's models are added to ``paths``.
    """
    t, truth = case.system.tests(case.n_tests)
    rows = []
    for noise in case.noise:
        for seed in seeds:
            data = case.system.data(seed, noise)
            for name in INTEGRATORS:
                fit = case.fitted(data, name)
                found = score(case.system, fit)
                if isinstance(fit, Hybrid):  # neither part moves any more
                    solved = fit.fit.outcome.success and fit.converged
                else:
                    solved = bool(fit.outcome.success)
                if seed == seeds[0]:
                    times, x = case.example()
                    path = simulated(fit, times, tuple(x[0]))
                    paths[case.title, noise, name] = path
                key = {"system": case.title, "noise": noise, "seed": seed}
                worth = {
                    "l2": float(np.mean(free_run(fit, t, truth))),
                    "coefficient": found.relative,
                    **found.counts,
                    "solved": solved,
                    "seconds": fit.seconds,
                }
                rows.append({**key, "integrator": name, **worth})
                print("...", *rows[-1].values(), flush=True)
    return pd.DataFrame(rows)


def medians(found: pd.DataFrame) -> pd.DataFrame:
    """Median over the seeds, and the range of the l2 error."""
    groups = found.groupby(["system", "noise", "integrator"], sort=False)
    table = groups[["l2", "coefficient", "spurious", "missed", "seconds"]].median()
    table.insert(1, "l2 from", groups["l2"].min())
    table.insert(2, "l2 to", groups["l2"].max())
    table["not solved"] = groups["solved"].agg(lambda flags: int((~flags).sum()))
    return table.reset_index()


def main(quick: bool = False) -> Tables:
    """Tables orders, symmetry, fits, medians; written under results/thesis unless
    ``quick``.
    """
    found = {
        "orders": orders(1 if quick else 10),
        "symmetry": symmetry(3 if quick else 20),
    }
    paths: dict[tuple[str, float, str], Any] = {}
    parts = [fits(case, case.seeds, paths) for case in cases(quick)]
    found["fits"] = pd.concat(parts, ignore_index=True)
    found["medians"] = medians(found["fits"])
    text = page(found)
    print(text)
    if not quick:
        figure(found["fits"])
        for case in cases():
            if case.title in FIGURES:
                draw(case, paths)
        rewrite(RESULTS / "thesis/integrators.csv", found["fits"])
        write("thesis/integrators.md", text)
    return found


# --- the page


def page(found: Mapping[str, pd.DataFrame]) -> str:
    """The page; every sentence of the reading is a comparison of numbers in these
    tables.
    """
    order, symmetric = found["orders"], found["symmetry"].set_index("symmetric")
    expected = order["integrator"].map(lambda name: INTEGRATORS[name].order)
    short = order[(order["order"] - expected).abs() > ORDER_WITHIN]
    held = [s for s in order["system"].unique() if s not in set(short["system"])]
    l2 = found["medians"].pivot_table("l2", ["system", "noise"], "integrator")
    ranks = found["medians"][found["medians"]["system"] == HYBRID].sort_values("l2")
    n_draws = found["fits"].groupby("system", sort=False)["seed"].nunique()
    return render(
        "thesis/pages/integrators.md",
        best=BEST,
        found=found,
        held=held,
        short=short,
        swapped=symmetric["largest change"],
        names=symmetric["integrator"],
        beside={
            system: [_beside_best(noise, runs) for noise, runs in part.groupby("noise")]
            for system, part in found["fits"].groupby("system", sort=False)
        },
        euler=l2["euler"] / l2[BEST],
        ranks={n: list(rows["integrator"]) for n, rows in ranks.groupby("noise")},
        draws="; ".join(f"{system}: {count}" for system, count in n_draws.items()),
        least=LEAST["H"],
        figures=FIGURES,
        ends={"Henon-Heiles": 10.0, HYBRID: 1.0},
        file_of=file_of,
    )


def _beside_best(noise: Any, runs: pd.DataFrame) -> dict[str, Any]:
    """Free-run errors over that of `BEST`, and whose draws overlap with its own."""
    by = runs.groupby("integrator", sort=False)["l2"]
    ratios = (by.median() / by.median()[BEST]).drop(BEST)
    lowest, highest = by.min(), by.max()
    is_alike = (lowest <= highest[BEST]) & (highest >= lowest[BEST])
    alike = [name for name in ratios.index if is_alike[name] and by.count()[BEST] > 1]
    return {"noise": noise, "ratios": ratios, "alike": alike}


# --- the figures


def figure(fits: pd.DataFrame) -> None:
    """Errors against noise, one panel per system and error.

    The dot is the median, the bar the range over the draws.
    """
    systems = list(dict.fromkeys(fits["system"]))
    fig, axes = plt.subplots(
        2, len(systems), figsize=(11.5, 6.8), layout="constrained", squeeze=False
    )
    for column, title in zip(axes.T, systems, strict=True):
        part = fits[fits["system"] == title]
        for ax, what in zip(column, LABELS, strict=True):
            _panel(ax, part, what)
        column[0].set_title(title)
        column[1].set_xlabel("standard deviation of the noise\n(units of the states)")
    for ax, label in zip(axes[:, 0], LABELS.values(), strict=True):
        ax.set_ylabel(label)
    handles, names = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, names, loc="outside lower center", ncols=4, frameon=False)
    save(fig, "thesis/integrators.png", dpi=130)


def _panel(ax: Any, part: pd.DataFrame, what: str) -> None:
    levels = sorted(set(part["noise"]))
    places = np.arange(len(levels))
    for k, (name, scheme) in enumerate(INTEGRATORS.items()):
        runs = part[part["integrator"] == name].groupby("noise")[what]
        middle = runs.median().to_numpy()
        bars = np.array([middle - runs.min(), runs.max() - middle])
        symmetric = ", symmetric" if scheme.symmetric else ""
        label = f"{name} (order {scheme.order}{symmetric})"
        style = {"fmt": "o", "ms": 5, "capsize": 3, "color": COLOURS[name]}
        ax.errorbar(places + 0.16 * (k - 1.5), middle, bars, label=label, **style)
    ax.set(yscale="log", xticks=places, xticklabels=[f"{s:g}" for s in levels])
    ax.grid(axis="y", alpha=0.3)


def file_of(title: str) -> str:
    """Name of the figure of a system's trajectories."""
    return f"integrators_{title.split(',')[0].lower().replace('-', '_')}.png"


def draw(case: Case, paths: Mapping[tuple[str, float, str], Any]) -> None:
    """Figures A.2 and A.4: a column per noise, the error below."""
    shown = SHOWN[case.system.name]
    t, truth = case.example()
    fig, axes = plt.subplots(
        len(shown) + 1,
        len(case.noise),
        figsize=(11, 7.6),
        sharex=True,
        sharey="row",
        squeeze=False,
        layout="constrained",
    )
    end = case.system.n_steps * case.system.step
    for column, noise in zip(axes.T, case.noise, strict=True):
        found = {name: paths[case.title, noise, name] for name in INTEGRATORS}
        runs = {name: x for name, x in found.items() if x is not None}
        for ax, state in zip(column, shown, strict=False):
            ax.plot(t, truth[:, state], color=TRUTH, lw=6, label="truth")
            for name, x in runs.items():
                look = {"color": COLOURS[name], "lw": WIDTHS[name]}
                ax.plot(t, x[:, state], label=name, **look)
            ax.set_ylim(*around(truth[:, state], 0.25))
        for name, x in runs.items():
            error = np.linalg.norm(x - truth, axis=1)[1:]
            column[-1].plot(t[1:], error, color=COLOURS[name], lw=1.4)
        column[-1].set_yscale("log")
        for ax in column:
            ax.axvline(end, color="0.5", ls="--", lw=1, label="end of training")
            ax.grid(alpha=0.3)
        column[0].set_title(f"noise {noise:g} (units of the states)", fontsize=10)
        column[-1].set_xlabel("time t")
    for row, label in zip(axes, [*shown.values(), "l2 error, all states"], strict=True):
        row[0].set_ylabel(label)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    save(fig, f"thesis/{file_of(case.title)}", dpi=120)


if __name__ == "__main__":
    main(quick=flag("quick"))
