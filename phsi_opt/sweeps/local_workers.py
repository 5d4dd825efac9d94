"""Processes on this machine that compute side by side, one BLAS thread each.

They end when they are no longer wanted. When the work is done they leave by themselves;
at Ctrl-C or an error the process that started them kills them, whatever they do, even
if they are still importing. If that process is killed itself, a pipe closes on which a
thread of every worker waits.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from phsi_opt.interrupts import solving

# What the libraries behind NumPy and SciPy read when they are loaded.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


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


class _Worker(SpawnProcess):
    """A process with one BLAS thread, which never hears Ctrl-C."""

    def start(self) -> None:
        """Start it; Ctrl-C is raised before or after, when the process is known."""
        with solving(), _one_blas_thread(), _interrupts_blocked():
            super().start()


class _Workers(SpawnContext):
    """Spawns the processes of a pool (a fork would copy locks), and can end them."""

    def __init__(self) -> None:
        self._made: list[_Worker] = []

    def Process(self, *args: Any, **kwargs: Any) -> _Worker:  # type: ignore[override]  # noqa: N802
        made = _Worker(*args, **kwargs)
        self._made.append(made)
        return made

    def end(self) -> None:
        """End the processes that have not ended yet, whatever they do."""
        started = [one for one in self._made if one.pid is not None]
        for one in started:
            one.kill()
        for one in started:
            one.join()


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
    context = _Workers()
    wanted, release = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(
        n, mp_context=context, initializer=begin_worker, initargs=(wanted,)
    )
    try:
        yield pool
        pool.shutdown()
    finally:
        # First nothing more is begun: the pool starts no other process then.
        pool.shutdown(wait=False, cancel_futures=True)
        context.end()
        release.close()
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
    os._exit(1)


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Processes begun inside never hear Ctrl-C, where the system can say so."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute with one thread inside, and with as many as before afterwards.

    Small batches are slower with more threads, and the order of sums, and so the last
    bits, would depend on their number.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
