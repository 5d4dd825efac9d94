"""Drawn wrong arguments and damaged files: errors of the package, and nothing misread.

    python -m problems.benchmarks.fuzz --inputs=20000 --seed=64001 [--folder=F] [ENTRY]

Every public function, record and method gets inputs that Hypothesis draws from a seed;
pages take 36000 and more, and faults are looked for with others. They are usual
arguments, of which one or two are replaced by others of the annotated type, or a part
of which by anything; before, every argument in turn is each of some hundred odd values.
So are tables, and study files and fits of which bytes, cells or keys are replaced;
long texts that repeat a few letters; workbooks, MATLAB, MDF and TDMS files of which
bits, sizes or parts are changed, some with formulas that would run a command.
Foreign is an exception or warning that is not the package's own (but those of numbers
that overflow, and Python's of a call that lacks an argument); silent is an input that
was taken with another meaning; slow one that took more than 20 s of the processor, its
children's too; ran one after which a file was there that only a command makes. The
folder keeps what is done.
"""

import contextlib
import inspect
import json
import math
import os
import re
import tomllib
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from numbers import Number
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pandas as pd
import tomlkit
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

import phsi_opt as ph
from phsi_opt.data.table_readers import TableWords
from phsi_opt.study_file.survey import survey
from problems.benchmarks.fuzz_files import (
    broken,
    mat_files,
    mdf_files,
    tables_with_texts,
    tdms_files,
    workbook,
    workbooks,
)
from problems.benchmarks.fuzz_inputs import (
    CELLS,
    FOLDER,
    FORMULAS,
    LAWS,
    MARKER,
    ODD,
    TABLE,
    Arguments,
    Draw,
    changed,
    damaged,
    each_odd,
    fitted,
    measured,
    places,
    replaced,
    spring,
    usual,
)
from problems.benchmarks.stress import Row, collected
from problems.tools import provenance
from problems.tools.command_line import chosen, option
from problems.tools.pages import render

MATHEMATICAL = (
    "overflow",
    "invalid value",
    "divide by zero",
    ".*masked element to nan",
)
OUTCOMES = ("accepted", "refused", "foreign", "silent")
FAULTS = ("slow", "ran")
SLOW = 20.0  # s of the processor

# ---- public entries, by their annotations --------------------------------------------


@dataclass(frozen=True)
class Target:
    """What is tried: inputs, what is done with each, and whether it was understood."""

    inputs: Draw
    call: Callable[[Any], Any]
    is_meant: Callable[[Any, Any], bool] = lambda given, result: True
    # Inputs that are tried before those that are drawn.
    each: Callable[[], Iterable[Any]] = tuple


# made by the package, not by its user
RESULTS = {
    "BlockDiagram",
    "Bootstrap",
    "Candidate",
    "Comparison",
    "Diagnosis",
    "Finding",
    "Fit",
    "Identifiability",
    "Prediction",
    "Profile",
}
RESULTS |= {"Complaint", "Verdict", "Model", "StudyFile"}
# for other rooms of the package; pictures; and readers that are tried with files below
INNER = {"built", "with_parameters", "rhs_slopes", "from_content", "index"}
INNER |= {"terms_at", "placed_at"}
INNER |= {"trajectory_number", "from_tables", "function", "chart", "sympy"}
INNER |= {"from_excel", "from_mat", "from_mdf", "from_tdms", "load"}
INNER |= {"from_hdf5", "from_parquet", "from_bag"}
# Each of these files is read in a process of its own, for up to a second and a half.
BINARY = (
    "Measurements.from_mdf, bytes",
    "Measurements.from_tdms, bytes",
    "Measurements.from_mat, bytes",
    "Measurements.from_excel, parts",
)
# The share of inputs that others get: these take long, or have many ways to go wrong.
SHARES = {
    **dict.fromkeys(["profile", "bootstrap", "diagnose", "Study", "sweep"], 0.05),
    **dict.fromkeys(["simulate", "Model.add", "identify, own law"], 0.1),
    **dict.fromkeys(["Model.with_values", "Model.with_free", "Model.with_fixed"], 0.2),
    **dict.fromkeys(["Model.with_upper", "Model.without", "Fit.model_of"], 0.2),
    **dict.fromkeys(["catalogue", "compare", "identify", "Fit.export"], 0.1),
    **dict.fromkeys(["StudyFile.of", "StudyFile.read, keys"], 0.3),
    **dict.fromkeys(["StudyFile.read, bytes", "Measurements.from_excel, cells"], 0.4),
    **dict.fromkeys(["PseudoHamiltonian", "FirstOrder", "mechanical"], 0.4),
    **dict.fromkeys(["formula, text", "Fit.load, keys", "Fit.load, bytes"], 3.0),
    **dict.fromkeys(["Measurements.from_arrays", "Measurements.from_csv, cells"], 3.0),
    **dict.fromkeys(BINARY, 0.5),
}


