"""A value that is worked out when it is asked for."""

from collections.abc import Callable
from typing import Generic, TypeVar

from phsi_opt.interrupts import interruptible

T = TypeVar("T")


class Later(Generic[T]):
    """What costs much and is not always wanted: kept as the work that gives it.

    Args:
        work: gives the value; called once at most, and forgotten then. Ctrl-C ends it,
            and it begins anew when the value is asked for again.
    """

    def __init__(self, work: Callable[[], T]) -> None:
        self._work: Callable[[], T] | None = work

    @classmethod
    def known(cls, value: T) -> "Later[T]":
        """One that is there already."""
        return cls(lambda: value)

    @property
    def value(self) -> T:
        """The value, worked out now if it was not before."""
        if self._work is not None:
            self._value = interruptible(self._work)()
            self._work = None
        return self._value

    def __reduce__(self) -> "tuple[Callable[[T], Later[T]], tuple[T]]":
        """Copies and files hold the value, not the work."""
        return Later.known, (self.value,)


class Remade(Generic[T]):
    """What is made anew each time it is asked for, as whoever has it may change it.

    Args:
        work: makes it; None: it cannot be made. Copies in other processes and files
            hold no work.
    """

    def __init__(self, work: Callable[[], T] | None = None) -> None:
        self.work = work

    def __reduce__(self) -> "tuple[type[Remade[T]], tuple[()]]":
        return type(self), ()
