"""Where a battery computes: processes of this machine, or a Dask cluster.

--jobs=N               so many processes; 1: in this one
--scheduler=ADDRESS    the cluster of a Dask scheduler, such as tcp://host:8786
"""

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from phsi_opt.sweeps.local_workers import local_workers
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
