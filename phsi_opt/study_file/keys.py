"""Every key of a study file: where it stands, what it holds, what it means.

The reader knows the keys from here, and the reference in docs/command_line.md is tested
against this list.
"""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Key:
    """One key.

    Attributes:
        table: where it stands, such as ``"data.states.*"``; "" at the top.
        name: of the key; ``"*"`` for names of the user's own.
        form: what it holds.
        meaning: what it is for, with the default.
    """

    table: str
    name: str
    form: str
    meaning: str

    @property
    def path(self) -> str:
        """The key as in messages, such as ``"data.time.column"``."""
        return f"{self.table}.{self.name}" if self.table else self.name


CHANNEL = (
    ("column", "text or position", "its header, or its position from 0"),
    ("unit", "text", 'its unit, such as "m"; default: unknown'),
)
TERMS = "formula, term, or list of these"
DEFAULT_MAX_STEPS = 4  # effects: as many as `Study.auto` adds at most unless told


def _keys(table: str, *rows: tuple[str, str, str]) -> tuple[Key, ...]:
    return tuple(Key(table, *row) for row in rows)


KEYS: tuple[Key, ...] = (
    *_keys(
        "",
        ("data", "table", "the measurements: files, columns, units, noise"),
        ("held_out", "table", "what is kept from fitting, to judge by; default: none"),
        ("model", "table", "the base model: states, energy, losses, forces"),
        ("parameters", "table", "the numbers in its formulas"),
        ("effects", "list of tables", "effects of your own, as [[effects]]"),
        ("study", "table", "effects added so far, to consider, to leave out"),
        ("loss", "table", "how to fit; default: maximum likelihood as it is"),
    ),
    *_keys(
        "data",
        (
            "files",
            "text or list of texts",
            "text, .xlsx or .mat, by paths from the study file",
        ),
        ("trajectory", "text", "column that names each line's run; default: no such"),
        (
            "hold",
            '"linear", "zero" or "cubic"',
            "inputs between samples; default linear",
        ),
        ("time", "table", "the column of the times"),
        ("between", "list of two numbers", "times that are used; default: all"),
        ("thinned", "whole number", "so many samples become their mean; default: none"),
        ("sheet", "text", "of a workbook (.xlsx); default: the only one"),
        ("columns", "list of texts", "names, where there is no header"),
        ("separator", "text", "between the cells of a text; default: found"),
        ("decimal", "text", "sign before decimals; default: found"),
        ("states", "table", "a table for each state"),
        ("inputs", "table", "a table for each measured input; default: none"),
    ),
    *_keys(
        "data.time",
        ("column", "text or position", "numbers, dates, or times of day"),
        ("unit", "text", 'such as "s"; dates are read in seconds'),
        ("step", "number", "in place of a column: the time between lines"),
        ("start", "text", "of dates: when t is 0; default: each run's first sample"),
        ("date_format", "text", 'of other dates: "%d.%m.%Y %H:%M"; "": no dates'),
    ),
    *_keys(
        "data.states",
        ("*", "table", "a state, by the name that it has in the formulas"),
    ),
    *_keys(
        "data.states.*",
        *CHANNEL,
        ("measured", "false", "in place of a column: nobody measured it"),
        ("noise", "number", "standard deviation in its unit; default: estimated"),
    ),
    *_keys("data.inputs", ("*", "table", "an input, by its name in the formulas")),
    *_keys("data.inputs.*", *CHANNEL),
    *_keys(
        "held_out",
        ("runs", "list of texts", "names of the runs held out"),
        ("share", "number", "or: the last share of the runs (of one run: in time)"),
        ("after", "number", "or: of every run, what is measured from this time on"),
    ),
    *_keys(
        "model",
        ("type", "text", '"PseudoHamiltonian" (the default) or "FirstOrder"'),
        ("states", "list of texts", "names of the states"),
        ("inputs", "list of texts", "names of the inputs; default: none"),
        ("pairs", "list of pairs", 'such as [["q", "p"]]: dq/dt = dH/dp'),
        ("S", "list of rows", "or: the skew-symmetric structure matrix"),
        ("H", TERMS, "the energy, of the states alone"),
        ("R", "table", "losses R_ii >= 0 by state: dx_i/dt = ... - R_ii dH/dx_i"),
        ("F", "table", "forces by state: of states, inputs, t, efforts dH_dp"),
        ("sensor", "table", "by state, what its sensor adds to it"),
        ("memory", "list of texts", "states that are an effect's memory"),
        ("kind", "text or table", 'such as "thermal", or { T1 = "thermal" }'),
    ),
    *_keys("model.R", ("*", TERMS, "by the name of the state")),
    *_keys("model.F", ("*", TERMS, "by the name of the state")),
    *_keys("model.sensor", ("*", TERMS, "by the name of the state")),
    *_keys("model.kind", ("*", "text", "by the name of the state")),
    *_keys(
        "term",
        ("body", "formula", "one term with a coefficient of its own"),
        ("coefficient", "parameter", "its coefficient; default: free"),
        ("inner", "table of parameters", "the parameters inside the body"),
        ("name", "text", "of the coefficient; default: from the place"),
        ("polynomials", "text or list of texts", "or: all monomials of these names"),
        ("degree", "whole number", "the largest total degree of the monomials"),
        ("constant", "true or false", "whether 1 is one of them; default false"),
        ("trigonometric", "text or list of texts", "or: sines and cosines of these"),
        ("n", "whole number", "pairs of them for each name; default 1"),
        ("frequency", "number", "start in rad per unit; default: scanned"),
    ),
    *_keys(
        "parameters",
        ("*", "number or table", "a number is a known value; a table see below"),
    ),
    *_keys(
        "parameters.*",
        ("start", "number", "where the search begins; default: found in the data"),
        ("value", "number", "in place of start: known, and not estimated"),
        ("lower", "number", "least value; default: none"),
        ("upper", "number", "largest value; default: none"),
        ("unit", "text", 'that is printed, such as "N/m"'),
        ("per_trajectory", "true or false", "a value for each run; default false"),
        ("fixed", "true", "with a guess: it is not estimated once it is found"),
        ("guess", "table", "how a start is found in the data"),
    ),
    *_keys(
        "parameters.*.guess",
        ("kind", "text", '"Scan", "Share" or "Tried"'),
        ("variable", "text", "Scan: what the wave runs along"),
        ("of", "formula", "Share, Tried: what the start is a share of"),
        ("share", "number", "Share: of its root mean square"),
        ("sharper", "list of numbers", "Share: factors by which a corner is sharpened"),
        ("shares", "list of numbers", "Tried: of its largest absolute value"),
        ("most", "number", "Tried: upper bound, as a share"),
    ),
    *_keys(
        "effects",
        ("name", "text", "what it is called"),
        ("slot", "text", '"H", "R", "F" or "sensor"'),
        ("equation", "text", "the state in whose equation it acts"),
        ("term", TERMS, "what it adds there"),
        ("memory", "table of terms", "further states, each with its rate of change"),
        ("family", "text", "its class in words; default: none"),
    ),
    *_keys(
        "study",
        ("added", "list of texts", 'effects added, such as "coulomb friction on p"'),
        ("effects", "list of texts", "those to consider; default: the catalogue"),
        ("without", "list of texts", "those never to consider; default: none"),
        (
            "max_steps",
            "whole number",
            f"effects that --auto adds at most; default {DEFAULT_MAX_STEPS}",
        ),
    ),
    *_keys(
        "loss",
        ("integrator", "text", 'scheme of the defects; default "srk4"'),
        ("steps", "whole number", "intervals between samples; default: as needed"),
        ("huber", "number", "residuals beyond so many deviations count linearly"),
        ("starts", "whole number", "number of starting points; default 1"),
        ("model_error", "true or false", "a random force in the equations"),
    ),
)


def known_keys(table: str) -> Mapping[str, Key]:
    """The keys of a table, by name; the user's own stand under ``"*"``."""
    return {key.name: key for key in KEYS if key.table == table}
