"""The published values of the EMPS drive beside the intervals of its fits."""

from dataclasses import dataclass

import phsi_opt as ph
from problems.measured import emps
from problems.tools.data_paths import folder

LEVEL = 0.95  # of the intervals


@dataclass(frozen=True)
class Held:
    """A published value of the EMPS drive beside an interval of a fit."""

    record: str
    parameter: str
    published: float
    value: float
    std_error: float
    lower: float
    upper: float

    @property
    def holds(self) -> bool:
        """Whether the interval holds the published value."""
        return self.lower <= self.published <= self.upper


def held_values() -> list[Held]:
    """Intervals of the whole record and of its windows beside the published values."""
    found = []
    path = folder("emps") / emps.FIT_FILE
    for record, window in emps.LENGTHS.items():
        fit = ph.identify(emps.model(emps.START), emps.load(path, window))
        intervals = fit.intervals(LEVEL)
        for parameter, published in emps.PUBLISHED.items():
            held = Held(
                record,
                parameter,
                published,
                fit.values[parameter],
                fit.std_errors[parameter],
                intervals["ci_lower"].to_dict()[parameter],
                intervals["ci_upper"].to_dict()[parameter],
            )
            found.append(held)
            print(held, "holds" if held.holds else "does not hold", flush=True)
    return found