def public() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Every public function, record and method that takes arguments, by its name."""
    for name in ph.__all__:
        one = getattr(ph, name)
        is_error = isinstance(one, type) and issubclass(one, Exception)
        if callable(one) and not is_error and name not in RESULTS:
            yield name, one
    yield "StudyFile.of", ph.StudyFile.of
    owners = {"Measurements": measured(), "Model": spring(), "Fit": fitted()}
    for owner, thing in owners.items():
        for name, method in inspect.getmembers(thing, inspect.ismethod):
            if not name.startswith(("_", "plot")) and name not in INNER:
                yield f"{owner}.{name}", method


def arguments_of(name: str, call: Callable[..., Any]) -> tuple[Arguments, Arguments]:
    """The usual arguments of an entry, and their types."""
    values: Arguments = {}
    written = call.__init__ if isinstance(call, type) else call  # type: ignore[misc]
    hints = get_type_hints(written, localns={"pd": pd})
    hints.pop("return", None)
    for one in inspect.signature(call).parameters.values():
        known = one.name
        if one.kind == one.VAR_POSITIONAL:
            known = f"*{one.name}"
            hints[known] = list[hints.pop(one.name)]  # type: ignore[misc]
        elif one.kind == one.VAR_KEYWORD:
            of_words = hints.pop(one.name)
            is_reader = get_args(of_words) == (TableWords,)
            further = get_type_hints(TableWords) if is_reader else {"k": of_words}
            hints |= further
            for word in further:
                default = 2.0 if word == "k" else usual().get(word)
                values[word] = usual().get(f"{name}.{word}", default)
            continue
        default = None if one.default is one.empty else one.default
        default = usual().get(known, default)
        value = usual().get(f"{name}.{known}", default)
        if repr(value) != "<factory>":
            values[known] = value
    values.pop("progress", None)  # the errors are its own
    return values, {known: hints.get(known, Any) for known in values}


def used(call: Callable[..., Any], arguments: Arguments) -> Any:
    """The result of a call, which can be shown, and a model can be worked with."""
    words = {name: one for name, one in arguments.items() if name[0] != "*"}
    first = [one for name, one in arguments.items() if name[0] == "*"]
    listed = first and (first[0] if isinstance(first[0], list) else first)
    if call == ph.Measurements.from_dataframe:
        words["frame"] = framed(words["frame"])
    result = call(*listed, **words)
    if call == ph.sweep:
        return list(result)
    if isinstance(result, ph.Model):
        result.rhs()
        ph.catalogue(result)
    if isinstance(result, ph.StudyFile):
        result.text()
    if isinstance(result, ph.HeldOut):
        result.split(measured())
    if not isinstance(result, np.ndarray):
        _ = str(result), repr(result)
    return result


def each_replaced(values: Arguments, is_deep: bool) -> Iterator[Arguments]:
    """Usual arguments, each in turn, or each part, replaced by every odd value."""
    for path in places(values):
        for odd in each_odd() if is_deep or len(path) == 1 else ():
            yield replaced(values, path, odd)


def framed(columns: Any) -> Any:
    """A data frame of the columns, with cells as they are."""
    if not isinstance(columns, dict):
        return columns
    try:
        return pd.DataFrame(
            {
                name: pd.Series(
                    cells, dtype=object if isinstance(cells, list) else None
                )
                for name, cells in columns.items()
            }
        )
    except Exception:  # of pandas: no data frame can be made of this
        raise ph.DataError("no data frame") from None


def exact(value: Any) -> float | None:
    """A number as the float it is; None where it is no real number."""
    is_number = isinstance(value, Number | np.bool_)
    is_complex = isinstance(value, complex | np.complexfloating)
    try:
        return float(value) if is_number and not is_complex else None
    except (TypeError, ValueError, OverflowError):
        return None


def is_same(given_value: Any, kept: Any) -> bool:
    """Whether a setting is kept as it was given: one number or text for another."""
    are_bools = [isinstance(one, bool | np.bool_) for one in (given_value, kept)]
    if any(are_bools):
        return all(are_bools) and bool(given_value) == bool(kept)
    if isinstance(given_value, Number) and isinstance(kept, Number):
        number = exact(given_value)  # as near as a float is
        return kept in (given_value, number) or number != number
    return isinstance(given_value, str) and given_value == kept


def is_kept(given_arguments: Arguments, result: Any) -> bool:
    """Whether what was given is in the result: settings, and the numbers of arrays."""
    if isinstance(result, ph.Measurements) and "t" in given_arguments:
        return are_exact(given_arguments, result)
    for name, value in given_arguments.items():
        kept = getattr(result, name, None)
        is_derived = name == "measured"  # False without a column
        are_plain = isinstance(value, PLAIN_TYPES) and isinstance(kept, PLAIN_TYPES)
        are_plain = are_plain and not is_derived
        if are_plain and not is_same(value, kept):
            return False
    return True


PLAIN_TYPES = (Number, str, np.bool_)


def are_exact(given_arguments: Arguments, result: ph.Measurements) -> bool:
    """Whether lists of numbers were taken as they are."""
    (run, *others) = result.trajectories
    for name in ("t", "x", "u"):
        rows = given_arguments.get(name)
        if others or not isinstance(rows, list):
            continue
        cells = [one for row in rows for one in (row if np.ndim(row) else [row])]
        kept = getattr(run, name).ravel().tolist()
        for cell, number in zip(cells, kept, strict=len(cells) == len(kept)):
            if cell is None or cell is pd.NA or cell is np.ma.masked:
                continue
            expected = exact(cell.item() if isinstance(cell, np.ndarray) else cell)
            if expected is None or (expected != number and expected == expected):
                return False
    return True


# ---- texts and files -----------------------------------------------------------------

QUOTED = re.compile(r'^"((?:[^"]|"")*)"')
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
EXAMPLE = Path(ph.__file__).parent / "study_file" / "examples" / "spring"
STUDY = (EXAMPLE / "study.toml").read_bytes()
COLUMNS: Arguments = {"time": "t", "states": ["q"]}
BOTH: Arguments = {"time": "t", "states": ["q", "p"], "decimal": "."}
LOGGED: Arguments = {"time": "time", "states": ["q"], "inputs": ["u"]}


def model_of(text: str) -> ph.PseudoHamiltonian:
    """A model with the text as its force."""
    force = {"p": ph.formula(text, k=1.0) if "k" in text else text}
    model = ph.PseudoHamiltonian(
        states=["q", "p"], inputs=["u"], S=ph.canonical(1), H="q**2/2 + p**2/2", F=force
    )
    model.rhs()
    _ = str(model)
    return model


def fit_of(law: Arguments) -> ph.Fit:
    """A fit of a force of the user's own, whose inner parameter is as given."""
    lower, start = sorted((law["lower"], law["start"]))
    inner = ph.Parameter(start, lower=lower)
    force = ph.formula(law["text"], c=ph.Parameter(law["size"]), w=inner)
    model = spring().add(ph.Effect("own", "F", "p", force))
    return ph.identify(model, measured(), law["loss"])


