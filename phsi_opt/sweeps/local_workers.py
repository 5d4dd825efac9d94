"""Processes on this machine that compute side by side, one BLAS thread each.

They end when they are no longer wanted: when the work is done, at Ctrl-C, and with the
process that started them, even if that one is killed. All three close a pipe on which a
thread of every worker waits.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from typing import Any

# What the libraries behind NumPy and SciPy read when they are loaded.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
GONE = 1  # exit code of a worker that was not wanted any more


class InThisProcess(Executor):
    """Computes each task at once, in the process that submits it."""

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """The finished future of a call; what it raises is raised by ``result``."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class _Processes(ProcessPoolExecutor):
    """A pool whose processes, begun by `submit`, have one BLAS thread each."""

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """The future of a call."""
        with _one_blas_thread():
            return super().submit(fn, *args, **kwargs)


@contextmanager
def local_workers(n_workers: int | None = None) -> Iterator[Executor]:
    """An executor with processes on this machine, for the length of a ``with``.

    Args:
        n_workers: Number of processes; default: of the processors that may be used.
            One computes in the present process.
    """
    n = n_workers or usable_processors()
    if n == 1:
        yield InThisProcess()
        return
    context = get_context("spawn")  # a fork would copy locks that threads hold
    wanted, release = context.Pipe(duplex=False)
    pool = _Processes(
        n, mp_context=context, initializer=begin_worker, initargs=(wanted,)
    )
    try:
        yield pool
        pool.shutdown()
    finally:
        release.close()
        pool.shutdown(cancel_futures=True)
        wanted.close()


def usable_processors() -> int:
    """The number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def begin_worker(wanted: Connection) -> None:
    """What a worker does first: Ctrl-C is its parent's business, the pipe its own.

    Args:
        wanted: The worker ends at once when the other end is closed.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(wanted,), daemon=True).start()


def _end_with(wanted: Connection) -> None:
    wait([wanted])  # nothing is ever sent: the pipe is ready when it is closed
    os._exit(GONE)


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """The environment that processes begun inside inherit."""
    added = [name for name in THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)
