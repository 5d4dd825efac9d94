"""How much longer it takes: what is still expected, at the pace so far.

A study says what it is doing, not how long that takes. Each kind of work has a size in
units of the first fit; the sizes are rough, and the pace is that of this machine and
these data, so that the forecast becomes better as the work goes on. It decides nothing.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

# How a line begins that tells of the beginning of such a work.
FITTING = "fitting the base model"
SCREENING = "screening"
WEIGHING = "weighing"
ADDING = "adding"
MISSING = "missing:"  # the verdict of a diagnosis; "nothing missing" is the last one
NOTHING_MISSING = "nothing missing"
# Sizes in units of the first fit: rough means over the demonstration (0.03 to 2 s for
# each unit); single ones differ by a factor of three.
SIZES = {FITTING: 1.0, SCREENING: 1.5, WEIGHING: 1.0, ADDING: 2.0}
EXPECTED_WEIGHED = 4  # effects in a diagnosis, of 1 to 12
# Times its expected length after which a work is said to take longer than expected.
OVERDUE = 1.5
MOST_SAID = 99 * 3600.0  # s; beyond that no forecast is worth saying


@dataclass
class Forecast:
    """The time that is left, from the lines that were said.

    Attributes:
        n_diagnoses: how many diagnoses are expected; the last one finds nothing.
        clock: the time in s.
    """

    n_diagnoses: int
    clock: Callable[[], float] = time.monotonic
    done: float = 0.0
    current: str = ""
    n_screened: int = 0
    n_weighed: int = 0
    began: float = field(init=False)
    current_began: float = field(init=False)

    def __post_init__(self) -> None:
        self.began = self.clock()
        self.current_began = self.began

    def said(self, line: str) -> None:
        """Note a line; most say nothing of the progress."""
        if line.startswith((NOTHING_MISSING, MISSING)):
            self._finish_current()
            self.current = ""
        if line.startswith(NOTHING_MISSING):
            self.n_diagnoses = 0
        for kind in SIZES:
            if line.startswith(kind):
                self._finish_current()
                self.current = kind
                if kind == SCREENING:
                    self.n_screened += 1
                    self.n_weighed = 0
                if kind == WEIGHING:
                    self.n_weighed += 1

    def _finish_current(self) -> None:
        self.done += SIZES.get(self.current, 0.0)
        self.current_began = self.clock()

    @property
    def _pace(self) -> float:
        """Seconds that a unit of the work took so far, the current one left out."""
        return (self.current_began - self.began) / self.done

    @property
    def is_overdue(self) -> bool:
        """Whether the current work takes far longer than others of its kind."""
        if self.done == 0.0 or not self.current:
            return False
        expected = SIZES[self.current] * self._pace
        return self.clock() - self.current_began > OVERDUE * expected

    @property
    def elapsed(self) -> float:
        """Seconds since it began."""
        return self.clock() - self.began

    @property
    def words(self) -> str:
        """How long it takes already, and how much longer where that is known."""
        elapsed = duration(self.elapsed)
        if self.is_overdue:
            return f"{elapsed}, longer than expected"
        left = self.left
        return elapsed if left is None else f"{elapsed}, about {duration(left)} left"

    @property
    def left(self) -> float | None:
        """Seconds that are left, roughly; None where that is not known.

        Before the first fit there is no pace; beside a work that takes longer than
        expected the pace means little.
        """
        if self.done == 0.0 or self.is_overdue:
            return None
        half_done = self.done + SIZES.get(self.current, 0.0) / 2
        remaining = SIZES.get(self.current, 0.0) / 2 + self._expected()
        seconds = remaining * self.elapsed / half_done
        return seconds if seconds < MOST_SAID else None

    def _expected(self) -> float:
        """The size of what is expected after the current work."""
        weighing = SIZES[WEIGHING]
        of_diagnosis = SIZES[SCREENING] + EXPECTED_WEIGHED * weighing
        further = max(self.n_diagnoses - max(self.n_screened, 1), 0)
        expected = further * (of_diagnosis + SIZES[ADDING])
        if self.n_diagnoses and self.current == FITTING:
            expected += of_diagnosis
        if self.current in (SCREENING, WEIGHING):
            expected += max(EXPECTED_WEIGHED - self.n_weighed, 0) * weighing
        if self.current == ADDING and self.n_diagnoses and self.n_screened:
            expected += 0.0 if further else of_diagnosis
        return expected


def duration(seconds: float) -> str:
    """A duration as people read it: 0:07, 12:30, 1:02:03."""
    whole = int(seconds)
    minutes = whole // 60
    if minutes < 60:
        return f"{minutes}:{whole % 60:02d}"
    return f"{minutes // 60}:{minutes % 60:02d}:{whole % 60:02d}"
