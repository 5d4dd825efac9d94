"""How much longer a study takes, at the pace so far.

Each kind of work has a size in units of the first fit; the sizes are rough, and the
pace is that of this machine and these data, so that the forecast becomes better as the
work goes on. It decides nothing.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

# How a line of progress begins that says that such a work begins.
FITTING = "fitting the base model"
SCREENING = "screening"
WEIGHING = "computing the evidence of"
ADDING = "adding"
NOTHING_MISSING = "nothing missing"
# Sizes in units of the first fit: rough means over the demonstration (0.03 to 2 s for
# each unit); single ones differ by a factor of three.
SIZES = {FITTING: 1.0, SCREENING: 1.5, WEIGHING: 1.0, ADDING: 2.0}
DIAGNOSIS = (SCREENING, *[WEIGHING] * 4)  # 1 to 12 effects are weighed


@dataclass
class Forecast:
    """The time that is left, from the lines of progress.

    Attributes:
        n_diagnoses: how many diagnoses are expected; the last one finds nothing.
        clock: the time in s.
    """

    n_diagnoses: int
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._began = self._current_began = self.clock()
        self._done = 0.0  # size of the work that is done
        self._current = ""  # kind of the present work
        # The kinds of work that are expected after it.
        self._plan = ([*DIAGNOSIS, ADDING] * self.n_diagnoses)[:-1]

    def said(self, line: str) -> None:
        """Note a line; most say nothing of the progress."""
        kind = next(filter(line.startswith, (NOTHING_MISSING, *SIZES)), None)
        if kind is None:
            return
        self._done += SIZES.get(self._current, 0.0)
        self._current = kind
        self._current_began = self.clock()
        plan = self._plan
        if kind == NOTHING_MISSING:
            self._plan = []  # the last diagnosis
        elif kind == ADDING and self.n_diagnoses and SCREENING not in plan:
            self._plan = list(DIAGNOSIS)  # one more than was expected
        elif kind in plan and (kind != WEIGHING or plan[0] == WEIGHING):
            self._plan = plan[plan.index(kind) + 1 :]

    @property
    def is_overdue(self) -> bool:
        """Whether the current work takes far longer than others of its kind."""
        if self._done == 0.0 or self._current not in SIZES:
            return False
        pace = (self._current_began - self._began) / self._done
        expected = SIZES[self._current] * pace
        return self.clock() - self._current_began > 1.5 * expected

    @property
    def elapsed(self) -> float:
        """Seconds since it began."""
        return self.clock() - self._began

    @property
    def left(self) -> float | None:
        """Seconds that are left, roughly; None before the first fit or if overdue."""
        if self._done == 0.0 or self.is_overdue:
            return None
        half = SIZES.get(self._current, 0.0) / 2
        remaining = half + sum(SIZES[kind] for kind in self._plan)
        return remaining * self.elapsed / (self._done + half)

    @property
    def words(self) -> str:
        """How long it takes already, and how much longer where that is known."""
        elapsed = duration(self.elapsed)
        if self.is_overdue:
            return f"{elapsed}, longer than expected"
        left = self.left
        return elapsed if left is None else f"{elapsed}, about {duration(left)} left"


def duration(seconds: float) -> str:
    """A duration as people read it: 0:07, 12:30, 1:02:03."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}:{minutes:02d}:{rest:02d}"
    return f"{minutes}:{rest:02d}"
