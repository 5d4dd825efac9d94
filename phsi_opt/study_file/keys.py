"""Every key of a study file: where it stands, what it holds, what it is for.

One table: files are read and checked by it, messages say what it expects, and the
reference in docs/command_line.md is tested against it. The fields of the records in
`sections` have the names of these keys.

What is wrong is collected in `Complaints`, not raised, so that all is told at once:
what cannot be used is noted and left out, and reading goes on. A place in the file is
the names and numbers that lead to it from the top: ``("data", "states", "q")``.
"""

import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from phsi_opt.errors import Complaint, DataError, ModelError, did_you_mean
from phsi_opt.presentation.numbers import capitalised, shortened
from phsi_opt.study_file.toml_text import key_text, toml_value

# The key, what it holds, what it is for; "*" stands for a name of the user's own.
TABLE = """
data | table | files and columns; paths are relative to this file
held_out | table | the data not used for fitting, for a fair test; default: none
final | table | data for a final test alone; default: one of 3 or more runs
model | table | the base model: states, energy, losses, forces
parameters | table | the parameters: a number is fixed, start is a starting value
effects | list of tables | effects of your own, as [[effects]]
study | table | effects added so far; effects to consider or to exclude
loss | table | the loss of the fit; default: maximum likelihood
data.files | list of files | text, .xlsx, .mat, ...; relative to this file
data.trajectory | text | column with the name of the run; default: a single run
data.hold | "linear", "zero" or "cubic" | inputs between samples; default linear
data.time | table | the times
data.between | list of two numbers | first and last time to use; default: all
data.detrended | list of texts | channels to take a linear trend out of; default: none
data.resampled | positive number | time between new, filtered samples; default: none
data.thinned | whole number | so many samples are averaged into one; default: none
data.sheet | text | sheet of the workbook (.xlsx); default: the only one
data.group | text | group of channels, topic of a bag; default: the only one
data.columns | list of texts | names of the columns, if the file has no header
data.separator | text | separator of the cells in a text file; default: detected
data.decimal | text | decimal separator; default: detected
data.skip | line number | lines above the header; default: detected
data.units_row | line number | line of the units, 0: there is none; default: detected
data.states | table | a table for each state
data.inputs | table | a table for each measured input; default: none
data.time.column | column or columns | numbers or dates; ["Date", "Time"] if apart
data.time.unit | text | unit, such as "s"; dates become seconds
data.time.step | positive number | instead of a column: time step between lines
data.time.start | text | date at which t is 0; default: first sample of each run
data.time.date_format | text | "%d.%m.%Y %H:%M", "excel", "unix"; "": not dates
data.states.* | table | a state; its name is the one in the formulas
data.states.*.column | text or position | its header, or its position, counted from 0
data.states.*.unit | text | its unit, such as "m"; default: unknown
data.states.*.clock | text or position | column of its own times; default: the times
data.states.*.measured | true or false | false, instead of a column: it was not measured
data.states.*.noise | positive number | standard deviation; default: estimated
data.inputs.* | table | an input; its name is the one in the formulas
data.inputs.*.column | text or position | its header, or its position, counted from 0
data.inputs.*.unit | text | its unit, such as "m"; default: unknown
data.inputs.*.hold | "linear", "zero" or "cubic" | for this input; default: data.hold
data.inputs.*.clock | text or position | column of its own times; default: the times
held_out.runs | list of texts | names of the runs to hold out
held_out.share | number from 0 to 1 | or: last share of the runs, or of a single run
held_out.after | number | or: all samples of every run after this time
final.runs | list of texts | names of the runs for the final test; [] for none
final.share | number from 0 to 1 | or: last share of the runs, or of a single run
final.after | number | or: all samples of every run after this time
model.type | "PseudoHamiltonian" or "FirstOrder" | default: PseudoHamiltonian
model.states | list of texts | names of the states
model.inputs | list of texts | names of the inputs; default: none
model.pairs | list of pairs | canonical pairs, such as [["q", "p"]]: dq/dt = dH/dp
model.S | list of rows | or: the skew-symmetric structure matrix
model.H | formula, term, or list of these | the energy, a function of the states only
model.R | table | losses R_ii >= 0 by state or direction: dx_i/dt = ... - R_ii dH/dx_i
model.F | table | forces by state or direction; of states, inputs, t, efforts dH_dp
model.sensor | table | sensor error by state: measured value minus state
model.memory | list of texts | states that belong to the memory of an effect
model.kind | text or table | kind of the states: "thermal", or { T1 = "thermal" }
model.R.* | formula, term, or list of these | for this state, or along "p1 - p2"
model.F.* | formula, term, or list of these | for this state, or along "p1 - p2"
model.sensor.* | formula, term, or list of these | for the state of this name
model.kind.* | text | for the state of this name
term.body | formula | one term: coefficient times this formula
term.coefficient | parameter | its coefficient; default: estimated
term.inner | table of parameters | parameters inside the formula of the body
term.name | text | name of the coefficient; default: from slot and state
term.polynomials | list of texts | or: all monomials of these variables
term.degree | whole number | largest total degree of the monomials
term.constant | true or false | whether the monomials include 1; default false
term.trigonometric | list of texts | or: sines and cosines of these variables
term.n | whole number | number of sine-cosine pairs per variable; default 1
term.frequency | number | starting value in rad per unit; default: from a scan
parameters.* | parameter | a number, which is fixed, or a table as below
parameters.*.start | number | starting value; default: from the data
parameters.*.value | number | instead of start: a fixed value, not estimated
parameters.*.lower | number | lower bound; default: none
parameters.*.upper | number | upper bound; default: none
parameters.*.unit | text | unit of its numbers, such as "N/m"; results are shown in it
parameters.*.prior | mean and deviation | what is known of it: [40, 2] is 40 +- 2
parameters.*.per_trajectory | true or false | one value for each run; default false
parameters.*.fixed | true or false | with a guess: keep that value, do not estimate it
parameters.*.guess | table | rule that takes the starting value from the data
parameters.*.guess.kind | "Scan", "Share" or "Tried" | the rule
parameters.*.guess.variable | text | Scan: variable of the sine or cosine
parameters.*.guess.of | formula | Share, Tried: formula that sets the scale
parameters.*.guess.share | number | Share: start / root mean square of it
parameters.*.guess.sharper | list of numbers | Share: factors for a sharper corner
parameters.*.guess.shares | list of numbers | Tried: starts / largest absolute value
parameters.*.guess.most | number | Tried: upper bound / largest absolute value
effects.name | text | name of the effect
effects.slot | "H", "R", "F" or "sensor" | part of the model to which it is added
effects.equation | text | state in whose equation it acts, or "p1 - p2"
effects.term | formula, term, or list of these | the term that it adds
effects.memory | table of terms | additional states, each with its rate of change
effects.family | text | name of its class; default: none
study.added | list of effects | effects added, such as "coulomb friction on p"
study.effects | list of effects | effects to consider; default: the catalogue
study.without | list of effects | effects to exclude; default: none
study.title | text | title of reports, such as the machine; default: the files
study.max_steps | whole number | largest number of effects that --auto adds; default 4
loss.integrator | "euler", "midpoint", "rk4" or "srk4" | scheme; default srk4
loss.steps | whole number | steps between samples; default: chosen by accuracy
loss.huber | number | residuals beyond this many standard deviations count linearly
loss.starts | whole number | number of starting points; default 1
loss.model_error | true or false | random forces in the equations; default false
"""