def in_file(name: str, read: Callable[[Path], Any]) -> Callable[[bytes], Any]:
    """Reads bytes from a file of the name."""

    def call(content: bytes) -> Any:
        path = Path(FOLDER.name, name)
        path.write_bytes(content)
        return read(path)

    return call


def made(write: Callable[[Any], bytes], read: Callable[[bytes], Any]) -> Any:
    """Reads what a library writes of a value; what it cannot write does not count."""

    def call(value: Any) -> Any:
        try:
            content = write(value)
        except Exception:
            raise ph.DataError("this cannot be written") from None
        return read(content)

    return call


def workbook_with(value: Any) -> bytes:
    """A workbook with a cell of the value."""
    return workbook([["t", "q", "p"], [0, 1.5, 2], [1, value, 3], [2, 4.5, 5]])


def cell_is_meant(cell: Any, result: ph.Measurements) -> bool:
    """Whether the cell in the second row was taken as what it is, or as missing."""
    x = result.stacked("x")
    if len(x) != 3 or x[0].tolist() != [1.5, 2] or x[2].tolist() != [4.5, 5]:
        return False
    number = float(x[1, 0])
    if not isinstance(cell, str):
        expected = exact(cell)  # a workbook has 16 digits, and no infinite number
        is_missing = expected is None or not math.isfinite(expected)
        is_near = math.isclose(expected or 0.0, number, rel_tol=1e-14)
        return math.isnan(number) if is_missing else is_near
    # What follows a quoted part belongs to the cell, as in every reader of CSV.
    bare = QUOTED.sub(lambda one: one[1].replace('""', '"'), cell.strip()).strip()
    if math.isnan(number):
        return bare.lower() in ("", "nan", "na", "n/a")
    grouped = re.sub(r"(?<=\d)[,' \u00a0](?=\d{3})", "", bare)  # 1,000 with a point
    return any(float(one) == number for one in (bare, grouped) if NUMBER.fullmatch(one))


