"""Where in a file its table stands: its header, a row of units, its rows of values.

Loggers write settings and comments above the table, and statistics below it. A section
of a file is rows of text and the rows of values below them. The table is the section
with most values. Rows that begin with different words are settings or statistics, not
samples. Where another section may have samples, the file is to be cut.
"""

import datetime as dt
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from phsi_opt.data.tables import MISSING_CELLS, THOUSANDS, Extent
from phsi_opt.presentation.units import is_known

Rows = dict[int, list[Any]]  # the cells of each row that is not empty, by its number

NUMBER = re.compile(r"[+-]?(\d++([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?")
MOMENT = re.compile(
    r"\d{1,4}[-./: ](\d{1,2}|[A-Za-z]{3})[-./: ]\d[\d:.,]*([T ][\d:.,]+)?"
    r"(Z|[+-][\d:]+)?( ?[AaPp]\.?[Mm]\.?)?|\d{1,2}:\d\d( ?[AaPp][Mm])?"
)
COMMENT = re.compile(r"(#|%|//)\s*(?=\S)")
COMMENT_MARKS = ("#", "%", "//")
SYMBOL = (
    r"(([numkMGcdh\u00b5\u03bc]?(m|s|g|A|K|N|Nm|Pa|J|W|Wh|V|Hz|Ohm|\u03a9|bar|L|l|rad|"
    r"C|F|H|T|mol)|sec|min|h|hr|d|rpm|rev|deg|degC|degF|\u00b0[CF]?|psi|ft|in|lb|lbf|"
    r"lbs|mph|kph|dB)(\u00b2|\u00b3|(\^|\*\*)?-?\d)?)"
)
# The number of a socket or a sensor, such as "CH1" or "Dev1/ai0".
ADDRESS = re.compile(r"[^\W\d_][01]$|[A-Z]\d+$")
UNIT = re.compile(rf"{SYMBOL}([ /*\u00b7.]\(?{SYMBOL}\)?)*|1/{SYMBOL}|%|-|1")
# Kinds of a cell, a sign each; a row of cells is a text of them.
VALUE, DATE, WORD, GAP = "nmt "


def kind(cell: Any) -> str:
    """Whether a cell is a number, a moment, a missing value or something else."""
    if not isinstance(cell, str):
        return DATE if isinstance(cell, dt.date | dt.time | dt.timedelta) else VALUE
    if cell.lower() in MISSING_CELLS:
        return GAP
    if NUMBER.fullmatch(cell) or THOUSANDS.fullmatch(cell):
        return VALUE
    return DATE if MOMENT.fullmatch(cell) else WORD


def is_unit(text: str) -> bool:
    """Whether a text is a unit, and no other word."""
    is_address = ADDRESS.search(text) is not None
    return not is_address and (UNIT.fullmatch(text) is not None or is_known(text))


def unit_in(cell: Any) -> str:
    """The unit that a cell of a row of units says; "" where it is none."""
    text = str(cell).strip()
    is_bracketed = text[:1] + text[-1:] in ("[]", "()", "<>")
    inside = text[1:-1].strip() if is_bracketed else text
    return inside if (is_unit if is_bracketed else UNIT.fullmatch)(inside) else ""


def n_filled(cells: Sequence[Any]) -> int:
    """The number of cells up to the last that is not empty."""
    n_cells = len(cells)
    while n_cells and cells[n_cells - 1] == "":
        n_cells -= 1
    return n_cells


@dataclass(frozen=True, eq=False)
class Row:
    """A row that is not empty."""

    number: int  # in the file, from 1
    cells: Sequence[Any]  # without a comment mark
    kinds: str  # of the cells
    is_comment: bool = False

    @property
    def n_values(self) -> int:
        return self.kinds.count(VALUE) + self.kinds.count(DATE)

    @property
    def width(self) -> int:
        return n_filled(self.cells)

    @property
    def is_text(self) -> bool:
        """Whether it has words, and no value."""
        return self.is_comment or (WORD in self.kinds and not self.n_values)

    @property
    def n_units(self) -> int:
        return sum(map(bool, map(unit_in, self.cells)))

    def fits(self, typical: str) -> bool:
        """Whether more than half of the filled cells are as in most rows.

        A name where these have none is that of a setting.
        """
        if self.kinds.startswith(WORD) and typical.startswith(GAP):
            return False
        pairs = zip(self.kinds, typical, strict=False)
        n_alike = sum(own == other != GAP for own, other in pairs)
        n_cells = len(self.kinds) - self.kinds.count(GAP)
        return 2 * n_alike > n_cells or not n_cells


