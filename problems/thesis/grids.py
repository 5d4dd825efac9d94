"""Section 6.5: how much L1 and pruning? Free-run error over grids of both, on clean
data.

Gradient descent: lambda_H x pruning interval P, with the few epochs of the thesis and
its lambda_F (0.01 on the mass-spring's force). Solver: lambda_H x threshold; the leak
of the tanks has its known form there, so that only H and R are at stake. The error is
the l2 norm over all states, averaged over the test time and the unseen starts.

Three points of each grid, from the least sparsity to the most, are drawn as
trajectories, and trained once more as the thesis may be read: its text and its code
differ in what is summed, when pruning begins and where the data of the Schroedinger
system start, and with these in how heavy a given lambda is.

    python -m problems.thesis.grids [--quick] [system ...]
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.thesis.figures import EXAMPLES, INSIDE, TANK_4, TRUTH, around, simulated
from problems.thesis.methods import descent
from problems.thesis.scores import attempted, free_run, score
from problems.thesis.systems import FLOWS, SYSTEMS, System, known_leak, tank_model
from problems.tools import markdown
from problems.tools.command_line import chosen, flag
from problems.tools.kept_tables import rewrite
from problems.tools.pages import render
from problems.tools.pictures import plt, save
from problems.tools.provenance import RESULTS, write

N_TESTS = 30
N_SAMPLES = 501  # of a trajectory that is drawn
# Without any L1 the tanks' Casimir leaves a direction free, where iterations end late.
SETTINGS = ph.SolverSettings(max_iterations=200)
QUICK_N = {"henon_heiles": 400}  # trajectories of a quick run; others: 6
QUICK_READINGS = 20  # trajectories of the readings of a quick run
THRESHOLDS = (0.0, 0.05, 0.2)
COLOURS = {"descent": "#d55e00", "solver": "#0072b2"}  # as in the other figures
OF_LEVELS = "error of levels"
SPARSITY = ("least", "middle", "most")
BATCH = 32  # samples in a batch of the descent
ALIKE = 1.5  # errors within this factor count as neither better nor worse
# Share of the error of all states; where the levels have less, the rest circulates.
MOSTLY_FLOWS = 0.2


@dataclass(frozen=True)
class Grid:
    """What the thesis varies for one system, for how many epochs it trains, and the
    weight of L1 on the coefficients of the force; its figure of trajectories, and what
    it says.
    """

    weights: tuple[float, ...]
    intervals: tuple[int, ...]
    epochs: int
    figure: str
    thesis: str
    force_weight: float = 0.0


GRIDS = {
    "henon_heiles": Grid(
        (0.0, 0.05, 0.5), (1, 2, 4), 3, "6.10", "neither improves nor worsens"
    ),
    "schrodinger": Grid(
        (0.0, 0.05, 0.5), (1, 5, 10), 10, "6.12", "helps (error about 5 times smaller)"
    ),
    "mass_spring": Grid(
        (0.0, 0.1, 0.5), (20, 40, 80), 80, "6.14", "helps, L1 most", force_weight=0.01
    ),
    "tanks": Grid(
        (0.0, 0.05, 0.5),
        (10, 40, 80),
        80,
        "6.16",
        "helps (error about 60 times smaller)",
    ),
}


@dataclass(frozen=True)
class Point:
    """A point of a grid: ``size`` is the pruning interval or the threshold."""

    method: str
    weight: float
    size: float

    @property
    def pruning(self) -> str:
        """The label of the column."""
        if self.method == "descent":
            return f"P = {self.size:g}"
        return f"threshold {self.size:g}"


def points(grid: Grid) -> Iterator[Point]:
    """All points of a grid, gradient descent first."""
    for method, sizes in (("descent", grid.intervals), ("solver", THRESHOLDS)):
        for weight in grid.weights:
            yield from (Point(method, weight, size) for size in sizes)


def diagonal(grid: Grid, method: str) -> list[Point]:
    """From the least sparsity (no L1, latest pruning or none) to the most."""
    sizes = THRESHOLDS if method == "solver" else grid.intervals[::-1]
    return [Point(method, *pair) for pair in zip(grid.weights, sizes, strict=False)]


# --- how the thesis may be read


@dataclass(frozen=True)
class Reading:
    """One way to read Section 6.5.

    Attributes:
        words: what differs.
        first_pruned: interval at whose end pruning begins: the first in Algorithm 6.
        is_sum: whether the loss is a sum over batch and states, as Eq. 5.6 has it; the
            code has the mean over both.
        is_wide: whether the Schroedinger system is that of the text: fewer runs, starts
            within +-1.
    """

    words: str
    first_pruned: int = 1
    is_sum: bool = False
    is_wide: bool = False

    def share_of_weight(self, system: System) -> float:
        """Factor of lambda, which the code adds to the mean over the states."""
        return 1 / (BATCH * system.descent.n_states) if self.is_sum else 1.0

    def system(self, system: System) -> System:
        """The system that is meant."""
        if not self.is_wide:
            return system
        return replace(
            system,
            start=lambda rng: rng.uniform(-1, 1, 4),
            n_trajectories=30,
            descent=replace(system.descent, threshold=0.05),
        )


READINGS = (
    Reading("as in the grids"),
    Reading("first pruned at 2P (code)", first_pruned=2),
    Reading("sum of squares (Eq. 5.6)", is_sum=True),
)
AS_HERE = READINGS[0]
# Those of the text, for the Schroedinger system alone.
WIDE = Reading("starts within +-1 (text)", is_wide=True)
WIDE_SUM = Reading("starts within +-1, sum of squares", is_sum=True, is_wide=True)
# Readings that belong together: of the Schroedinger system either data.
FAMILIES = {
    "the mean of the code": (AS_HERE.words, WIDE.words),
    "the sum of Eq. 5.6": (READINGS[2].words, WIDE_SUM.words),
}


def by_descent(
    system: System,
    data: ph.Measurements,
    point: Point,
    grid: Grid,
    reading: Reading = AS_HERE,
) -> Any:
    """Gradient descent at a point.

    Raises:
        ModelError: every term was pruned.
    """
    share = reading.share_of_weight(system)
    interval = int(point.size)
    l1 = {**system.descent.l1, "H": point.weight * share}
    if grid.force_weight:
        l1["F"] = grid.force_weight * share
    settings = replace(
        system.descent,
        epochs=grid.epochs,
        prune_every=interval,
        prune_from=reading.first_pruned * interval,
        l1=l1,
    )
    return descent(replace(system, descent=settings), data, "clean")


def by_solver(system: System, data: ph.Measurements, point: Point) -> Any:
    """The solver with one weight and one threshold, without significance."""
    model = tank_model(known_leak()) if system.name == "tanks" else system.model()
    return ph.identify(
        model,
        data,
        ph.PHSILoss(),
        {**system.l1, "H": point.weight},
        ph.Pruning(point.size),
        settings=SETTINGS,
        raise_on_failure=False,
    )


def error_row(
    system: System, fit: Any, t: np.ndarray, tests: np.ndarray
) -> dict[str, Any]:
    """Error of free runs (of the tanks, of their levels alone too), terms too many and
    too few, seconds; of no model where ``fit`` is an error.
    """
    is_model = not isinstance(fit, ph.PhsiOptError)
    row = {"error": np.inf, "spurious": 0, "missed": len(system.truth)}
    row["seconds"] = np.nan
    if is_model:
        row["error"] = float(free_run(fit, t, tests).mean())
        row |= {**score(system, fit).counts, "seconds": fit.seconds}
    if system.name == "tanks":
        row[OF_LEVELS] = level_error(fit, t, tests) if is_model else np.inf
    return row


def level_error(fit: Any, t: np.ndarray, tests: np.ndarray) -> float:
    """Mean l2 error of the tanks' levels in free runs over the times and starts."""
    errors = []
    for x in tests:
        found = attempted(partial(fit.simulate, t, x[0]))
        if isinstance(found, ph.PhsiOptError):
            return np.inf
        errors.append(np.linalg.norm((found - x)[:, len(FLOWS) :], axis=1))
    return float(np.mean(errors))


