"""One function for many cases, side by side, wherever an executor computes them.

Of the executor nothing is asked but `submit`, of its futures `result` (and `cancel`,
for those that are not needed any more), so that processes, threads and a cluster serve
alike. An executor that was given is never shut down here.
"""

import hashlib
import json
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

from phsi_opt.arguments import is_count, typed
from phsi_opt.errors import DataError, PhsiOptError, SolveError, shown
from phsi_opt.reading import file_text
from phsi_opt.sweeps.local_workers import local_workers
from phsi_opt.writing import make_folder, write_whole

Progress = Callable[[str], None]
FORMAT = "phsi_opt sweep 1"


def silent(line: str) -> None:
    """The `Progress` that says nothing."""


@dataclass(frozen=True)
class KeptResults:
    """The results of one sweep, in a folder that is made when the first one is kept.

    ``of`` names what they depend on beside their keys, in a word or a digest; a file
    that says something else is refused.
    """

    folder: Path
    of: str = ""

    def keep(self, key: str, result: Any) -> None:
        """Write the result of a key.

        Raises:
            DataError: JSON cannot hold the result.
        """
        content = {"format": FORMAT, "of": self.of, "key": key, "result": result}
        try:
            text = json.dumps(content, default=_plain)
        except (TypeError, ValueError) as error:
            raise DataError(
                f"the result of {key!r} cannot be saved as JSON: {error}. Return "
                "numbers, texts, lists and mappings, or sweep without a folder."
            ) from None
        make_folder(self.folder)
        write_whole(self.path_of(key), text + "\n")

    def found(self, keys: Iterable[str]) -> Iterator[tuple[str, Any]]:
        """Those of the keys that are kept, with their results.

        A file that cannot be read counts as none: its result is computed anew.

        Raises:
            DataError: A file is of another sweep.
        """
        for key in keys:
            path = self.path_of(key)
            try:
                content = json.loads(file_text(path))
            except (OSError, ValueError, RecursionError):
                continue
            if not isinstance(content, dict) or "result" not in content:
                continue
            expected = (FORMAT, self.of, key)
            if tuple(map(content.get, ("format", "of", "key"))) != expected:
                raise DataError(
                    f"{path} contains a result of another sweep: "
                    f"{content.get('of')!r} in the file, {self.of!r} requested. "
                    "Choose another folder, or empty this one."
                )
            yield key, content["result"]

    def path_of(self, key: str) -> Path:
        """The file of a key; it may not exist."""
        name = quote(key, safe=" ")
        if len(name) > 100 or name.startswith("."):  # file systems take 255 bytes
            digest = hashlib.sha256(key.encode()).hexdigest()[:16]
            name = f"{name[:84]}-{digest}".lstrip(".")
        return self.folder / f"{name}.json"


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays as Python's."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not a number, text, list or mapping")


@dataclass(frozen=True, eq=False)
class Done:
    """One finished case of a sweep.

    Attributes:
        key: Its key.
        result: What the function returned.
    """

    key: str
    result: Any


@partial(typed, error=DataError)
def sweep(
    function: Callable[[Any], Any],
    cases: Mapping[str, Any],
    *,
    executor: Executor | None = None,
    folder: str | Path | None = None,
    of: str = "",
    in_flight: int = 64,
    progress: Progress | None = None,
) -> Iterator[Done]:
    """Call a function for many cases in parallel, and yield results as they finish.

    ::

        for done in ph.sweep(fit_of_seed, {f"seed {n}": n for n in range(100)}):
            print(done.key, done.result)

    The results do not depend on the executor or on the order of computation if the
    function depends only on its argument; a random seed is therefore a part of the
    case. In a script, the call must be under ``if __name__ == "__main__":``.

    Ctrl-C, an error of the function, and leaving the loop cancel the remaining cases.
    At most the results of `in_flight` cases are in memory.

    Args:
        function: Function of one argument, defined at the top level of a module so that
            another process can import it; or a `functools.partial` of such a function.
        cases: The argument of each case, by its key, a text. Cases are pickled, so they
            should be small.
        executor: Executor of `concurrent.futures`, or ``client.get_executor()`` of a
            Dask cluster; None: one process per processor of this machine, each with one
            BLAS thread. It is not shut down.
        folder: Folder for the results, one file each; cases with a result in it are not
            computed again. Results must then be numbers, texts, lists and mappings.
        of: Text that identifies what results depend on in addition to the key, such as
            a digest of the data; a folder with results of another text is refused.
        in_flight: Largest number of cases that are submitted and not yet finished; the
            default is enough for some dozen workers.
        progress: Called with a line of text whenever a case is done, such as ``print``.

    Returns:
        The finished cases: first those in the folder, then the others as they finish.

    Raises:
        DataError: The function, a key, the executor, the number in flight or the folder
            cannot be used.
        SolveError: A worker process ended before its case was finished.

    Examples:
        >>> from concurrent.futures import ThreadPoolExecutor
        >>> cases = {"first": -1, "second": -2}
        >>> with ThreadPoolExecutor(2) as threads:
        ...     done = list(ph.sweep(abs, cases, executor=threads))
        >>> sorted((one.key, one.result) for one in done)
        [('first', 1), ('second', 2)]
    """
    _check(function, cases, in_flight)
    kept = None if folder is None else KeptResults(Path(folder), of)
    return _swept(function, cases, executor, kept, in_flight, progress or silent)