Fits = Callable[[Any], bool]


class Form(NamedTuple):
    """What a key can hold: a test, the words for it, whose keys tables of it have."""

    fits: Fits
    expected: str
    table: str = ""  # "": those below the key itself


class Key(NamedTuple):
    """One key: its path, what it holds, and what it is for, with the default."""

    path: str
    form: str
    meaning: str

    @property
    def sentence(self) -> str:
        """What it is for, without the default."""
        return f"{capitalised(self.meaning.partition('; default')[0])}."

    @property
    def options(self) -> list[str]:
        """The words of a choice; none of another form."""
        return re.findall(r'"(\w+)"', self.form)

    @property
    def most(self) -> int:
        """The entries that its list or table may have.

        A person writes fewer, and the check of a file takes a time that grows with
        their square; a catalogue of effects takes 0.1 s for each name.
        """
        return 1000 if self.path in COMES_WITH_DATA else 100

    @property
    def what(self) -> Form:
        options = self.options
        return Form(options.__contains__, self.form) if options else FORMS[self.form]


def is_number(value: Any) -> bool:
    """Whether this is a number; true and false are none."""
    return _is(int, float)(value)


def listed(value: Any) -> list[Any]:
    """A list as it is; anything else stands for a list of it."""
    return list(value) if isinstance(value, list | tuple) else [value]


def _is(*types: type) -> Fits:
    """Of one of some types; true and false are no numbers."""
    is_flag = bool in types
    return lambda value: isinstance(value, types) and isinstance(value, bool) == is_flag


def _many(fits: Fits) -> Fits:
    return lambda value: isinstance(value, list) and all(map(fits, value))


def _one_or_many(*types: type) -> Fits:
    return lambda value: all(map(_is(*types), listed(value)))


