"""The thesis' own numbers beside those of the result pages, as a table in
docs/thesis.md, written anew from the committed results.

    python -m problems.thesis.side_by_side [--quick]
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import pandas as pd

from phsi_opt.writing import write_whole
from problems.thesis import grid_verdicts
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
L2_WHOLE = -4
RELATIVE = -8
LARGEST = -9
SHARE_OF_F = re.compile(r"Share of F, solver: (.*?)\. Share of F")
AT_LARGER_NOISE = re.compile(r"^ *0\.03 +PHSI, solver +(\S+ %) +(\S+ %)", re.MULTILINE)


@dataclass(frozen=True)
class Row:
    """One claim of the thesis with its number and ours."""

    where: str
    what: str
    thesis: str
    here: str
    page: str


def text_of(page: str) -> str:
    """A page under results/thesis."""
    return (RESULTS / "thesis" / f"{page}.md").read_text("utf-8")


def score_of(page: str, method: str, column: int) -> str:
    """A cell of the table of all methods; ``method`` begins with clean or noisy.

    Raises:
        LookupError: the page has no such line.
    """
    for line in text_of(page).splitlines():
        words = " ".join(line.split())
        if words.startswith(f"{method} "):
            return words.split()[column]
    raise LookupError(f"results/thesis/{page}.md has no line that begins {method!r}")


def thesis_errors(
    published: dict[str, float], truth: dict[str, float]
) -> dict[str, float]:
    """Absolute errors of what the thesis prints, by coefficient."""
    return {name: abs(v - truth.get(name, 0.0)) for name, v in published.items()}


def largest_relative(published: dict[str, float], truth: dict[str, float]) -> float:
    """Largest relative error of what the thesis prints of the true coefficients."""
    errors = thesis_errors(published, truth)
    return max(errors[name] / abs(truth[name]) for name in truth if name in errors)


def rows() -> Iterator[Row]:
    """All rows, in the order of the thesis."""
    yield from _chapter_5()
    yield from _henon_heiles()
    yield from _schrodinger()
    yield from _mass_spring()
    yield from _tanks()
    yield from _grids()
    yield from _integrators()


def _chapter_5() -> Iterator[Row]:
    found = SHARE_OF_F.search(text_of("regularization"))
    yield Row(
        "Figure 5.1",
        "who explains a free mass-spring, by L1 on H, F",
        "F where H has L1; H where F has; either with none",
        f"share of F: {found.group(1) if found else '-'}",
        "regularization",
    )


def _henon_heiles() -> Iterator[Row]:
    truth = dict(SYSTEMS["henon_heiles"].truth)
    published = COEFFICIENTS["henon_heiles"]
    of_thesis = {
        name: max(thesis_errors(values, truth).values())
        for name, values in published.items()
    }
    page = "henon_heiles"
    yield Row(
        "Table 6.1",
        "largest coefficient error, noisy",
        ", ".join(f"{name} {error:.3g}" for name, error in of_thesis.items()),
        _methods(page, "noisy", LARGEST, ("PHSI, solver", "PHSI, descent", "SSINN")),
        page,
    )
    compared = ("PHSI, solver", "PHSI, descent", "BSI, solver", "SSINN")
    yield Row(
        "Figures 6.1, 6.2",
        "free runs, noisy",
        "PHSI an order of magnitude before SSINN; both it and BSI before SSINN, SINDy",
        "l2 " + _methods(page, "noisy", L2_WHOLE, (*compared, "SINDy, STLSQ")),
        page,
    )


def _methods(page: str, kind: str, column: int, labels: tuple[str, ...]) -> str:
    cells = []
    for label in labels:
        number = score_of(page, f"{kind} {label}", column)
        cells.append(f"{label} {number.replace('inf', 'diverges')}")
    return "; ".join(cells)


def _schrodinger() -> Iterator[Row]:
    page = "schrodinger"
    labels = ("PHSI, solver", "PHSI, descent", "BSI, solver", "SINDy, STLSQ")
    yield Row(
        "Section 6.2",
        "largest coefficient error, clean",
        "PHSI and SINDy 1e-5, BSI 1e-3",
        _methods(page, "clean", LARGEST, (*labels, "BSI, descent")),
        page,
    )
    precision = "; ".join(f"{name} {value}" for name, value in PRECISION.items())
    yield Row(
        "Figures 6.3, 6.4",
        "largest coefficient error, noisy",
        precision,
        _methods(page, "noisy", LARGEST, labels),
        page,
    )


def _mass_spring() -> Iterator[Row]:
    system = SYSTEMS["mass_spring"]
    page = "mass_spring"
    phsi = largest_relative(COEFFICIENTS[page]["PHSI"], dict(system.truth))
    bsi = largest_relative(BSI_MASS_SPRING, dict(system.truth_first_order))
    labels = ("PHSI, solver", "PHSI, descent", "BSI, solver")
    yield Row(
        "Table 6.2",
        "worst relative error of a true coefficient, clean",
        f"PHSI {phsi:.2g}; BSI {bsi:.2g}",
        _methods(page, "clean", RELATIVE, labels),
        page,
    )
    yield Row(
        "Figures 6.5, 6.6",
        "free runs to twice the training time, noisy",
        "PHSI good to the end; BSI, PHNN good inside only; SINDy poor",
        "l2 " + _methods(page, "noisy", L2_WHOLE, (*labels, "SINDy, STLSQ", "PHNN")),
        page,
    )


def _tanks() -> Iterator[Row]:
    truth = dict(SYSTEMS["tanks"].truth)
    published = COEFFICIENTS["tanks"]["PHSI"]
    energies = {k: v for k, v in truth.items() if k.startswith("H")}
    damping = {k: v for k, v in truth.items() if k.startswith("R")}
    found = AT_LARGER_NOISE.search(text_of("tanks"))
    here = f"H {found.group(1)}, r {found.group(2)}" if found else "-"
    yield Row(
        "Table 6.3",
        "worst relative error, noise 0.03",
        f"H {largest_relative(published, energies):.1%}, "
        f"r {largest_relative(published, damping):.0%}",
        f"PHSI, solver: {here}",
        "tanks",
    )
    labels = ("PHSI, solver", "PHSI, descent", "BSI, solver", "SINDy, STLSQ")
    yield Row(
        "Figures 6.7, 6.8",
        "free runs, noise 0.005",
        "PHSI before BSI before SINDy; outside the training range PHSI alone",
        "l2 " + _methods("tanks", "noisy", L2_WHOLE, labels),
        "tanks",
    )


GRID_FIGURES = {
    "henon_heiles": "Figures 6.9, 6.10",
    "schrodinger": "Figures 6.11, 6.12",
    "mass_spring": "Figures 6.13, 6.14",
    "tanks": "Figures 6.15, 6.16",
}


def _grids() -> Iterator[Row]:
    readings = pd.read_csv(RESULTS / "thesis" / "grid_readings.csv")
    table = grid_verdicts.verdicts(readings)
    for name, figures in GRID_FIGURES.items():
        own = table[table["system"] == SYSTEMS[name].title]
        said = [
            f"{r['reading']}: {r['here']} ({r['error, least']}, {r['error, middle']}, "
            f"{r['error, most']})"
            for _, r in own.iterrows()
        ]
        yield Row(
            figures,
            f"{SYSTEMS[name].title}: does sparsity help (error at the least, middle, "
            "most)",
            grid_verdicts.THESIS[name],
            "; ".join(said),
            "grids",
        )


def _integrators() -> Iterator[Row]:
    fits = pd.read_csv(RESULTS / "thesis" / "integrators.csv")
    l2 = fits.groupby(["system", "noise", "integrator"], sort=False)["l2"].median()
    for title, part in l2.groupby("system", sort=False):
        by_noise = []
        for noise, errors in part.groupby("noise", sort=False):
            values = errors.droplevel(["system", "noise"])
            cells = [f"{name} {error:.2g}" for name, error in values.items()]
            by_noise.append(f"noise {noise:g}: {', '.join(cells)}")
        yield Row(
            "Figures A.1, A.2" if title == "Henon-Heiles" else "Figures A.3, A.4",
            f"{title}: l2 by integrator",
            THESIS_INTEGRATORS[title == "Henon-Heiles"],
            "; ".join(by_noise),
            "integrators",
        )


THESIS_INTEGRATORS = {
    True: "Euler 100 times SRK4 at noise 1e-5, less with more noise; RK4 like SRK4",
    False: "SRK4 before RK4 and midpoint, these before Euler; with much noise the "
    "symmetric ones do well",
}


def section() -> str:
    """The table with its first lines."""
    table = [vars(row) for row in rows()]
    shown = pd.DataFrame(table).rename(columns={"where": "thesis, place"})
    shown["page"] = [f"`results/thesis/{page}.md`" for page in shown["page"]]
    return markdown.table(shown)


def main(quick: bool = False) -> str:
    """The section; written into docs/thesis.md unless ``quick``."""
    made = section()
    if quick:
        print(made)
        return made
    before, rest = DOCUMENT.read_text("utf-8").split(BEGIN)
    after = rest.split(END)[1]
    write_whole(DOCUMENT, f"{before}{BEGIN}\n\n{made}\n\n{END}{after}")
    return made


if __name__ == "__main__":
    main(flag("quick"))
