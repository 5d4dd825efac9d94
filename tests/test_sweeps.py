"""Sweeps: the same numbers wherever they are computed, and nothing lost on the way."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import dask
import distributed
import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.sweeps.local_workers import InThisProcess, local_workers
from phsi_opt.sweeps.sweep import KeptResults
from tests import sweep_tasks
from tests.waiting import HANGS_AFTER, wait_for

N_WORKERS = 2


def draws(n: int) -> dict[str, np.random.SeedSequence]:
    seeds = np.random.SeedSequence(7).spawn(n)
    return {f"draw {number}": seed for number, seed in enumerate(seeds)}


def results(found: Any) -> dict[str, Any]:
    return {done.key: done.result for done in found}


class Watched(Executor):
    """Offers `submit` alone, computes late, and notes how much it holds."""

    def __init__(self) -> None:
        self.pool = ThreadPoolExecutor(N_WORKERS)
        self.n_running = 0
        self.most_running = 0
        self.n_submitted = 0
        self.was_shut_down = False

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.n_running += 1
        self.n_submitted += 1
        self.most_running = max(self.most_running, self.n_running)
        future = self.pool.submit(fn, *args, **kwargs)
        future.add_done_callback(self._ended)
        return future

    def _ended(self, future: Future[Any]) -> None:
        self.n_running -= 1

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self.was_shut_down = True


@pytest.fixture(scope="module")
def serial() -> dict[str, Any]:
    return results(ph.sweep(sweep_tasks.estimates, draws(6), executor=InThisProcess()))


def test_processes_and_threads_give_the_bits_of_one_process(serial) -> None:
    assert len({one["k"] for one in serial.values()}) == len(serial)
    cases = {str(n): n for n in range(8)}
    with local_workers(N_WORKERS) as workers, ThreadPoolExecutor(N_WORKERS) as threads:
        for executor in (workers, threads):
            swept = ph.sweep(sweep_tasks.estimates, draws(6), executor=executor)
            assert results(swept) == serial
        where = ph.sweep(sweep_tasks.process_and_threads, cases, executor=workers)
        of_each = set(results(where).values())
    assert os.getpid() not in {pid for pid, _ in of_each}
    assert {n_threads for _, n_threads in of_each} == {"1"}


def test_a_killed_dask_worker_loses_nothing(serial: dict[str, Any]) -> None:
    quiet = {
        "distributed.logging.distributed": "critical",
        "distributed.comm.timeouts.connect": f"{HANGS_AFTER}s",
    }
    cluster = partial(
        distributed.LocalCluster,
        n_workers=3,
        threads_per_worker=1,
        processes=True,
        dashboard_address=":0",
    )
    with (
        dask.config.set(quiet),
        cluster() as three,
        distributed.Client(three) as client,
    ):
        client.wait_for_workers(3)
        pids = list(client.run(os.getpid).values())
        found: dict[str, Any] = {}
        executor = client.get_executor()
        for done in ph.sweep(sweep_tasks.slow_estimates, draws(6), executor=executor):
            if not found:
                os.kill(pids[0], signal.SIGKILL)  # one of the three, in the middle
            found[done.key] = done.result
        # the executor was not shut down: it still computes
        assert executor.submit(sweep_tasks.square, 4).result() == 16
        assert pids[0] not in client.run(os.getpid).values()
    assert found == serial


def test_a_sweep_asks_no_more_of_an_executor_than_it_may_hold() -> None:
    watched = Watched()
    cases = {str(n): n for n in range(30)}
    found = results(ph.sweep(sweep_tasks.square, cases, executor=watched, in_flight=4))
    assert found == {str(n): n**2 for n in range(30)}
    assert watched.most_running <= 4
    assert not watched.was_shut_down
    watched.pool.shutdown()


def test_a_worker_that_dies_is_told_with_its_case() -> None:
    match = "a worker process ended while 'a'"
    with local_workers(2) as workers, pytest.raises(ph.SolveError, match=match):
        list(ph.sweep(sweep_tasks.dies, {"a": 1}, executor=workers))


def test_leaving_the_loop_and_an_error_cancel_what_is_not_begun() -> None:
    watched = Watched()
    cases = {str(n): n for n in range(100)}
    swept = ph.sweep(sweep_tasks.square, cases, executor=watched, in_flight=4)
    next(swept)
    swept.close()  # type: ignore[attr-defined]  # a generator
    assert watched.n_submitted <= 5
    with pytest.raises(ValueError, match="three") as raised:
        results(
            ph.sweep(sweep_tasks.fails_at_three, cases, executor=watched, in_flight=1)
        )
    assert "'3'" in raised.value.__notes__[0]
    assert watched.n_submitted <= 10
    watched.pool.shutdown()


def test_a_restart_computes_only_what_is_not_kept(tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    cases = {f"case {n}/of:9": n for n in range(9)}
    squared = partial(ph.sweep, sweep_tasks.square, cases, executor=InThisProcess())
    swept = squared(folder=folder, of="squares")
    first = [next(swept) for _ in range(4)]
    swept.close()  # type: ignore[attr-defined]
    assert len(list(folder.glob("*.json"))) == 4
    kept = KeptResults(folder, "squares")
    cut = kept.path_of(first[0].key)
    cut.write_text(cut.read_text()[:20])  # as an older program's kill would leave it
    said: list[str] = []
    again = list(squared(folder=folder, of="squares", progress=said.append))
    assert sum(line.endswith(", read from the folder") for line in said) == 3
    assert results(again) == {key: n**2 for key, n in cases.items()}
    assert said[-1].startswith("9 of 9: ")
    assert not list(folder.glob("*.part"))
    with pytest.raises(ph.DataError, match="another sweep"):
        list(squared(folder=folder, of="cubes"))


@pytest.mark.parametrize(("function", "cases", "in_flight", "said"), [
    (lambda n: n, {"a": 1}, 1, "top level"),
    (sweep_tasks.square, {1: 1}, 1, "cases={1: 1} .* expected Mapping"),
    (sweep_tasks.square, {"": 1}, 1, "not a text"),
    (sweep_tasks.square, {"a": 1}, 0, "in_flight=0"),
    (1, {"a": 1}, 1, "function=1 is not possible; expected Callable"),
])  # fmt: skip
def test_what_cannot_be_swept_is_refused_at_once(
    function: Any, cases: Any, in_flight: int, said: str
) -> None:
    with pytest.raises(ph.DataError, match=said):
        ph.sweep(function, cases, in_flight=in_flight)


COMPUTING = """
import sys
from phsi_opt.sweeps.local_workers import local_workers
from phsi_opt.sweeps.sweep import sweep
from tests import sweep_tasks