def _between(low: float, high: float, kind: Fits = is_number) -> Fits:
    return lambda value: kind(value) and low < value < high


def _two(fits: Fits, differ: Callable[[Any, Any], bool]) -> Fits:
    return lambda value: _many(fits)(value) and len(value) == 2 and differ(*value)


IS_TEXT = _is(str)
ARE_TEXTS = _one_or_many(str)
IS_POSITION = _between(-1, float("inf"), _is(int))
IS_SPAN = _two(is_number, operator.lt)
IS_PRIOR = _two(is_number, lambda _, deviation: deviation > 0)
ARE_PAIRS = _many(_two(IS_TEXT, operator.ne))
ARE_TERMS = _one_or_many(str, int, float, dict)
IS_COUNT = _between(0, float("inf"), _is(int))

FORMS = {
    "text": Form(IS_TEXT, 'text in quotes, such as "m"'),
    "formula": Form(IS_TEXT, 'a formula in quotes, such as "q**2"'),
    "number": Form(is_number, "a number, such as 0.5, without quotes"),
    "positive number": Form(
        _between(0, float("inf")),
        "a positive number, such as 0.1; omit it if it is unknown",
    ),
    "number from 0 to 1": Form(_between(0, 1), "a number between 0 and 1, such as 0.3"),
    "whole number": Form(IS_COUNT, "a whole number of at least 1"),
    "line number": Form(IS_POSITION, "a number of lines, such as 12"),
    "true or false": Form(_is(bool), "true or false, without quotes"),
    "text or position": Form(
        lambda value: IS_TEXT(value) or IS_POSITION(value),
        'a header, such as "q", or a position from 0',
    ),
    "column or columns": Form(
        lambda value: ARE_TEXTS(value) or IS_POSITION(value),
        'a header, such as "t", a position from 0, or a list of headers',
    ),
    "list of texts": Form(ARE_TEXTS, 'a list of texts, such as ["q", "p"]'),
    "list of files": Form(ARE_TEXTS, 'the data file(s), such as ["bench.csv"]'),
    "list of effects": Form(ARE_TEXTS, 'names, such as ["coulomb friction on p"]'),
    "list of numbers": Form(_many(is_number), "numbers, such as [0.25, 0.5]"),
    "list of two numbers": Form(IS_SPAN, "two times, first and last: [20, 80]"),
    "mean and deviation": Form(IS_PRIOR, "mean and standard deviation: [40, 2]"),
    "list of pairs": Form(ARE_PAIRS, 'pairs of states, such as [["q", "p"]]'),
    "list of rows": Form(_is(list), "a list of rows, such as [[0, 1], [-1, 0]]"),
    "table": Form(_is(dict), 'a table, such as { unit = "m" }'),
    "list of tables": Form(_many(_is(dict)), "sections [[effects]], with two brackets"),
    "text or table": Form(_is(str, dict), 'text, or a table such as { T = "thermal" }'),
    "parameter": Form(
        _is(int, float, dict),
        "a number, or a table such as { start = 1.0, lower = 0 }",
        "parameters.*",
    ),
    "table of parameters": Form(_is(dict), "a table: { omega = 2.0 }", "parameters"),
    "table of terms": Form(_is(dict), 'a table, such as { lag = "-lag/2" }', "model.F"),
    "formula, term, or list of these": Form(
        ARE_TERMS, 'a formula in quotes, such as "c*dH_dp", or a list of them', "term"
    ),
}
# Lists and tables whose entries come with the data, or are a sum of terms.
COMES_WITH_DATA = (
    *("data.files", "data.columns", "held_out.runs", "final.runs", "parameters"),
    *("model.H", "model.R.*", "model.F.*", "model.sensor.*", "effects.term"),
)
LISTS = ("list of texts", "list of files", "list of effects")  # one text stands for one
NAMED_ANYWAY = ("table", "parameter")  # other sections know these by their names

KEYS = tuple(Key(*row.split(" | ")) for row in TABLE.strip().splitlines())
KEYS_OF: dict[str, dict[str, Key]] = {}  # by their table and name
for _key in KEYS:
    _table, _, _name = _key.path.rpartition(".")
    KEYS_OF.setdefault(_table, {})[_name] = _key


def key_at(path: str) -> Key:
    """The key of a path such as ``"data.time"``."""
    table, _, name = path.rpartition(".")
    return KEYS_OF[table][name]


# ---- what is wrong -------------------------------------------------------------------

Place = tuple[str | int, ...]


class TooManyComplaintsError(Exception):
    """So much is wrong, or so large, that the rest of a file is not looked at."""


