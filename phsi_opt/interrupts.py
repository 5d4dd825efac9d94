"""Ctrl-C in a long call: one mechanism by which it ends soon, and as what it is.

Python raises `KeyboardInterrupt` wherever it happens to be. Where C++ called Python, or
is about to be called, that exception is printed and lost, or becomes another error, and
the call goes on. So a long call is `interruptible`: the first Ctrl-C is noted, besides
being raised; while the solver works it is noted alone (`solving`), the solver asks
after each iteration (`is_noted`) and ends; and whatever the call made of it, at its end
`KeyboardInterrupt` is raised.
"""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from types import FrameType
from typing import ParamSpec, TypeVar

from phsi_opt.blas import one_thread

P = ParamSpec("P")
Result = TypeVar("Result")


@dataclass
class _Listening:
    """What is known of Ctrl-C while a long call is at work."""

    is_noted: bool = False  # pressed since the call began
    is_solving: bool = False

    def take(self, number: int, frame: FrameType | None) -> None:
        """Handle the signal; a second one is raised even while the solver works."""
        is_first = not self.is_noted
        self.is_noted = True
        if not (is_first and self.is_solving):
            signal.default_int_handler(number, frame)


_listening = _Listening()


def is_noted() -> bool:
    """Whether Ctrl-C was pressed in the long call that is at work."""
    return _listening.is_noted


@contextmanager
def heard() -> Iterator[None]:
    """Let Ctrl-C end what is inside, as KeyboardInterrupt.

    Only the main thread hears signals, and a handler that is not Python's own (that of
    a server, or of a worker that ignores them) stays.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed inside.
    """
    before = signal.getsignal(signal.SIGINT)
    if not _is_main() or before is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _listening.take)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        was_noted = _listening.is_noted
        _listening.is_noted = False
        if was_noted:
            raise KeyboardInterrupt


def interruptible(call: Callable[P, Result]) -> Callable[P, Result]:
    """Decorate a long call: Ctrl-C ends it as such, and BLAS has one thread."""

    @wraps(call)
    def inner(*args: P.args, **kwargs: P.kwargs) -> Result:
        with heard(), one_thread():
            return call(*args, **kwargs)

    return inner


@contextmanager
def solving() -> Iterator[None]:
    """Note Ctrl-C while a solver works inside, and raise it before and after.

    So is it while a process is started: in the middle, nobody would know of it.
    What solvers do in other threads is not in the way of the main one, which hears it.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed in the long call that is at work.
    """
    with heard():
        _raise_noted()
        outside = _listening.is_solving
        if _is_main():
            _listening.is_solving = True
        try:
            yield
        finally:
            if _is_main():
                _listening.is_solving = outside
        _raise_noted()


def _is_main() -> bool:
    return threading.current_thread() is threading.main_thread()


def _raise_noted() -> None:
    if _listening.is_noted:
        raise KeyboardInterrupt
