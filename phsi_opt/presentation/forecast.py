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
NOTHING_MISSING = "nothing missing"
# Sizes in units of the first fit: rough means over the demonstration (0.03 to 2 s for
# each unit); single ones differ by a factor of three.
SIZES = {FITTING: 1.0, SCREENING: 1.5, WEIGHING: 1.0, ADDING: 2.0}
DIAGNOSIS = (SCREENING, *[WEIGHING] * 4)  # 1 to 12 effects are weighed


@dataclass
class Forecast:
    """The time that is left, from the lines that were said.

    Attributes:
        n_diagnoses: how many diagnoses are expected; the last one finds nothing.
        clock: the time in s.
        done: size of the work that is done; ``current``: kind of the present one.
        plan: the kinds of work that are expected after it.
    """

    n_diagnoses: int
    clock: Callable[[], float] = time.monotonic
    done: float = 0.0
    current: str = ""
    plan: list[str] = field(init=False)
    began: float = field(init=False)
    current_began: float = field(init=False)

    def __post_init__(self) -> None:
        self.began = self.current_began = self.clock()
        rounds = [*DIAGNOSIS, ADDING] * self.n_diagnoses
        self.plan = rounds[:-1]

    def said(self, line: str) -> None:
        """Note a line; most say nothing of the progress."""
        kind = next(filter(line.startswith, (NOTHING_MISSING, *SIZES)), None)
        if kind is None:
            return
        self.done += SIZES.get(self.current, 0.0)
        self.current = kind
        self.current_began = self.clock()
        if kind == NOTHING_MISSING:
            self.plan = []  # the last diagnosis
        elif kind == ADDING and self.n_diagnoses and SCREENING not in self.plan:
            self.plan = list(DIAGNOSIS)  # one more than was expected
        elif kind in self.plan and (kind != WEIGHING or self.plan[0] == WEIGHING):
            self.plan = self.plan[self.plan.index(kind) + 1 :]

    @property
    def is_overdue(self) -> bool:
        """Whether the current work takes far longer than others of its kind."""
        if self.done == 0.0 or self.current not in SIZES:
            return False
        pace = (self.current_began - self.began) / self.done
        expected = SIZES[self.current] * pace
        return self.clock() - self.current_began > 1.5 * expected

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
        half = SIZES.get(self.current, 0.0) / 2
        remaining = half + sum(SIZES[kind] for kind in self.plan)
        return remaining * self.elapsed / (self.done + half)


def duration(seconds: float) -> str:
    """A duration as people read it: 0:07, 12:30, 1:02:03."""
    whole = int(seconds)
    minutes = whole // 60
    if minutes < 60:
        return f"{minutes}:{whole % 60:02d}"
    return f"{minutes // 60}:{minutes % 60:02d}:{whole % 60:02d}"