@dataclass(frozen=True, eq=False)
class Section:
    """Rows of text, and the rows of values below them."""

    texts: Sequence[Row]
    values: Sequence[Row]
    typical: str = ""  # the kinds of most rows of values

    @property
    def size(self) -> int:
        """The number of its values, nearly."""
        return len(self.values) * (self.typical.count(VALUE) + self.typical.count(DATE))

    @property
    def is_list(self) -> bool:
        """Whether its rows begin with different words, as settings or statistics do."""
        firsts = {row.cells[0] for row in self.values if row.kinds.startswith(WORD)}
        return 1 < len(firsts) == len(self.values)

    @property
    def is_table(self) -> bool:
        if len(self.values) > 1:
            return not self.is_list
        is_wide = any(row.width > 1 for row in self.values)
        return is_wide and bool(self.texts) and WORD not in self.typical

    def head(
        self, is_first: bool, units_row: int | None
    ) -> tuple[Row | None, Row | None]:
        """The rows of the names (``is_first``: at its top) and of the units."""
        is_wide = len(self.typical.rstrip()) > 1
        titled = [row for row in self.texts if not is_wide or row.width > 1]
        plain = list(itertools.filterfalse(attrgetter("is_comment"), titled)) or titled
        near = plain[:3] if is_first else plain[-3:]
        units = next((row for row in near if row.number == units_row), None)
        if units_row is None and len(near) > 1:
            # The lowest of equals: names such as V and A are units, too.
            best = max(reversed(near), key=attrgetter("n_units"))
            is_clear = 2 * best.n_units > max(self.typical.count(VALUE), 1)
            units = best if is_clear else None
        names = [row for row in near if row is not units]
        if not names:
            return None, units
        if is_first:
            return names[0], units
        above = [row for row in names if units and row.number < units.number]
        return (above or names)[-1], units


def extent_of(
    rows: Rows,
    skip: int | None = None,
    units_row: int | None = None,
    by_blanks: bool = False,
) -> Extent:
    """Find the table; ``skip`` rows stand above it, and row 0 of units is none."""
    sections = list(_sections(_rows(rows, skip or 0, units_row, by_blanks)))
    main = sections[0]
    if skip is None:
        tables = list(filter(attrgetter("is_table"), sections))
        main = max(tables or sections, key=attrgetter("size"))
    place = sections.index(main)
    head, units = main.head(skip is not None, units_row)
    samples = tuple(map(attrgetter("number"), main.values))
    first = (head or [*main.values, *main.texts][0]).number
    below = next((row for row in rows if samples and row > samples[-1]), None)
    cut = None
    is_named = main.typical.startswith(WORD)  # statistics begin with words, too
    if any(
        one.values and (is_named or not one.is_list) for one in sections[place + 1 :]
    ):
        cut = below
    elif any(one.is_table for one in sections[:place]):
        cut = [*main.texts, *main.values][0].number
    return Extent(
        head.number if head else None,
        units.number if units else None,
        samples,
        names=tuple(head.cells) if head else (),
        unit_of=tuple(map(unit_in, units.cells)) if units else (),
        above=first - 1,
        below=below,
        cut=cut,
    )


def _rows(rows: Rows, skip: int, units_row: int | None, by_blanks: bool) -> list[Row]:
    """The rows behind those that are skipped.

    Comments end at the first row as wide as most: below it, "#REF!" is a wrong cell.
    """
    found = []
    for number, cells in rows.items():
        if number > skip:
            kinds = "".join(map(kind, cells))
            found.append(Row(number, cells, WORD if number == units_row else kinds))
    width = len(_typical(found).rstrip(GAP))
    for i, row in enumerate(found):
        plain = _without_mark(row.cells, by_blanks)
        if plain is not None:
            found[i] = Row(row.number, plain, WORD, is_comment=True)
        elif row.width >= width:
            break
    return found


def _without_mark(cells: Sequence[Any], by_blanks: bool) -> list[Any] | None:
    """The cells of a row of comment without its mark; None of another row."""
    first, *others = cells
    if by_blanks and first in COMMENT_MARKS:
        return others
    if isinstance(first, str) and COMMENT.match(first):
        return [COMMENT.sub("", first, count=1), *others]
    return None


def _typical(rows: Sequence[Row]) -> str:
    """The kinds of the cells of most rows."""
    weights: Counter[str] = Counter()
    for row in rows:
        weights[row.kinds] += row.n_values
    return max(weights, key=weights.__getitem__, default="")


def _sections(rows: Iterable[Row]) -> Iterator[Section]:
    texts: list[Row] = []
    values: list[Row] = []
    for row in rows:
        if row.is_text and values:
            yield _section(texts, values)
            texts = []
            values = []
        (texts if row.is_text else values).append(row)
    yield _section(texts, values)


def _section(texts: list[Row], values: list[Row]) -> Section:
    """The section, from the first row on that has the kinds of most rows."""
    typical = _typical(values)
    n_before = [*(row.fits(typical) for row in values), True].index(True)
    is_named = bool(texts) and texts[-1].width >= len(typical.rstrip(GAP))
    if n_before and is_named and not typical.startswith(GAP):
        n_before = 0  # samples with wrong cells, which are refused
    elif n_before and (n_before > 1 or texts):
        texts = []
    elif n_before:
        texts = values[:1]  # a header with numbers in it
    elif values and not texts:
        first = values[0]
        names = ["", *range(first.width - 1)]  # of columns without, in pandas
        are_positions = [*map(str, first.cells)] == [*map(str, names)]
        pairs = zip(first.kinds, typical, strict=False)
        has_words = any(own == WORD and other in (VALUE, DATE) for own, other in pairs)
        n_before = int(has_words or are_positions)
        texts = values[:n_before]
    return Section(texts, values[n_before:], typical)
