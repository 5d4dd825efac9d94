"""Printed tables lose no column, whatever stands in them; results show themselves."""

import io
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

import phsi_opt as ph
from phsi_opt.diagnosis.candidate import Finding
from phsi_opt.presentation.numbers import time_constant_words, typeset
from phsi_opt.presentation.tables import (
    MOST_ROWS,
    PrintedTable,
    html_of_table,
    text_of_table,
)

HISTORY = ["step", "effect", "train_rmse", "held_out_rmse", "noise_floor", "bic"]
LONG = "position-dependent damping on p2, without coupling stiffness on p1, re-fitted"
EVIL = "<script>alert(1)</script>[bold red]&amp;"


def history(*effects: str) -> PrintedTable:
    rows = []
    for step, effect in enumerate(effects):
        rows.append((step, effect, 0.05658, 0.06032, 0.04245, -290712.25))
    return PrintedTable(rows, columns=HISTORY)


def squeezed(text: str) -> str:
    return re.sub(r"\s+", "", text)


def test_long_names_of_effects_cost_lines_and_no_column() -> None:
    lines = str(history("base model", "coulomb friction on p")).splitlines()
    assert lines[0].split() == HISTORY
    assert lines[2].split()[-4:] == ["0.05658", "0.06032", "0.04245", "-2.907e+05"]
    text = str(history("base model", LONG, LONG))
    assert len(lines) == 3 and max(map(len, [*lines, *text.splitlines()])) <= 80
    for value in ("0.05658", "0.06032", "0.04245", "-2.907e+05"):
        assert text.count(value) == 3
    for word in LONG.split():
        assert text.count(word.rstrip(",")) >= 2


@pytest.mark.parametrize("seed", range(12))
def test_no_cell_of_any_table_is_lost_and_no_number_is_broken(seed: int) -> None:
    rng = np.random.default_rng(seed)
    width = int(rng.integers(40, 120))
    n_columns = int(rng.integers(1, 15))
    n_rows = int(rng.integers(1, 5))
    columns: dict[str, Any] = {}
    for number in range(n_columns):
        name = f"{'long_' * int(rng.integers(0, 4))}c{number}"
        if rng.uniform() < 0.5:
            columns[name] = rng.normal(size=n_rows) * 10.0 ** rng.integers(-9, 9)
        else:
            words = [
                f"w{k}" * int(rng.integers(1, 6)) for k in range(rng.integers(0, 9))
            ]
            columns[name] = [" ".join(words)] * n_rows
    table = pd.DataFrame(columns)
    text = text_of_table(table, width)
    lines = text.splitlines()
    assert max(map(len, lines)) <= width
    for name, values in columns.items():
        if isinstance(values, np.ndarray):
            for value in values:
                assert re.search(rf"(?<!\S){re.escape(f'{value:.4g}')}(?!\S)", text)
        # A header stands in one column of characters, perhaps in several lines.
        pieces = [piece for piece in name.split("_") if piece]
        assert all(piece in text for piece in pieces)


def test_of_long_tables_the_ends_are_printed_and_the_number_of_rows() -> None:
    table = pd.DataFrame({"t": np.arange(1000.0), "name": "x"})
    lines = text_of_table(table).splitlines()
    assert len(lines) == 1 + MOST_ROWS + 2  # header, rows, what is left out, number
    assert lines[1].split() == ["0", "x"]
    assert lines[-2].split() == ["999", "x"]
    assert lines[-1] == "(1000 rows)"
    assert text_of_table(table.head(0)).splitlines()[-1] == "(no rows)"
    by_name = pd.DataFrame({"value": [1.0]}, index=["R_p"])  # names, no numbers of rows
    assert text_of_table(by_name).split() == ["value", "R_p", "1"]
    assert text_of_table(by_name.reset_index(drop=True)).split() == ["value", "1"]


