"""Where a battery computes: processes of this machine, or a Dask cluster.

--jobs=N               so many processes; 1: in this one
--scheduler=ADDRESS    the cluster of a Dask scheduler, such as tcp://host:8786
"""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from phsi_opt.sweeps.local_workers import local_workers
from phsi_opt.sweeps.sweep import Done, sweep
from problems.tools.command_line import option


@contextmanager
def workers(jobs: int | None = None) -> Iterator[Executor]:
    """The executor that the command line asks for."""
    address = option("scheduler", "")
    if address:
        from distributed import Client

        with Client(address) as client:
            yield client.get_executor()
        return
    asked = int(option("jobs", "0")) or None
    with local_workers(jobs or asked) as executor:
        yield executor


def fresh_processes(n: int = 1) -> ProcessPoolExecutor:
    """Processes of which each computes one task, so that its peak memory is its own."""
    return ProcessPoolExecutor(n, get_context("spawn"), max_tasks_per_child=1)


def computed(
    function: Callable[[Any], Any],
    cases: Mapping[str, Any],
    folder: Path | None = None,
    jobs: int | None = None,
) -> Iterator[Done]:
    """The result of each case as it comes, kept in a folder if one is given."""
    with workers(jobs) as executor:
        yield from sweep(function, cases, executor=executor, folder=folder)
