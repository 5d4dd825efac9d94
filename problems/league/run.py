"""A league table: public sets under the protocol of those who published them.

    python -m problems.league.run [SET ...] [--data=FOLDER] [--jobs=N]

Each model is fitted to the training record. A test is one free run over the whole test
record; its starting state is estimated from the first samples alone, and the root mean
square error is counted from there on. "Found" is what a study added to a base model
that lacks what the set is known for; it looks at pieces of the training record only.
A set that is named is run and printed; without names all are run and the page written.
Each result is kept as it comes, in results/league/COMMIT: the same command goes on
where it was interrupted.
"""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

import phsi_opt as ph
from phsi_opt.simulation.simulate import free_run
from problems.league.entries import LEAGUE, Entry
from problems.tools import provenance
from problems.tools.command_line import chosen
from problems.tools.data_paths import folder, is_present
from problems.tools.pages import render
from problems.tools.workers import computed

Result = dict[str, Any]
WAYS = ("base model", "found", "physics written down")


def error(fit: ph.Fit | ph.Model, test: ph.Measurements, entry: Entry) -> float:
    """Root mean square error of one free run, from the first samples on."""
    model = fit if isinstance(fit, ph.Model) else fit.model
    test = with_states(test, model.states)
    (run,) = test.trajectories
    (state,) = test.measured
    column = test.states.index(state)
    measured = run.x[:, column]
    begin = np.flatnonzero(~np.isnan(measured))[entry.n_first]
    below = np.where(run.x < entry.most, run.x, np.nan)  # says nothing of the state
    first = ph.Measurements.from_arrays(
        run.t[:begin],
        below[:begin],
        run.u[:begin],
        states=test.states,
        inputs=test.inputs,
        hold=test.hold,
    )
    begun = ph.compare(fit, first)
    start = begun.simulated[0][0]
    simulated = free_run(begun.model, run.t, start, run.u, test.hold)[:, column]
    misfit = np.minimum(simulated, entry.most) - measured
    return entry.per_unit * float(np.sqrt(np.nanmean(misfit[begin:] ** 2)))


def with_states(data: ph.Measurements, states: Sequence[str]) -> ph.Measurements:
    """The same with the states that nobody measured."""
    hidden = [state for state in states if state not in data.states]
    runs = data.trajectories
    return ph.Measurements.from_arrays(
        [run.t for run in runs],
        [np.c_[run.x, np.full((run.n_samples, len(hidden)), np.nan)] for run in runs],
        [run.u for run in runs],
        states=[*data.states, *hidden],
        inputs=data.inputs,
        hold=data.hold,
    )


def identified(model: ph.Model, train: ph.Measurements) -> ph.Fit:
    """By maximum likelihood."""
    return ph.identify(model, with_states(train, model.states))


def fitted(case: tuple[str, str]) -> Result:
    """The model of a set that came about in a way, fitted and tested.

    A mapping: the errors of the tests by their names, in the entry's unit; the seconds
    of fit and study, and of the tests; effects that a study added; the fit as text; the
    commit.
    """
    name, way = case
    entry = LEAGUE[name]
    train = entry.train()
    begin = time.process_time()
    added: list[str] = []
    model = entry.physics() if way == WAYS[2] else entry.base()
    if way == WAYS[1]:
        model, added = entry.study(model, train)
    fit = (entry.fit or identified)(model, train)
    middle = time.process_time()
    errors = {}
    for test, data in entry.tests().items():
        errors[test] = (entry.error or error)(fit, data, entry)
    seconds = [middle - begin, time.process_time() - middle]
    told = {"errors": errors, "seconds": seconds, "added": added, "fit": str(fit)}
    return {"name": name, "way": way, "commit": provenance.commit(), **told}


def page(results: Sequence[Result]) -> str:
    """A row per test, and one per fit."""
    rows = []
    for name, entry in LEAGUE.items():
        of_set = [result for result in results if result["name"] == name]
        for test in of_set[0]["errors"]:
            errors = [f"{result['errors'][test]:.3g}" for result in of_set]
            rows.append(
                [name, test, entry.n_first, *errors, entry.published, entry.unit]
            )
    return render("league/pages/league.md", rows=rows, ways=WAYS, results=results)


def main() -> None:
    """Run the sets that are there, print each result, write the page."""
    words = chosen()
    cases: dict[str, tuple[str, str]] = {}
    for name, entry in LEAGUE.items():
        is_wanted = not words or any(word.lower() in name.lower() for word in words)
        if is_wanted and is_present(folder(entry.folder)):
            cases |= {f"{name}, {way}": (name, way) for way in WAYS}
    done: dict[str, Result] = {}
    kept = provenance.RESULTS / "league" / provenance.commit()
    for one in computed(fitted, cases, folder=kept):
        done[one.key] = one.result
        print(one.key, one.result["errors"], one.result["added"], flush=True)
        print(one.result["fit"], flush=True)
    if not words and len(done) == len(WAYS) * len(LEAGUE):
        results = [done[key] for key in cases]
        seconds = sum(sum(result["seconds"]) for result in results)
        provenance.write("league.md", page(results), seconds=seconds)


if __name__ == "__main__":
    main()