def price(
    system: System, data: ph.Measurements, weight: float, reading: Reading
) -> float:
    """L1 penalty of the true H, over the loss of a model without any term.

    Above 1 the penalty alone is dearer than to explain nothing.
    """
    weight *= system.descent.n_states * reading.share_of_weight(system)
    coefficients = [abs(v) for name, v in system.truth.items() if name[0] == "H"]
    return weight * sum(coefficients) / mean_square_rate(data)


def mean_square_rate(data: ph.Measurements) -> float:
    """Mean over all steps of the squared norm of (x1 - x0)/h."""
    rates = [
        np.diff(run.x, axis=0) / np.diff(run.t)[:, None] for run in data.trajectories
    ]
    return float(np.mean(np.sum(np.concatenate(rates) ** 2, axis=1)))


# --- the runs


def study(
    system: System, grid: Grid, quick: bool
) -> tuple[pd.DataFrame, dict[Point, Any]]:
    """A row per point of the grids of one system, and by point of the diagonals the
    trajectory from the example's start, or why there is none.
    """
    if quick:
        data = system.data(1, 0.0, n=QUICK_N.get(system.name, 6))
    else:
        data = system.training_data("clean")
    t, tests = system.tests(3 if quick else N_TESTS)
    drawn = {*diagonal(grid, "descent"), *diagonal(grid, "solver")}
    rows, paths = [], {}
    for point in points(grid):
        if point.method == "descent":
            fit = attempted(partial(by_descent, system, data, point, grid))
        else:
            fit = attempted(partial(by_solver, system, data, point))
        rows.append(
            {
                "system": system.name,
                "method": point.method,
                "lambda_H": point.weight,
                "pruning": point.pruning,
                **error_row(system, fit, t, tests),
            }
        )
        print("... " + ", ".join(str(value) for value in rows[-1].values()), flush=True)
        if point in drawn:
            paths[point] = _path(system, fit)
    return pd.DataFrame(rows), paths