class Tags(HTMLParser):
    """The tags and texts of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.texts: list[str] = []
        self.open: list[str] = []
        self.feed(page)
        assert not self.open, "every tag is closed"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag != "br":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def rich_text(shown: object, width: int = 80) -> str:
    file = io.StringIO()
    Console(file=file, width=width, color_system=None).print(shown)
    return file.getvalue()


def test_names_can_inject_nothing_into_html_and_mean_nothing_to_rich() -> None:
    table = PrintedTable({EVIL: [EVIL], "n": [1.5]}, index=[EVIL])
    page = Tags(html_of_table(table))
    assert set(page.tags) == {"table", "thead", "tbody", "tr", "th", "td"}
    assert page.texts.count(EVIL) == 3
    assert table._repr_html_() == html_of_table(table)
    shown = squeezed(rich_text(table, width=200))
    assert shown.count(squeezed(EVIL)) == 3


def measurements() -> ph.Measurements:
    t = np.linspace(0, 1, 5)
    return ph.Measurements.from_arrays(
        t, np.sin(t), np.cos(t), states=["q"], inputs=["u"], units={"q": EVIL}
    )


def spring() -> ph.PseudoHamiltonian:
    stiffness = ph.Parameter(1.0, lower=0, unit=EVIL)
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/(2*m)", k=stiffness, m=2.5),
        R=ph.damping("p"),
        F={"p": ph.formula("u") + ph.polynomials(["q"], degree=2)},
    )


@pytest.mark.parametrize("shown", [measurements(), spring(), ph.catalogue(spring())])
def test_what_shows_itself_does_so_by_html_and_rich_with_names_escaped(shown) -> None:
    page = Tags(shown._repr_html_())
    assert "script" not in page.tags
    title = str(shown).splitlines()[0]
    assert title in page.texts
    lines = rich_text(shown).splitlines()
    assert lines[0] == title
    assert max(len(line.rstrip()) for line in lines) <= 80
    if not isinstance(shown, list):
        assert any(EVIL in text for text in page.texts)
        assert squeezed(EVIL) in squeezed(rich_text(shown, width=200))


def test_a_model_prints_its_equations_and_the_catalogue_a_table() -> None:
    text = str(spring())
    assert "dp/dt = - dH_dq - R_p*dH_dp + F_p" in text
    assert "F_p = u + c2*q + c3*q**2" in text
    assert re.search(r"^m +2\.5 +yes", text, re.MULTILINE)
    effects = ph.catalogue(spring())
    assert isinstance(effects, list)
    assert effects[:2] == [effects[0], effects[1]]
    lines = str(effects).splitlines()
    assert lines[0] == f"{len(effects)} effects"
    assert lines[2].split() == ["effect", "equation", "slot", "family"]
    assert max(map(len, lines)) <= 80
    for effect in effects:
        row = rf"^{re.escape(effect.name)} +{effect.equation} +{effect.slot} "
        assert re.search(row, str(effects), re.MULTILINE)


def test_a_rate_is_told_as_its_time_constant() -> None:
    assert time_constant_words(0.2511, 0.0011, "1/h") == (
        "time constant 3.982 +- 0.017 h"
    )
    # The ends are 1/(0.25 + 0.098) and 1/(0.25 - 0.098): no symmetric interval.
    assert time_constant_words(0.25, 0.05, "1/h") == (
        "time constant 4.00 h (95 %: 2.87 to 6.58)"
    )
    overflow = ph.Effect("spill", "R", "h", ph.formula("max(h-limit,0)/h", limit=1.0))
    assert "time constant" not in str(Finding((overflow,), "", 0.25, 0.01, 1.0, "1/h"))
    # Of a state without a unit any coefficient may be a rate.
    decays = (("R", "1"), ("F", "Ta - h"))
    for slot, body in (*decays, ("R", "abs(h)"), ("F", "h**2"), ("F", "1")):
        effect = ph.Effect("x", slot, "h", ph.formula(body))
        told = str(Finding((effect,), "", 0.25, 0.01, 1.0, "1/h"))
        assert ("time constant" in told) == ((slot, body) in decays)
    assert time_constant_words(0.25, 0.15, "1/h") == "", "may be none at all"
    assert time_constant_words(0.25, 0.01, "degC/h") == ""
    assert time_constant_words(0.25, float("nan"), "1/h") == ""


def test_powers_with_a_fraction_stay_as_they_are_written() -> None:
    assert typeset("m^2.5/s") == "m^2.5/s"
    assert typeset("rad/s^2") == "rad/s\N{SUPERSCRIPT TWO}"
