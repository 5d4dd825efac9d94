"""The thesis' own numbers beside those of the result pages, as a table in
docs/thesis.md, written anew from the committed results.

    python -m problems.thesis.side_by_side [--quick]
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from phsi_opt.writing import write_whole
from problems.thesis import grids
from problems.thesis.published import BSI_MASS_SPRING, COEFFICIENTS, PRECISION
from problems.thesis.systems import SYSTEMS
from problems.tools import markdown
from problems.tools.command_line import flag
from problems.tools.provenance import RESULTS, ROOT

DOCUMENT = ROOT / "docs" / "thesis.md"
BEGIN = "<!-- numbers: python -m problems.thesis.side_by_side -->"
END = "<!-- end of the numbers -->"
# Columns of the table of all methods, counted from its last one, because the names of
# methods have spaces.
L2_WHOLE, RELATIVE, LARGEST = -4, -8, -9
PHSI = "PHSI, solver; PHSI, descent"
REGRESSED = f"{PHSI}; BSI, solver; SINDy, STLSQ"

# Place in the thesis, what, its number or words, ours, and the page.
Row = tuple[str, str, str, str, str]


def found(page: str, pattern: str) -> tuple[str, ...]:
    """What a pattern finds in a page under results/thesis.

    Raises:
        LookupError: the page has nothing of the kind.
    """
    text = (RESULTS / "thesis" / f"{page}.md").read_text("utf-8")
    match = re.search(pattern, text, re.MULTILINE)
    if match is None:
        raise LookupError(f"results/thesis/{page}.md has no line like {pattern!r}")
    return match.groups()


def methods(page: str, kind: str, column: int, labels: str) -> str:
    """Cells of the table of all methods, on clean or noisy data."""
    cells = []
    for label in labels.split("; "):
        (rest,) = found(page, rf"^ *{kind} +{re.escape(label)}  *((?:[-\d]|inf).*)$")
        cells.append(f"{label} {rest.split()[column].replace('inf', 'diverges')}")
    return "; ".join(cells)


def worst(published: Mapping[str, float], truth: Mapping[str, float]) -> float:
    """Largest relative error of what the thesis prints of the true coefficients."""
    return max(
        abs(published[name] - true) / abs(true)
        for name, true in truth.items()
        if name in published
    )


def rows() -> Iterator[Row]:
    """All rows, in the order of the thesis."""
    truths = {name: system.truth for name, system in SYSTEMS.items()}
    (shares,) = found("regularization", r"Share of F, solver: (.*?)\. Share of F")
    yield (
        "Figure 5.1",
        "who explains a free mass-spring, by L1 on H, F",
        "F where H has L1; H where F has; either with none",
        f"share of F: {shares}",
        "regularization",
    )
    page = "henon_heiles"
    largest = {
        method: max(abs(v - truths[page].get(name, 0.0)) for name, v in values.items())
        for method, values in COEFFICIENTS[page].items()
    }
    yield (
        "Table 6.1",
        "largest coefficient error, noisy",
        ", ".join(f"{method} {error:.3g}" for method, error in largest.items()),
        methods(page, "noisy", LARGEST, f"{PHSI}; SSINN"),
        page,
    )
    compared = f"{PHSI}; BSI, solver; SSINN; SINDy, STLSQ"
    yield (
        "Figures 6.1, 6.2",
        "free runs, noisy",
        "PHSI an order of magnitude before SSINN; both it and BSI before SSINN, SINDy",
        "l2 " + methods(page, "noisy", L2_WHOLE, compared),
        page,
    )
    page = "schrodinger"
    yield (
        "Section 6.2",
        "largest coefficient error, clean",
        "PHSI and SINDy 1e-5, BSI 1e-3",
        methods(page, "clean", LARGEST, f"{REGRESSED}; BSI, descent"),
        page,
    )
    yield (
        "Figures 6.3, 6.4",
        "largest coefficient error, noisy",
        "; ".join(f"{method} {value}" for method, value in PRECISION.items()),
        methods(page, "noisy", LARGEST, REGRESSED),
        page,
    )
    page = "mass_spring"
    phsi = worst(COEFFICIENTS[page]["PHSI"], truths[page])
    bsi = worst(BSI_MASS_SPRING, SYSTEMS[page].truth_first_order)
    yield (
        "Table 6.2",
        "worst relative error of a true coefficient, clean",
        f"PHSI {phsi:.2g}; BSI {bsi:.2g}",
        methods(page, "clean", RELATIVE, f"{PHSI}; BSI, solver"),
        page,
    )
    yield (
        "Figures 6.5, 6.6",
        "free runs to twice the training time, noisy",
        "PHSI good to the end; BSI, PHNN good inside only; SINDy poor",
        "l2 " + methods(page, "noisy", L2_WHOLE, f"{REGRESSED}; PHNN"),
        page,
    )
    page = "tanks"
    errors = {
        slot: worst(
            COEFFICIENTS[page]["PHSI"],
            {name: v for name, v in truths[page].items() if name[0] == slot},
        )
        for slot in "HR"
    }
    here = found(page, r"^ *0\.03 +PHSI, solver +(\S+ %) +(\S+ %)")
    yield (
        "Table 6.3",
        "worst relative error, noise 0.03",
        f"H {errors['H']:.1%}, r {errors['R']:.0%}",
        f"PHSI, solver: H {here[0]}, r {here[1]}",
        page,
    )
    yield (
        "Figures 6.7, 6.8",
        "free runs, noise 0.005",
        "PHSI before BSI before SINDy; outside the training range PHSI alone",
        "l2 " + methods(page, "noisy", L2_WHOLE, REGRESSED),
        page,
    )
    yield from _grids()
    yield from _integrators()


def _grids() -> Iterator[Row]:
    table = grids.verdicts(pd.read_csv(RESULTS / "thesis" / "grid_readings.csv"))
    errors = [f"error, {sparsity}" for sparsity in grids.SPARSITY]
    for grid, (title, own) in zip(
        grids.GRIDS.values(), table.groupby("system", sort=False), strict=True
    ):
        chapter, number = grid.figure.split(".")
        said = [
            f"{row['reading']}: {row['here']} ({', '.join(row[errors])})"
            for _, row in own.iterrows()
        ]
        yield (
            f"Figures {chapter}.{int(number) - 1}, {grid.figure}",
            f"{title}: does sparsity help (error at the least, middle, most)",
            grid.thesis,
            "; ".join(said),
            "grids",
        )


def _integrators() -> Iterator[Row]:
    fits = pd.read_csv(RESULTS / "thesis" / "integrators.csv")
    l2 = fits.groupby(["system", "noise", "integrator"], sort=False)["l2"].median()
    for title, part in l2.groupby("system", sort=False):
        by_noise = []
        for noise, errors in part.groupby("noise", sort=False):
            own: Any = errors.droplevel(["system", "noise"])
            cells = [f"{name} {error:.2g}" for name, error in own.items()]
            by_noise.append(f"noise {noise:g}: {', '.join(cells)}")
        is_first = title == "Henon-Heiles"
        yield (
            "Figures A.1, A.2" if is_first else "Figures A.3, A.4",
            f"{title}: l2 by integrator",
            THESIS_INTEGRATORS[is_first],
            "; ".join(by_noise),
            "integrators",
        )


THESIS_INTEGRATORS = {
    True: "Euler 100 times SRK4 at noise 1e-5, less with more noise; RK4 like SRK4",
    False: "SRK4 before RK4 and midpoint, these before Euler; with much noise the "
    "symmetric ones do well",
}


def main(quick: bool = False) -> str:
    """The table; written into docs/thesis.md unless ``quick``."""
    header = ["thesis, place", "what", "thesis", "here", "page"]
    made = markdown.lines(
        header, [(*cells, f"`results/thesis/{page}.md`") for *cells, page in rows()]
    )
    if quick:
        print(made)
        return made
    before, rest = DOCUMENT.read_text("utf-8").split(BEGIN)
    after = rest.split(END)[1]
    write_whole(DOCUMENT, f"{before}{BEGIN}\n\n{made}\n\n{END}{after}")
    return made


if __name__ == "__main__":
    main(flag("quick"))
