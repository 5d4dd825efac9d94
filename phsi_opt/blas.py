"""One thread of BLAS in long calls, so that results do not depend on how many it has.

With more threads sums are in another order, and their last bits differ. Most matrices
here are small, for which more threads are no faster.
"""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from threading import Lock

from threadpoolctl import ThreadpoolController

# Read by libraries that are loaded later, such as IPOPT's own BLAS.
N_THREADS = "OPENBLAS_NUM_THREADS"

_lock = Lock()
_inside: list[None] = []  # an entry for each long call at work, of whatever thread
_limits = ExitStack()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let BLAS have one thread inside, and as many as before afterwards."""
    with _lock:
        if not _inside:
            _limits.callback(_restore, os.environ.get(N_THREADS))
            _limits.enter_context(_loaded().limit(limits=1, user_api="blas"))
            os.environ[N_THREADS] = "1"
        _inside.append(None)
    try:
        yield
    finally:
        with _lock:
            _inside.pop()
            if not _inside:
                _limits.close()


@cache
def _loaded() -> ThreadpoolController:
    """The libraries that are there at the first call; to find them takes a while."""
    return ThreadpoolController()


def _restore(before: str | None) -> None:
    os.environ.pop(N_THREADS)
    if before is not None:
        os.environ[N_THREADS] = before