def study_readings(system: System, grid: Grid, quick: bool) -> pd.DataFrame:
    """A row per reading and point of the diagonal."""
    wide = (WIDE, WIDE_SUM) if system.name == "schrodinger" else ()
    rows = []
    for reading in (*READINGS, *wide):
        read = reading.system(system)
        if quick or reading.is_wide:
            data = read.data(1, 0.0, n=QUICK_READINGS if quick else None)
        else:
            data = read.training_data("clean")
        t, tests = read.tests(3 if quick else N_TESTS)
        for sparsity, point in zip(SPARSITY, diagonal(grid, "descent"), strict=False):
            fit = attempted(partial(by_descent, read, data, point, grid, reading))
            rows.append(
                {
                    "system": system.name,
                    "reading": reading.words,
                    "sparsity": sparsity,
                    "lambda_H": point.weight,
                    "pruning": point.pruning,
                    "price": price(read, data, point.weight, reading),
                    **error_row(read, fit, t, tests),
                }
            )
            print("... " + ", ".join(map(str, rows[-1].values())), flush=True)
    return pd.DataFrame(rows)


def _example(system: System) -> tuple[Any, np.ndarray]:
    """The start of the thesis' figure (tanks: to twice the training time), times."""
    example = EXAMPLES.get(system.name, replace(INSIDE, end=1.0))
    return example, np.linspace(0.0, example.end, N_SAMPLES)


def _path(system: System, fit: Any) -> Any:
    """The trajectory of the example, (n_samples, n_states), or why there is none."""
    if isinstance(fit, ph.PhsiOptError):
        return "every term was pruned"
    example, t = _example(system)
    x = simulated(fit, t, example.start)
    return "diverges" if x is None else x


# --- the page


