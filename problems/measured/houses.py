"""Two heated houses: heat capacities and resistances from the indoor temperature.

Data: indoor temperature Ti and outdoor temperature Ta (degC), solar gain Ps and heat
delivered Q, every 15 min, six and ten weeks of a winter. One storage:

    C dTi/dt = (Ta - Ti)/R + A Ps + Q

Two storages, the second one (the envelope Te) measured by nobody:

    Ci dTi/dt = (Te - Ti)/Ri + A Ps + Q
    Ce dTe/dt = (Ti - Te)/Ri + (Ta - Te)/Re

Time is in hours and heat in the unit of Q, which the set does not tell. Inputs are held
from sample to sample.

    python -m problems.measured.houses [FOLDER]
"""

from pathlib import Path

import numpy as np
import pandas as pd

import phsi_opt as ph
from problems.tools.data_paths import folder, given, is_present

SAMPLING = 0.25  # h
HOUSES = (1, 3)  # the numbers in the names of the files
INPUTS = ("Ta", "Ps", "Q")
UNITS = {"Ti": "degC", "Ta": "degC", "t": "h"}


def load(path: Path, house: int, n_storages: int = 2) -> ph.Measurements:
    """The record of one house; the envelope is a state that nobody measured."""
    table = pd.read_csv(path / f"blg_{house}.csv", sep=";")
    nobody = np.full((len(table), n_storages - 1), np.nan)
    return ph.Measurements.from_arrays(
        SAMPLING * np.arange(len(table)),
        np.column_stack([table["yTi"], nobody]),
        table[["Ta", "Ps", "Thm"]].to_numpy(),
        states=["Ti", "Te"][:n_storages],
        inputs=INPUTS,
        hold="zero",
        units=UNITS,
    )


def one_storage() -> ph.FirstOrder:
    """Air, furniture and walls as one heat capacity."""
    rate = ph.formula(
        "((Ta - Ti)/R + A*Ps + Q)/C",
        C=_positive(40.0),
        R=_positive(1.0, "degC/Q"),
        A=_positive(10.0),
    )
    return ph.FirstOrder(["Ti"], {"Ti": rate}, inputs=INPUTS)


def two_storages() -> ph.FirstOrder:
    """The indoor air, and the envelope between it and the outdoor air."""
    inner = _positive(0.3, "degC/Q")
    indoor = ph.formula(
        "((Te - Ti)/Ri + A*Ps + Q)/Ci", Ci=_positive(10.0), Ri=inner, A=_positive(10.0)
    )
    envelope = ph.formula(
        "((Ti - Te)/Ri + (Ta - Te)/Re)/Ce",
        Ce=_positive(60.0),
        Ri=inner,
        Re=_positive(0.7, "degC/Q"),
    )
    return ph.FirstOrder(["Ti", "Te"], {"Ti": indoor, "Te": envelope}, inputs=INPUTS)


def _positive(start: float, unit: str = "") -> ph.Parameter:
    return ph.Parameter(start, lower=1e-3, unit=unit)


def main(path: Path) -> dict[str, dict[str, float]]:
    """The fitted values of two storages per house."""
    if not is_present(path):
        return {}
    values = {}
    for house in HOUSES:
        fit = ph.identify(two_storages(), load(path, house))
        print(f"house {house}", fit, f"{fit.seconds:.0f} s", sep="\n", flush=True)
        values[f"house {house}"] = dict(fit.values)
    return values


if __name__ == "__main__":
    main(given(folder("building")))
