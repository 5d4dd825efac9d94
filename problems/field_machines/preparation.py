"""The same case from a record that was prepared in another way.

A diagnosis should not depend on when a clock began, on every other sample, or on which
run is held out.
"""

from dataclasses import dataclass

import numpy as np

import phsi_opt as ph
from phsi_opt.data.trajectory import Trajectory
from problems.field_machines.cases import draw
from problems.field_machines.examination import REASON_LENGTH, Found, asked
from problems.field_machines.findings import as_text
from problems.field_machines.kinds import Kind
from problems.field_machines.records import Array
from problems.tools.provenance import commit

# Clocks begin up to so many lengths of a run late.
LATEST = 5.0
PREPARED = ("as_drawn", "shifted", "thinned", "exchanged")


@dataclass(frozen=True, eq=False)
class Split:
    """Training runs and those held out."""

    train: ph.Measurements
    test: ph.Measurements


@dataclass(frozen=True, eq=False)
class Run:
    """One trajectory: times (n_samples,), states (n_samples, n_states), inputs."""

    t: Array
    x: Array
    u: Array
    name: str

    @classmethod
    def of(cls, trajectory: Trajectory) -> "Run":
        """A trajectory as it is."""
        return cls(trajectory.t, trajectory.x, trajectory.u, trajectory.name)


def examine_prepared(kind: Kind, seed: int) -> Found:
    """What a study finds in each preparation of a case, and whether it is the same."""
    record: Found = {
        "kind": kind.name,
        "seed": seed,
        "outcome": "examined",
        "commit": commit(),
    }
    try:
        case = draw(kind, seed)
        for name, split in prepared(Split(case.train, case.test), seed).items():
            said = asked(case.model, split.train, split.test)
            record[name] = as_text(said.findings)
    except Exception as error:
        reason = str(error)[:REASON_LENGTH]
        return record | {"outcome": f"{type(error).__name__}: {reason}"}
    record["same"] = len({record[name] for name in PREPARED}) == 1
    return record


def prepared(split: Split, seed: int) -> dict[str, Split]:
    """The preparations of a case, by name."""
    rng = np.random.default_rng(seed)
    shifted = Split(_shifted(split.train, rng), _shifted(split.test, rng))
    thinned = Split(_thinned(split.train), _thinned(split.test))
    return dict(
        zip(PREPARED, (split, shifted, thinned, _exchanged(split)), strict=True)
    )


def _shifted(data: ph.Measurements, rng: np.random.Generator) -> ph.Measurements:
    """Every clock begins at another time."""
    runs = []
    for run in data.trajectories:
        late = rng.uniform(0.0, LATEST) * (run.t[-1] - run.t[0])
        runs.append(Run(run.t + late, run.x, run.u, run.name))
    return _measurements(data, runs)


def _thinned(data: ph.Measurements) -> ph.Measurements:
    """Every other sample."""
    runs = []
    for run in data.trajectories:
        runs.append(Run(run.t[::2], run.x[::2], run.u[::2], run.name))
    return _measurements(data, runs)


def _exchanged(split: Split) -> Split:
    """The first run held out is for training in place of the first one there."""
    train = [Run.of(run) for run in split.train.trajectories]
    test = [Run.of(run) for run in split.test.trajectories]
    first = train[0]
    train[0] = test[0]
    test[0] = first
    return Split(_measurements(split.train, train), _measurements(split.test, test))


def _measurements(data: ph.Measurements, runs: list[Run]) -> ph.Measurements:
    return ph.Measurements.from_arrays(
        [run.t for run in runs],
        [run.x for run in runs],
        [run.u for run in runs] if data.inputs else None,
        states=data.states,
        inputs=list(data.inputs) or None,
        hold=data.hold,
        names=[run.name for run in runs],
    )