def page(table: pd.DataFrame, readings: pd.DataFrame) -> str:
    """The grids and the verdicts as text."""
    by_reading = verdicts(readings)
    agreeing = {}
    for family, words in FAMILIES.items():
        own = by_reading[by_reading["reading"].isin(words)]
        is_alike = [
            here.startswith(thesis.split()[0].removesuffix(","))
            for here, thesis in zip(own["here"], own["thesis"], strict=True)
        ]
        agreeing[family] = own[is_alike]["system"].unique().tolist()
    here = by_reading[by_reading["reading"] == AS_HERE.words]
    sections = []
    for name, rows in table.groupby("system", sort=False):
        ends = []
        for method in COLOURS:
            part = rows[rows["method"] == method].sort_values("error")
            ends.append((method, part.iloc[0], part.iloc[-1]))
        shown = rows.drop(columns="system").dropna(axis="columns", how="all")
        sections.append((SYSTEMS[str(name)], GRIDS[str(name)], shown, ends))
    return render(
        "thesis/pages/grids.md",
        n_tests=N_TESTS,
        force_weight=GRIDS["mass_spring"].force_weight,
        alike=ALIKE,
        verdicts=by_reading,
        helped=here[here["here"].str.startswith("helps")]["system"].tolist(),
        n_systems=len(here),
        agreeing=agreeing,
        most=readings[readings["sparsity"] == SPARSITY[-1]],
        titles={name: system.title for name, system in SYSTEMS.items()},
        apart=apart(table),
        readings=readings.drop(columns=["seconds", OF_LEVELS]),
        sections=sections,
        least=_at(
            table[table["system"] == "tanks"], diagonal(GRIDS["tanks"], "descent")[0]
        ),
        of_levels=OF_LEVELS,
        mostly_flows=MOSTLY_FLOWS,
    )


def _at(rows: pd.DataFrame, point: Point) -> pd.Series:
    is_here = (rows["lambda_H"] == point.weight) & (rows["pruning"] == point.pruning)
    return rows[is_here].iloc[0]


def apart(table: pd.DataFrame) -> pd.DataFrame:
    """A row per system: errors of the descent with L1 and pruning alone."""
    rows = []
    for name, part in table[table["method"] == "descent"].groupby("system", sort=False):
        grid = GRIDS[str(name)]
        late, early, largest = (
            max(grid.intervals),
            min(grid.intervals),
            max(grid.weights),
        )
        corners = {
            "neither": (0.0, late),
            f"L1 alone (lambda_H {largest:g})": (largest, late),
            "pruning alone": (0.0, early),
            "both": (largest, early),
        }
        row: dict[str, object] = {"system": SYSTEMS[str(name)].title}
        for words, (weight, interval) in corners.items():
            row[words] = _shown(_at(part, Point("descent", weight, interval)))
        rows.append(row)
    return pd.DataFrame(rows)


def verdicts(readings: pd.DataFrame) -> pd.DataFrame:
    """A row per system and reading: errors by sparsity, and whether it helps."""
    rows = []
    for (name, reading), part in readings.groupby(["system", "reading"], sort=False):
        by: Any = part.set_index("sparsity")
        row = {"system": SYSTEMS[str(name)].title, "reading": reading}
        for sparsity in SPARSITY:
            row[f"error, {sparsity}"] = _shown(by.loc[sparsity])
        row |= {"here": verdict(by["error"]), "thesis": GRIDS[str(name)].thesis}
        rows.append(row)
    return pd.DataFrame(rows)


def _shown(row: pd.Series) -> str:
    if np.isfinite(row["error"]):
        return f"{row['error']:.2g}"
    is_empty = row["missed"] == len(SYSTEMS[row["system"]].truth)
    return "all pruned" if is_empty else "diverges"


def verdict(errors: pd.Series) -> str:
    """Whether sparsity helps, from the errors by sparsity."""
    least = errors["least"]
    best = min(errors["middle"], errors["most"])
    if not np.isfinite(best):
        return "no model" if not np.isfinite(least) else "hurts"
    if not np.isfinite(least):
        return "helps (alone gives a model)"
    if best < least / ALIKE:
        return f"helps ({markdown.number(least / best)} times)"
    if best > least * ALIKE:
        return f"hurts ({markdown.number(best / least)} times)"
    return "neither"


# --- figures


def draw(table: pd.DataFrame) -> None:
    """A row of two panels per system, a cell per point with its error."""
    figure, axes = plt.subplots(len(GRIDS), 2, figsize=(8.5, 11), layout="constrained")
    systems = table.groupby("system", sort=False)
    for pair, (name, rows) in zip(axes, systems, strict=True):
        finite = np.log10(rows["error"][np.isfinite(rows["error"])])
        for ax, method in zip(pair, COLOURS, strict=True):
            _panel(ax, rows[rows["method"] == method], finite.min(), finite.max())
            epochs = (
                f", {GRIDS[str(name)].epochs} epochs" if method == "descent" else ""
            )
            title = f"{SYSTEMS[str(name)].title}: {method}{epochs}"
            ax.set_title(title, fontsize=10)
    save(figure, "thesis/grids.png", dpi=120)