def _swept(
    function: Callable[[Any], Any],
    cases: Mapping[str, Any],
    executor: Executor | None,
    kept: KeptResults | None,
    in_flight: int,
    say: Progress,
) -> Iterator[Done]:
    """Kept results first, then the others as they are computed."""
    n_done = count(1)
    missing = dict(cases)
    for key, result in kept.found(cases) if kept else ():
        del missing[key]
        say(f"{next(n_done)} of {len(cases)}: {key}, read from the folder")
        yield Done(key, result)
    if not missing:
        return
    # Processes of our own end when the sweep does.
    with local_workers() if executor is None else nullcontext(executor) as workers:
        for done in _computed(function, iter(missing.items()), workers, in_flight):
            if kept:
                kept.keep(done.key, done.result)
            say(f"{next(n_done)} of {len(cases)}: {done.key}")
            yield done


def _computed(
    function: Callable[[Any], Any],
    missing: Iterator[tuple[str, Any]],
    workers: Executor,
    in_flight: int,
) -> Iterator[Done]:
    """Results as they come; never more than `in_flight` cases at the workers."""
    running: dict[Future[Any], str] = {}
    try:
        while True:
            for key, case in islice(missing, in_flight - len(running)):
                future = workers.submit(function, case)
                running[future] = key
                if future.done():  # one that computes at once is asked for no more
                    break
            if not running:
                return
            ready = wait(running, return_when=FIRST_COMPLETED).done
            for future in [one for one in running if one in ready]:
                key = running.pop(future)
                yield Done(key, _result_of(future, key))
    finally:
        for future in running:
            future.cancel()


def _result_of(future: Future[Any], key: str) -> Any:
    try:
        return future.result()
    except BrokenExecutor as error:
        raise SolveError(
            f"a worker process ended while {key!r} was computed. Perhaps the memory "
            "was too small, or a script started the sweep outside of `if __name__ == "
            '"__main__":`. With a folder, the same call continues from the saved '
            f"results. ({error})"
        ) from error
    except Exception as error:
        error.add_note(f"This error occurred in the case {key!r} of a sweep.")
        raise


def _check(
    function: Callable[[Any], Any], cases: Mapping[str, Any], in_flight: int
) -> None:
    name = getattr(function, "__qualname__", "")
    if "<lambda>" in name or "<locals>" in name:
        raise DataError(
            f"the function {name} cannot be imported by another process; define it at "
            "the top level of a module, and pass further arguments with "
            "functools.partial."
        )
    for key in cases:
        if not key or not key.isprintable():
            raise DataError(
                f"the key {shown(key)} is not a text of one line; give every case a "
                "non-empty name."
            )
    if not is_count(in_flight):
        raise DataError(
            f"in_flight={shown(in_flight)} must be a number of cases, 1 or more."
        )


# ---- a few cases, begun before their results are asked for

T = TypeVar("T")
Result = TypeVar("Result")


def ahead(
    function: Callable[[T, Progress], Result],
    cases: Mapping[str, T],
    executor: Executor | None,
    say: Progress,
) -> Generator[Callable[[], Result], None, None]:
    """Calls that give the results of the cases, in order; close it to cancel the rest.

    The lines of a case and its error come with its call, as if it had been computed in
    that moment; so it is without an executor, and where there is one case. The function
    takes a case and what is called with lines of text; it stands at the top level of a
    module, or is a `functools.partial` of such a function.
    """
    if executor is None or len(cases) == 1:
        for case in cases.values():
            yield partial(function, case, say)
        return
    begun: list[Future[Any]] = []
    waiting = iter(cases.values())
    try:
        for number, key in enumerate(cases):
            for case in waiting if number == len(begun) else ():
                begun.append(executor.submit(_heard, function, case))
                if begun[-1].done():  # one that computes at once is asked for no more
                    break
            yield partial(_told, begun[number], key, say)
    finally:
        for future in begun:
            future.cancel()


def _heard(
    function: Callable[[Any, Progress], Any], case: Any
) -> tuple[list[str], Any]:
    """The lines of a case, and its result or error."""
    lines: list[str] = []
    try:
        return lines, function(case, lines.append)
    except PhsiOptError as error:
        return lines, error


def _told(future: Future[Any], key: str, say: Progress) -> Any:
    lines, result = _result_of(future, key)
    for line in lines:
        say(line)
    if isinstance(result, PhsiOptError):
        raise result
    return result