def load_fit(path: Path) -> ph.Fit:
    """A fit that can be shown."""
    fit = ph.Fit.load(path)
    _ = str(fit), fit.parameters, fit.std_errors, fit.equations()
    return fit


def read_study(path: Path) -> ph.StudyFile:
    """A study file with its model and parts."""
    study = ph.StudyFile.read(path)
    study.model()
    study.split()
    return study


def study_is_meant(content: Any, study: ph.StudyFile) -> bool:
    """Whether its settings are those that the file says."""
    steps = content.get("study", {})
    held_out = content.get("held_out", {})
    kept = study.held_out
    return (
        steps.get("max_steps", 4) == study.steps.max_steps
        and steps.get("title", "") == study.steps.title
        and (not held_out or held_out.get("share") == (kept and kept.share))
        and content["data"].get("hold", "linear") == study.data.hold
    )


def encoded(text: str) -> bytes:
    """A text in UTF-8, also what is no text there."""
    return text.encode("utf-8", "surrogatepass")


def read_table(path: Path) -> ph.Measurements:
    """A table whose columns are looked at, as `init` does, and read."""
    _ = str(survey(path))
    return ph.Measurements.from_csv(path, **COLUMNS)


def read_path(path: Any) -> None:
    """Every reader is given the path; none is a file of its kind."""
    readers: list[Any] = [ph.Fit.load, ph.StudyFile.read]
    for read in [partial(ph.Measurements.from_csv, **COLUMNS), *readers]:
        try:
            read(path)
        except ph.PhsiOptError:
            continue
        return
    raise ph.DataError("by all of them")