def _panel(ax: plt.Axes, part: pd.DataFrame, low: float, high: float) -> None:
    """One grid; log10 of the smallest and largest error of the system."""
    cells = part.pivot(index="lambda_H", columns="pruning", values="error")
    cells = cells[list(dict.fromkeys(part["pruning"]))]
    values = np.log10(np.where(np.isfinite(cells), cells, 10**high))
    ax.imshow(values, cmap="viridis_r", vmin=low - 0.1, vmax=high + 0.1, aspect="auto")
    for (i, j), value in np.ndenumerate(cells.to_numpy()):
        is_dark = not np.isfinite(value) or np.log10(value) > (low + high) / 2
        text = f"{value:.1e}" if np.isfinite(value) else "no model"
        colour = "white" if is_dark else "black"
        ax.text(j, i, text, ha="center", va="center", color=colour)
    ax.set_xticks(range(cells.shape[1]), cells.columns)
    ax.set_yticks(range(cells.shape[0]), [f"{w:g}" for w in cells.index])
    ax.set_ylabel("lambda_H")


def draw_paths(system: System, grid: Grid, paths: Mapping[Point, Any]) -> None:
    """Figures 6.10, 6.12, 6.14, 6.16: trajectories at three points of each grid."""
    example, t = _example(system)
    is_tanks = system.name == "tanks"
    i, j = example.shown

    def curve(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (t, x[:, TANK_4]) if is_tanks else (x[:, i], x[:, j])

    names = ("time t", "level of tank 4")
    names = names if is_tanks else (system.states[i], system.states[j])
    horizontal, vertical = curve(system.solve(np.array(example.start), t))
    figure, axes = plt.subplots(
        2, 3, figsize=(9.5, 6.2), sharex=True, sharey=True, layout="constrained"
    )
    for row, (method, colour) in zip(axes, COLOURS.items(), strict=True):
        for ax, point in zip(row, diagonal(grid, method), strict=True):
            ax.plot(horizontal, vertical, color=TRUTH, lw=4, label="truth")
            if is_tanks:
                end = system.n_steps * system.step
                label = "end of the training time"
                ax.axvline(end, color="0.5", ls="--", lw=1, label=label)
            x = paths[point]
            if isinstance(x, str):
                ax.text(0.5, 0.92, x, transform=ax.transAxes, ha="center")
            else:
                ax.plot(*curve(x), color=colour, lw=1.2)
            ax.plot(horizontal[0], vertical[0], "k.", ms=7, label="start")
            title = f"lambda_H {point.weight:g}, {point.pruning}"
            ax.set_title(title, fontsize=10, color=colour)
        row[0].set_ylabel(f"{method}\n{names[1]}")
    for ax in axes[-1]:
        ax.set_xlabel(names[0])
    axes[0, 0].set(xlim=around(horizontal, 0.2), ylim=around(vertical, 0.3))
    handles, labels = axes[-1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    save(figure, f"thesis/grid_{system.name}.png", dpi=120)


def main(quick: bool = False, names: list[str] | None = None) -> pd.DataFrame:
    """A row per system, method and point of the grid; the page is written where all
    systems were run, unless ``quick``.
    """
    parts, readings = [], []
    for name in names or SYSTEMS:
        system, grid = SYSTEMS[name], GRIDS[name]
        if quick:
            grid = replace(grid, weights=grid.weights[:2], intervals=(1,), epochs=1)
        found, paths = study(system, grid, quick)
        parts.append(found)
        readings.append(study_readings(system, grid, quick))
        if not quick:
            draw_paths(system, grid, paths)
    table = pd.concat(parts, ignore_index=True)
    if not quick and names is None:
        of_readings = pd.concat(readings, ignore_index=True)
        draw(table)
        rewrite(RESULTS / "thesis/grids.csv", table)
        rewrite(RESULTS / "thesis/grid_readings.csv", of_readings)
        write("thesis/grids.md", page(table, of_readings))
    return table


if __name__ == "__main__":
    main(flag("quick"), chosen() or None)
