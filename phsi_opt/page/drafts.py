"""What a user has filled in so far, before it is checked: texts, as they were typed.

A draft may be wrong; ``study_draft`` writes it as a study file, and reading
that file tells what is wrong. Drafts are the only records of the package that change.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

TIME = "time"
RUN = "run"
STATE = "state"
INPUT = "input"
NOT_USED = "not used"
ROLES = (TIME, RUN, STATE, INPUT, NOT_USED)

NOTHING = "nothing"
SHARE = "the last share"
AFTER = "from a time on"
RUNS = "runs by name"
HELD_OUT_WAYS = (SHARE, AFTER, RUNS, NOTHING)
DEFAULT_SHARE = "0.3"  # of the runs, or of the samples of a single run

ENERGY = "PseudoHamiltonian"
FIRST_ORDER = "FirstOrder"


@dataclass
class ColumnDraft:
    """One column of the table and what it is.

    Attributes:
        column: its header, or its position where there is no header.
        role: one of ``ROLES``.
        name: in formulas, of a state or an input.
        unit: such as "m"; "" where it is unknown.
        noise: standard deviation of a state's noise; "" where it is unknown.
        hold: what an input does between samples; "": as the others.
        examples: its first cells.
        is_numeric: whether it holds numbers; else it can only name runs.
        fits_no_state: a state to the user, which the base model that was chosen last
            has no place for.
    """

    column: str | int
    role: str = NOT_USED
    name: str = ""
    unit: str = ""
    noise: str = ""
    examples: tuple[str, ...] = ()
    is_numeric: bool = True
    fits_no_state: bool = False
    hold: str = ""


@dataclass
class HeldOutDraft:
    """What is kept from fitting, in one of the ``HELD_OUT_WAYS``."""

    way: str = SHARE
    share: str = DEFAULT_SHARE
    after: str = ""
    runs: list[str] = field(default_factory=list)


@dataclass
class DataDraft:
    """The files and their columns.

    Attributes:
        places: where each file lies, by the name that its owner gave it.
        columns: of the table.
        n_samples: lines of numbers, of all files.
        runs: names that the column of runs holds, or those of the files.
        held_out: what is kept from fitting.
        hold: what inputs do between samples.
        unmeasured: units of states that nobody measured.
        step: the time between lines, where no column has the times.
        averaged: how many neighbouring samples become their mean; "" for none.
        further: keys of [data] that the page does not show.
        further_of_time: keys of its time that the page does not show.
    """

    places: dict[str, Path]
    columns: list[ColumnDraft] = field(default_factory=list)
    n_samples: int = 0
    runs: list[str] = field(default_factory=list)
    held_out: HeldOutDraft = field(default_factory=HeldOutDraft)
    hold: str = "linear"
    unmeasured: dict[str, str] = field(default_factory=dict)
    step: str = ""
    averaged: str = ""
    further: dict[str, Any] = field(default_factory=dict)
    further_of_time: dict[str, Any] = field(default_factory=dict)

    @property
    def files(self) -> list[str]:
        """The names of the files, as their owner gave them."""
        return list(self.places)

    def with_role(self, role: str) -> list[ColumnDraft]:
        """The columns of a role."""
        return [column for column in self.columns if column.role == role]

    def column_named(self, role: str, name: str) -> ColumnDraft | None:
        """The column that is a state or an input of this name."""
        for column in self.with_role(role):
            if column.name == name:
                return column
        return None

    def measure(self, role: str, name: str, column: str | None) -> None:
        """Let a column be the state or input of a name; None: no column is."""
        for known in self.columns:
            if known.role == role and known.name == name:
                known.role = NOT_USED
            if column is not None and str(known.column) == column:
                known.role = role
                known.name = name


@dataclass
class ParameterDraft:
    """A number of the formulas.

    Attributes:
        name: in the formulas.
        value: known, or where the search begins; "" where it is found in the data.
        is_known: whether it is not estimated.
        lower: least value; "" for none.
        upper: largest value; "" for none.
        unit: such as "N/m".
        is_assumed: whether a known value is the gallery's, and not the user's.
        further: keys of a study file that the page does not show.
    """

    name: str
    value: str = ""
    is_known: bool = False
    lower: str = ""
    upper: str = ""
    unit: str = ""
    is_assumed: bool = False
    further: dict[str, Any] = field(default_factory=dict)


@dataclass
class ModelDraft:
    """The base model as it is written.

    Attributes:
        title: of the entry of the gallery that it came from; "" where it is written.
        type: ``ENERGY`` or ``FIRST_ORDER``.
        states: names, separated by commas.
        inputs: names, separated by commas.
        pairs: such as "q-p, r-s": dq/dt = dH/dp, dp/dt = -dH/dq.
        H: the energy.
        R: losses by state.
        F: forces by state.
        parameters: in their order.
        further: keys of [model] that the page does not show.
    """

    title: str = ""
    type: str = ENERGY
    states: str = ""
    inputs: str = ""
    pairs: str = ""
    H: str = ""
    R: dict[str, str] = field(default_factory=dict)
    F: dict[str, str] = field(default_factory=dict)
    parameters: list[ParameterDraft] = field(default_factory=list)
    further: dict[str, Any] = field(default_factory=dict)

    @property
    def state_names(self) -> list[str]:
        """The states, each once."""
        return names_in(self.states)

    @property
    def input_names(self) -> list[str]:
        """The inputs, each once."""
        return names_in(self.inputs)


def names_in(text: str) -> list[str]:
    """Names of a text that are separated by commas or spaces, each once."""
    return list(dict.fromkeys(text.replace(",", " ").split()))