def shown(value: Any) -> str:
    """A value as the file has it, cut where it is long."""
    return shortened(toml_value(value), 60)


def key_of(place: Iterable[str | int]) -> str:
    """The key of a place, such as ``"effects[0].name"``."""
    key = ""
    for one in place:
        key += f"[{one}]" if isinstance(one, int) else f".{key_text(one)}"
    return key.removeprefix(".")


@dataclass
class Complaints:
    """What is wrong with a file, in the order in which it was found."""

    content: Mapping[str, Any]  # the tables of the file
    listed: list[Complaint] = field(default_factory=list)  # what is wrong

    @property
    def is_full(self) -> bool:
        """Whether more are noted than a person corrects before the next look."""
        return len(self.listed) >= 100

    def add(self, said: object, *place: str | int, value: Any = None) -> None:
        """Note that what stands at a place cannot be used.

        Args:
            said: what was expected and what to do.
            *place: where it stands; a number counts where there is a list.
            value: the part of it that is meant; None: all of it; "": nothing.
        """
        path: list[str | int] = []
        content: Any = self.content
        for part in place:
            if isinstance(part, int) and not isinstance(content, list):
                continue  # the only entry stands for a list of it
            path.append(part)
            try:
                content = content[part]
            except (KeyError, IndexError, TypeError):
                content = None
        value = content if value is None else value
        written = "" if value in (None, "") else shown(value)
        complaint = Complaint(key_of(path), written, str(said))
        if complaint not in self.listed:
            self.listed.append(complaint)
        if self.is_full:
            raise TooManyComplaintsError

    def need(self, said: str, value: Any, *place: str | int) -> None:
        """Note that nothing stands at a place, where nothing else is wrong with it."""
        if value in (None, "", (), ("",), {}) and not self.about(*place):
            self.add(said, *place, value="")

    @contextmanager
    def noting(self, *place: str | int, value: Any = None) -> Iterator[None]:
        """Note an error as one of a place; what stands behind it is not done."""
        try:
            yield
        except (DataError, ModelError) as error:
            self.add(error, *place, value=value)

    def about(self, *place: str | int) -> bool:
        """Whether something is wrong at a place, or below it."""
        key = key_of(place)
        below = (f"{key}.", f"{key}[")
        keys = [complaint.key for complaint in self.listed]
        return any(one == key or one.startswith(below) for one in keys)

    def exactly_one(
        self,
        content: Mapping[str, Any],
        names: tuple[str, ...],
        *place: str | int,
        proposal: str = "",
    ) -> str:
        """The one of several keys that a table has; "" where it has none or several.

        Args:
            content: what is usable of the table.
            names: the keys.
            *place: of the table.
            proposal: what to write where it has none, as a sentence.
        """
        given = [one for one in names if one in content or self.about(*place, one)]
        if len(given) == 1:
            return given[0]
        both = " and ".join(given) or "none"
        said = f"expected exactly one of {' or '.join(names)}; found {both}."
        self.add(f"{said} {'' if given else proposal}".rstrip(), *place, value="")
        return ""


# ---- what is usable ------------------------------------------------------------------


def usable(
    content: Mapping[str, Any],
    faults: Complaints,
    table: str = "",
    place: Place = (),
) -> dict[str, Any]:
    """The entries that are of the form of their keys; the others are complaints."""
    known = KEYS_OF[table]
    kept: dict[str, Any] = {}
    for name, value in content.items():
        key = known.get(name) or known.get("*")
        if key is None:
            said = f"this key is unknown here; known are {', '.join(known)}."
            faults.add(said + did_you_mean(name, known), *place, name)
        elif isinstance(value, list | dict) and len(value) > key.most:
            said = (
                f"it has {len(value)} entries; at most {key.most} are read. Give fewer."
            )
            faults.add(said, *place, name)
            raise TooManyComplaintsError  # what depends on it would be wrong, too
        elif key.what.fits(value):
            value = listed(value) if key.form in LISTS else value
            kept[name] = _kept(value, key, faults, (*place, name))
        else:
            hint = did_you_mean(value, key.options)
            faults.add(f"expected {key.what.expected}.{hint}", *place, name)
            if key.form in NAMED_ANYWAY and key.path.endswith("*"):
                kept[name] = {}
    return kept


def _kept(value: Any, key: Key, faults: Complaints, place: Place) -> Any:
    """A value with what is usable of its tables; lists of values are tuples."""
    if isinstance(value, list):
        return tuple(
            _kept(one, key, faults, (*place, i)) for i, one in enumerate(value)
        )
    table = key.what.table or key.path
    return usable(value, faults, table, place) if isinstance(value, dict) else value