def targets() -> dict[str, Target]:
    """Every entry by its name."""
    found = {}
    for name, call in public():
        values, hints = arguments_of(name, call)
        if values:
            inputs = changed(values, hints=hints)
            is_deep = SHARES.get(name, 1.0) >= 1  # others take long
            each = partial(each_replaced, values, is_deep)
            found[name] = Target(inputs, partial(used, call), is_kept, each)
    saved = json.loads(json.dumps(fitted().content()))
    m = ph.Measurements
    in_fit = in_file("fit.json", load_fit)
    in_study = in_file("study.toml", read_study)
    in_csv = in_file("cell.csv", partial(m.from_csv, separator=";", **BOTH))
    in_book = in_file("cell.xlsx", partial(m.from_excel, **BOTH))
    in_table = in_file("t.csv", partial(m.from_csv, **COLUMNS))
    in_mat = in_file("t.mat", partial(m.from_mat, **COLUMNS))
    in_mdf = in_file("t.mf4", partial(m.from_mdf, **LOGGED))
    in_tdms = in_file("t.tdms", partial(m.from_tdms, **LOGGED))
    in_texts = in_file("texts.csv", read_table)
    paths = st.text(max_size=9).map(lambda name: f"{FOLDER.name}/{name}")
    toml = partial(made, lambda one: encoded(tomlkit.dumps(one)))
    fit_json = made(lambda one: json.dumps(one, default=str).encode(), in_fit)
    rows = made(lambda one: f"t;q;p\n0;1.5;2\n1;{one};3\n2;4.5;5\n".encode(), in_csv)
    return found | {
        "formula, text": Target(FORMULAS, model_of),
        "identify, own law": Target(LAWS, fit_of),
        "Measurements.from_csv, cells": Target(CELLS, rows, cell_is_meant),
        "Measurements.from_csv, bytes": Target(damaged(TABLE), in_table),
        "Measurements.from_excel, cells": Target(
            st.one_of(ODD, CELLS), made(workbook_with, in_book), cell_is_meant
        ),
        "Measurements.from_csv, texts": Target(
            tables_with_texts(), made(encoded, in_texts)
        ),
        "Measurements.from_excel, parts": Target(
            workbooks(), in_file("t.xlsx", partial(m.from_excel, **COLUMNS))
        ),
        "Measurements.from_mat, bytes": Target(broken(mat_files), in_mat),
        "Measurements.from_mdf, bytes": Target(broken(mdf_files), in_mdf),
        "Measurements.from_tdms, bytes": Target(broken(tdms_files), in_tdms),
        "Fit.load, bytes": Target(damaged(json.dumps(saved).encode()), in_fit),
        "Fit.load, keys": Target(changed(saved), fit_json),
        "StudyFile.read, bytes": Target(damaged(STUDY), in_study),
        "StudyFile.read, keys": Target(
            changed(tomllib.loads(STUDY.decode())), toml(in_study), study_is_meant
        ),
        "paths": Target(st.one_of(ODD, paths), read_path),
    }


# ---- what became of them -------------------------------------------------------------


@dataclass
class Tally:
    """What became of the inputs of an entry."""

    counts: Counter[str] = field(default_factory=Counter)
    faults: dict[str, str] = field(default_factory=dict)  # kind -> the first input
    seconds: float = 0.0
    slowest: float = 0.0


def tried(target: Target, given_input: Any, tally: Tally) -> None:
    """Try one input, and count what became of it."""
    begin = processor_time()
    outcome = "accepted"
    fault = ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for told in MATHEMATICAL:
                warnings.filterwarnings("ignore", told)
            result = target.call(given_input)
            if not target.is_meant(given_input, result):
                outcome = fault = "silent"
    except ph.PhsiOptError as error:
        outcome = "refused" if str(error) else "foreign"
    except Exception as error:
        outcome = "foreign"
        frames = traceback.extract_tb(error.__traceback__)
        own = [one for one in frames if "phsi_opt/" in one.filename] or frames
        place = f"{Path(own[-1].filename).name}:{own[-1].lineno}"
        fault = f"{type(error).__name__} in {place}: {str(error)[:60]}"
    seconds = processor_time() - begin
    tally.counts[outcome] += 1
    tally.seconds += seconds
    tally.slowest = max(tally.slowest, seconds)
    faults = {fault: bool(fault), "slow": seconds > SLOW, "ran": MARKER.exists()}
    for kind in FAULTS:
        tally.counts[kind] += faults[kind]
    MARKER.unlink(missing_ok=True)
    for kind in filter(faults.__getitem__, faults):
        tally.faults.setdefault(kind, shown(given_input))


