"""Forty fits as they were on one day, and what the present code makes of them.

    python -m problems.judges.fits --check|--freeze [name ...]

With --freeze the references in results/judges/fits.json are written anew. With --check
the present code is compared with them in results/judges/fits.md, and the exit code is 1
where a fit fails, has other terms, or is less likely and farther from the truth of its
own model. A name is the beginning of one in `fit_cases`; then no page is written.

The objective is -log likelihood (its mean square alone is near one whatever the fit, as
the noise is estimated too), for `PHSILoss` its loss without L1. Where the data do not
tell a parameter, objective and predicted states are compared in its place. Two fits of
other steps between samples have other objectives: which of them is nearer to the
optimum of many steps decides.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

import phsi_opt as ph
from problems.judges.cases import Record, keep, kept
from problems.judges.fit_cases import PROBLEMS, Problem
from problems.tools.command_line import chosen, flag
from problems.tools.pages import render
from problems.tools.provenance import write

FILE = "fits.json"
DIGITS = 1e-5  # relative difference of estimates that agree to five digits
NEAR = 0.02  # standard errors, or those of the noise, within which an optimum is one
NEAR_RELATIVE = 1e-3  # the same where there are no standard errors
AS_LIKELY = 1e-3  # of -log likelihood: a distance of 0.04 standard errors
SAME_LOSS = 1e-6  # share of a PHSI loss
EXACT_LOSS = 1e-8  # a PHSI loss below is that of data without noise
LEAST_SIZE = 1e-3  # of the largest estimate: what a smaller one is compared with
N_PREDICTED = 9  # samples of the first trajectory
MANY_STEPS = 24  # between samples: no integration error is left
SAME, NEARBY, OTHER = "same", "same optimum", "another optimum"
TERMS, FAILED, SOLVED = "other terms", "failed", "solved now"
STATUSES = (SAME, NEARBY, OTHER, TERMS, FAILED, SOLVED)
NEW = {"success": False}  # a problem that was not there
BEFORE, NOW = "from many steps, before", "now"
LIKELIER, LIKELY, LESS = "likelier", "as likely", "less likely"


def record(make: Callable[[], Problem]) -> Record:
    """What `identify` makes of a problem."""
    problem = make()
    began = time.process_time()
    try:
        fit = ph.identify(problem.model, problem.data, **problem.options)
        errors = fit.std_errors
    except ph.PhsiOptError as error:
        return {"success": False, "ending": f"{type(error).__name__}: {error}"}
    return {
        "success": fit.outcome.success,
        "ending": fit.outcome.sentence,
        "estimates": fit.estimates,
        "std_errors": {name: errors[name] for name in fit.names},
        "at_bounds": list(fit.outcome.at_bounds),
        "loss": fit.loss,
        "objective": objective(fit),
        "noise": dict(fit.noise),
        "predicted": predicted(fit, problem.data),
        "seconds": round(time.process_time() - began, 2),
    }


def objective(fit: ph.Fit) -> float:
    """-log likelihood, from the information criterion; a PHSI loss as it is."""
    if fit.loss == ph.PHSILoss.__name__:
        return fit.loss_value
    return float(fit.bic - len(fit.names) * np.log(fit.n_values)) / 2


def predicted(fit: ph.Fit, data: ph.Measurements) -> dict[str, list[float]]:
    """Estimated states of the measured channels at a few samples."""
    if not fit.states:
        return {}
    shown = data.trajectories[0].x
    places = np.linspace(0, len(shown) - 1, N_PREDICTED).astype(int)
    found = {}
    for column, name in enumerate(data.states):
        if np.isfinite(shown[:, column]).any():
            own = fit.model.states.index(name)
            found[name] = fit.states[0][places, own].tolist()
    return found


def compared(old: Record, new: Record) -> Record:
    """A row of the table: how far the new record is from the old one."""
    if not (old["success"] and new["success"]):
        status = SAME if old["success"] == new["success"] else SOLVED
        return {"status": FAILED if old["success"] else status}
    if set(old["estimates"]) != set(new["estimates"]):
        return {"objective": likelihood_word(old, new), "status": TERMS}
    row = differences(old, new)
    word = likelihood_word(old, new)
    row["objective change"] = new["objective"] - old["objective"]
    row["objective"] = word
    is_known = np.isfinite(row["in std errors"])
    is_near = (
        row["in std errors"] < NEAR if is_known else row["estimates"] < NEAR_RELATIVE
    )
    if row["estimates"] < DIGITS and row["states"] < NEAR:
        return row | {"status": SAME}
    if word == LIKELY and is_near and row["states"] < NEAR:
        return row | {"status": NEARBY}
    return row | {"status": OTHER}


def distances(make: Callable[[], Problem], old: Record, new: Record) -> Record:
    """How far both records are from the optimum of many steps, in standard errors."""
    problem = make()
    loss = problem.options.get("loss") or ph.MaximumLikelihood()
    options = {**problem.options, "loss": replace(loss, steps=MANY_STEPS)}
    exact = ph.identify(problem.model, problem.data, **options).estimates
    truth = {**old, "estimates": exact}
    found = {}
    for word, one in ((BEFORE, old), (NOW, new)):
        found[word] = differences(truth, one)["in std errors"]
    return found


def differences(old: Record, new: Record) -> Record:
    """Largest differences of what the data tell: relative, in standard errors, of those
    (relative), of the states (in the noise).
    """
    names = identifiable(old)
    before, after = (_array(one["estimates"], names) for one in (old, new))
    errors, new_errors = (_array(one["std_errors"], names) for one in (old, new))
    change = np.abs(after - before)
    largest = max((abs(value) for value in old["estimates"].values()), default=0.0)
    sizes = np.fmax(np.fmax(np.abs(before), errors), LEAST_SIZE * largest)
    states = [0.0]
    for name, values in old["predicted"].items():
        moved = np.subtract(new["predicted"][name], values)
        states.append(float(np.max(np.abs(moved))) / old["noise"][name])
    return {
        "estimates": _largest(change / sizes, 0.0),
        "in std errors": _largest(change / errors, np.nan),
        "std errors": _largest(np.abs(new_errors / errors - 1), np.nan),
        "states": max(states),
    }


def identifiable(old: Record) -> list[str]:
    """Estimates that the data tell: with a standard error, or at a bound; all of a loss
    that has no standard errors.
    """
    if not old["predicted"]:
        return list(old["estimates"])
    errors = old["std_errors"]
    return [
        name for name in errors if np.isfinite(errors[name]) or name in old["at_bounds"]
    ]


def likelihood_word(old: Record, new: Record) -> str:
    """Whether the new record is likelier than the old one."""
    limit = AS_LIKELY
    if old["loss"] == ph.PHSILoss.__name__:
        limit = SAME_LOSS * max(old["objective"], EXACT_LOSS)
    change = new["objective"] - old["objective"]
    if abs(change) <= limit:
        return LIKELY
    return LIKELIER if change < 0 else LESS


def _array(values: Mapping[str, float], names: list[str]) -> np.ndarray:
    return np.array([values[name] for name in names], dtype=float)


def _largest(values: np.ndarray, otherwise: float) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else otherwise


def is_worse(row: Record) -> bool:
    """Whether a change of the code has spoilt a fit."""
    if row["status"] in (FAILED, TERMS):
        return True
    is_less = row["status"] == OTHER and row["objective"] == LESS
    return is_less and not row.get(NOW, np.inf) <= row.get(BEFORE, 0.0) + NEAR


def main() -> int:
    """Freeze the fits, or compare with them; how many are worse."""
    if flag("check") == flag("freeze"):
        raise SystemExit(__doc__)
    starts = tuple(chosen())
    references = kept(FILE)
    rows = []
    for name, make in PROBLEMS.items():
        if starts and not name.startswith(starts):
            continue
        found = record(make)
        print(f"{name}: {found['ending']}, {found.get('seconds', 0):g} s", flush=True)
        if flag("check"):
            old = references.get(name, NEW)
            row = {"fit": name, **compared(old, found)}
            if row["status"] == OTHER:
                row |= distances(make, old, found)
            rows.append(row)
        else:
            references[name] = found
    if not flag("check"):
        keep(FILE, references)
        return 0
    n_worse = sum(map(is_worse, rows))
    text = page(rows, n_worse)
    print(text)
    if not starts:
        write("judges/fits.md", text)
    return n_worse


def page(rows: list[Record], n_worse: int) -> str:
    """The table, with what it says."""
    counts = Counter(row["status"] for row in rows)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    shown = [{key: _shown(row.get(key, "")) for key in columns} for row in rows]
    return render(
        "judges/pages/fits.md",
        table=shown,
        counts=[f"{status}: {counts[status]}" for status in STATUSES],
        n_worse=n_worse,
        digits=DIGITS,
        near=NEAR,
        many_steps=MANY_STEPS,
    )


def _shown(value: object) -> object:
    return f"{value:.1e}" if isinstance(value, float) else value


if __name__ == "__main__":
    raise SystemExit(main() > 0)
