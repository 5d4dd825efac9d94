"""One function for a few cases, begun side by side before their results are asked for.

Who asks may take the results in an order of their own, and leave some out. What a case
says and how it fails reaches them when they ask for it, as if it had been computed in
that moment: the same lines, numbers and errors as without an executor.
"""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

from phsi_opt.errors import PhsiOptError
from phsi_opt.sweeps.sweep import Done, sweep

Say = Callable[[str], None]
T = TypeVar("T")
Result = TypeVar("Result")


class Ahead(Generic[T, Result]):
    """Results by key; close it, and what is not begun is cancelled.

    Args:
        function: Of a case and of what takes a line of text; at the top level of a
            module, or a `functools.partial` of such a function.
        cases: The argument by key.
        executor: Where to compute; None: here, each case when it is asked for. So is a
            single case.
        say: Called with the lines of a case when its result is asked for.
    """

    def __init__(
        self,
        function: Callable[[T, Say], Result],
        cases: Mapping[str, T],
        executor: Executor | None,
        say: Say,
    ) -> None:
        self._function = function
        self._cases = cases
        self._say = say
        self._found: dict[str, _Told] = {}
        self._swept: Iterator[Done] | None = None
        if executor is not None and len(cases) > 1:
            self._swept = sweep(partial(_told, function), cases, executor=executor)

    def result(self, key: str) -> Result:
        """The result of a case, once.

        Raises:
            PhsiOptError: What the function raised, or a worker ended.
        """
        if self._swept is None:
            return self._function(self._cases[key], self._say)
        while key not in self._found:
            done = next(self._swept)
            self._found[done.key] = done.result
        told = self._found.pop(key)
        for line in told.lines:
            self._say(line)
        if told.error is not None:
            raise told.error
        result: Result = told.result
        return result

    def close(self) -> None:
        """Cancel what is not begun."""
        self._swept = None  # a sweep ends with its iterator


@dataclass(frozen=True, eq=False)
class _Told:
    """What a case gave or raised, and what it said before."""

    result: Any
    lines: list[str]
    error: PhsiOptError | None = None


def _told(function: Callable[[Any, Say], Any], case: Any) -> _Told:
    lines: list[str] = []
    try:
        return _Told(function(case, lines.append), lines)
    except PhsiOptError as error:
        return _Told(None, lines, error)