def processor_time() -> float:
    """Seconds of this process and of its children that have ended."""
    return sum(os.times()[:4])


def shown(value: Any) -> str:
    """An input in one line, cut."""
    try:
        text = "".join(repr(value)[:2000].split("\n"))
    except Exception:  # such as of a number of 5000 digits
        return "what cannot be shown"
    text = re.sub(r"(.)\1{30,}", r"\1...", text)
    return text[:400].encode("ascii", "backslashreplace").decode()


def fuzzed(
    target: Target, n_inputs: int, first_seed: int = 1, first: Iterable[Any] = ()
) -> Tally:
    """So many inputs of a target after the first, the same in every run with a seed."""
    tally = Tally()

    @seed(first_seed)
    @settings(
        max_examples=max(n_inputs, 1),
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(target.inputs)
    def run(given_input: Any) -> None:
        tried(target, given_input, tally)

    header, *rows = (EXAMPLE / "friction_spring.csv").read_text().splitlines()
    short = "\n".join([header, *rows[::20]])
    Path(FOLDER.name, "friction_spring.csv").write_text(short)
    with contextlib.chdir(FOLDER.name):  # what is written goes there
        for one in first:
            tried(target, one, tally)
        run()
    return tally


def fuzzed_entry(case: tuple[str, int, int]) -> Arguments:
    """What became of the inputs of an entry, as it is kept in a folder."""
    name, n_inputs, first_seed = case
    target = targets()[name]
    tally = fuzzed(target, n_inputs, first_seed, target.each())
    counts = {outcome: tally.counts[outcome] for outcome in (*OUTCOMES, *FAULTS)}
    n_tried = sum(counts[outcome] for outcome in OUTCOMES)
    times = {"seconds": tally.seconds, "slowest": tally.slowest}
    return {"inputs": n_tried, **counts, **times, "faults": tally.faults}


def page(rows: pd.DataFrame) -> str:
    """A row per entry, and all of them together."""
    faults = []
    for entry, found in zip(rows["entry"], rows["faults"], strict=True):
        faults += [{"entry": entry, "fault": fault} for fault in found]
    shown = rows.drop(columns="faults")
    total = {name: shown[name].sum() for name in shown.columns[1:]}
    total["slowest"] = shown["slowest"].max()
    shown.loc[len(shown)] = {"entry": "all", **total}
    shown["seconds"] = shown["seconds"].map("{:.1f}".format)
    shown["slowest"] = shown["slowest"].map("{:.2f}".format)
    return render(
        "benchmarks/pages/fuzz.md",
        rows=shown,
        all=shown.iloc[-1],
        faults=faults,
        n_odd=len(list(each_odd())),
    )


def fuzzed_entries() -> Iterator[Row]:
    """Try every entry, or those that are named."""
    n_inputs = int(option("inputs", "20000"))
    first_seed = int(option("seed", "36000"))
    names = [name for name in targets() if not chosen() or name in chosen()]
    total = sum(SHARES.get(name, 1.0) for name in names)
    cases = {}
    for name in names:
        share = SHARES.get(name, 1.0) / total
        cases[name] = (name, math.ceil(n_inputs * share), first_seed)
    folder = option("folder", "") or None
    of = f"{provenance.commit()} {n_inputs} {first_seed}"
    with ProcessPoolExecutor(1) as alone:
        for one in ph.sweep(fuzzed_entry, cases, executor=alone, folder=folder, of=of):
            yield {"entry": one.key, **one.result}


if __name__ == "__main__":
    found = collected(fuzzed_entries())
    if not chosen():
        provenance.write("fuzz.md", page(found), seconds=found["seconds"].sum())