if __name__ == "__main__":
    cases = {"one": sys.argv[1], "two": sys.argv[1]}
    with local_workers(2) as workers:
        for done in sweep(sweep_tasks.sleeps, cases, executor=workers):
            pass
"""
# A worker imports the script before anything else, and does not come further here.
STARTING = f"""
import os, pathlib, sys, time
if __name__ != "__main__":
    pathlib.Path(sys.argv[1], str(os.getpid())).touch()
    time.sleep({10 * HANGS_AFTER})
{COMPUTING}
"""


@pytest.mark.parametrize(("script", "sent", "is_for_all"), [
    (COMPUTING, signal.SIGKILL, False),
    (COMPUTING, signal.SIGINT, False),
    (STARTING, signal.SIGINT, False),
    (STARTING, signal.SIGINT, True),  # as a terminal sends it
])  # fmt: skip
def test_workers_end_with_their_parent_and_at_ctrl_c(
    tmp_path: Path, script: str, sent: signal.Signals, is_for_all: bool
) -> None:
    """A worker that nobody ends sleeps for ten times the patience of this test."""
    path = tmp_path / "script.py"
    path.write_text(script)
    folder = tmp_path / "pids"
    folder.mkdir()
    root = Path(__file__).resolve().parents[1]
    process = subprocess.Popen(
        [sys.executable, str(path), str(folder)],
        env={**os.environ, "PYTHONPATH": str(root)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        wait_for(lambda: len(list(folder.iterdir())) == 2, process)
        pids = [int(one.name) for one in folder.iterdir()]
        os.kill(-process.pid if is_for_all else process.pid, sent)
        process.wait(HANGS_AFTER)
        wait_for(lambda: not any(map(_is_alive, pids)))
    finally:
        with contextlib.suppress(ProcessLookupError):  # all have ended
            os.killpg(process.pid, signal.SIGKILL)
        _, said = process.communicate()
    if sent == signal.SIGINT:
        assert said.count("Traceback") == 1
        assert said.rstrip().endswith("KeyboardInterrupt")


def _is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and is not yet collected does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.fixture(scope="module")
def fitted() -> ph.Fit:
    return ph.identify(sweep_tasks.model(), sweep_tasks.data(3))


def test_a_bootstrap_scatters_as_the_standard_errors_say(fitted, tmp_path) -> None:
    data = sweep_tasks.data(3)
    drawn = partial(
        ph.bootstrap, fitted, data, folder=tmp_path, executor=InThisProcess()
    )
    few = drawn(4)
    said: list[str] = []
    found = drawn(20, progress=said.append)
    assert sum("read from the folder" in line for line in said) == 4
    assert list(found.estimates.index) == list(range(20))
    assert found.estimates.iloc[:4].equals(few.estimates)
    assert not found.failed
    # the scatter of 20 draws is known to a sixth (one standard deviation)
    ratio = found.table["bootstrap_error"] / found.table["std_error"]
    assert np.all((ratio > 0.5) & (ratio < 1.7)), ratio
    intervals = found.intervals(0.9)
    assert (intervals["ci_lower"] < intervals["value"]).all()
    assert (intervals["ci_upper"] > intervals["value"]).all()
    assert "bootstrap of 20 draws" in str(found)
    kept = json.loads(next(tmp_path.glob("*.json")).read_text())
    assert kept["of"].startswith("bootstrap ")
    with pytest.raises(ph.DataError, match="another sweep"):
        ph.bootstrap(fitted, data, 8, seed=1, folder=tmp_path)
    with pytest.raises(ph.DataError, match="level=2"):
        found.intervals(2)
