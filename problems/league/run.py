"""A league table: public sets under the protocol of those who published them.

    python -m problems.league.run [SET ...] [--data=FOLDER]

Each model is fitted to the training record. A test is one free run over the whole test
record; its starting state is estimated from the first samples alone, and the root mean
square error is counted from there on. "Found" is what a study added to a base model
that lacks what the set is known for; it looks at pieces of the training record only.
A set that is named is run and printed; without names all are run and the page written.
"""

import time
from dataclasses import dataclass

import numpy as np

import phsi_opt as ph
from phsi_opt.simulation.simulate import free_run
from problems.league.entries import LEAGUE, Entry
from problems.tools import provenance
from problems.tools.command_line import chosen
from problems.tools.data_paths import folder, is_present
from problems.tools.pages import render

WAYS = ("base model", "found", "physics written down")


@dataclass(frozen=True)
class Result:
    """A model of a set, fitted and tested.

    Attributes:
        name: of the set.
        way: how the model came about.
        errors: of the tests, by their names, in the entry's unit.
        seconds: of fit and study; of the tests.
        added: effects that a study found.
        fit: of the whole training record.
    """

    name: str
    way: str
    errors: dict[str, float]
    seconds: tuple[float, float]
    added: tuple[str, ...]
    fit: ph.Fit


def error(fit: ph.Fit | ph.Model, test: ph.Measurements, entry: Entry) -> float:
    """Root mean square error of one free run, from the first samples on."""
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


def with_states(data: ph.Measurements, states: tuple[str, ...]) -> ph.Measurements:
    """The same with further states, which nobody measured."""
    runs = data.trajectories
    return ph.Measurements.from_arrays(
        [run.t for run in runs],
        [np.c_[run.x, np.full((run.n_samples, len(states)), np.nan)] for run in runs],
        [run.u for run in runs],
        states=[*data.states, *states],
        inputs=data.inputs,
        hold=data.hold,
    )


def fitted(name: str, way: str, train: ph.Measurements) -> Result:
    """The model of a set that came about in this way, fitted and tested."""
    entry = LEAGUE[name]
    begin = time.process_time()
    added: tuple[str, ...] = ()
    model = entry.physics() if way == WAYS[2] else entry.base()
    if way == WAYS[1]:
        first, second = entry.pieces(train)
        study = ph.Study(model, first, held_out=second)
        study.auto()
        added = tuple(study.history["effect"][1:])
        model = study.model
    hidden = tuple(x for x in model.states if x not in train.states)
    fit = ph.identify(model, with_states(train, hidden))
    middle = time.process_time()
    errors = {}
    for test, data in entry.tests().items():
        errors[test] = error(fit, with_states(data, hidden), entry)
    seconds = (middle - begin, time.process_time() - middle)
    return Result(name, way, errors, seconds, added, fit)


def page(results: list[Result]) -> str:
    """A row per test, and one per fit."""
    rows = []
    for name, entry in LEAGUE.items():
        of_set = [result for result in results if result.name == name]
        for test in of_set[0].errors:
            errors = [f"{result.errors[test]:.3g}" for result in of_set]
            rows.append(
                [name, test, entry.n_first, *errors, entry.published, entry.unit]
            )
    return render("league/pages/league.md", rows=rows, ways=WAYS, results=results)


def main() -> None:
    """Run the sets that are there, print each result, write the page."""
    words = chosen()
    results = []
    for name, entry in LEAGUE.items():
        is_wanted = not words or any(word.lower() in name.lower() for word in words)
        if not is_wanted or not is_present(folder(entry.folder)):
            continue
        train = entry.train()
        for way in WAYS:
            result = fitted(name, way, train)
            print(result, flush=True)
            results.append(result)
    if not words and len(results) == len(WAYS) * len(LEAGUE):
        provenance.write("league.md", page(results))


if __name__ == "__main__":
    main()
