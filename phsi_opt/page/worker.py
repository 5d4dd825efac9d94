"""The processes of a session: one solves, one reads; each does its orders one by one.

They are spawned, so that nothing of the server is in them, and end with the server: the
pipe breaks then. With every result the study goes to the server, which keeps it as it
came and hands it to the next process, to go on where one was cancelled. It goes through
the pipe alone: what lies on the disk is never unpickled. Files are read by a process of
their own, so that one that takes too long stops neither the server nor a solve.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from phsi_opt.errors import DataError, PhsiOptError, StudyFileError
from phsi_opt.export.targets import SUFFIXES
from phsi_opt.presentation.content import StudyContent
from phsi_opt.presentation.numbers import number_of
from phsi_opt.study import Study
from phsi_opt.study_file.kept_fits import KeptFits
from phsi_opt.study_file.study_file import StudyFile

Order = partial[Any]  # a function of a module, with its arguments
OUT_OF_TIME = getattr(signal, "SIGXCPU", 0)
Receiver = Callable[["WorkerHandle", Any], None]


@dataclass(frozen=True)
class Returned:
    """What an order returned, or why it could not be carried out."""

    value: Any = None
    error: DataError | None = None


@dataclass(frozen=True)
class Shown:
    """The study as it stands: its content, and itself in bytes for the next worker."""

    content: StudyContent
    study: bytes


def example(name: str) -> Path:
    """A study file that comes with the package."""
    return Path(str(files("phsi_opt.study_file") / "examples" / name / "study.toml"))


# ---- the server's end ----------------------------------------------------------------


class Turns:
    """Who is served, so many at once, and who waits: first come, first served."""

    def __init__(self, n_at_once: int) -> None:
        self._n_at_once = n_at_once
        self._line: list[object] = []  # the first ones are served
        self._moved = threading.Condition()

    def take(self, who: object, tell: Callable[[str], None]) -> None:
        """Wait for a turn, or until `give_back` ends the wait; tell for how many."""
        with self._moved:
            self._line.append(who)
            while who in self._line[self._n_at_once :]:
                tell(waits(self._line.index(who) + 1 - self._n_at_once))
                self._moved.wait()
        tell("")

    def give_back(self, who: object) -> None:
        """End the turn, or the wait, of somebody who may have none."""
        with self._moved, suppress(ValueError):
            self._line.remove(who)
            self._moved.notify_all()


# Orders that are carried out at once; others wait, and the page goes on answering.
TURNS = Turns(2 * (os.cpu_count() or 1))


def waits(n: int) -> str:
    """What is said while so many must end before."""
    others = number_of(n, "other study is", "other studies are")
    return f"waiting until {others} solved"


class WorkerHandle:
    """One spawned process, the thread that listens to it and the one that tells it.

    Args:
        on_message: called from the listening thread with every message (a line of
            progress, `Shown`, `Returned`), and with None when the process has ended.
        solves: whether it gets ready to solve; else it is for `call`.
    """

    def __init__(self, on_message: Receiver, solves: bool = True) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._returned: SimpleQueue[Returned | None] = SimpleQueue()
        self._on_message = on_message
        self._solves = solves
        self._orders: SimpleQueue[tuple[Order, bytes] | None] = SimpleQueue()
        self.study: Path | None = None  # where the one is kept that it has
        arguments = (theirs, solves)
        self.process = context.Process(target=work, args=arguments, daemon=True)
        self.process.start()
        theirs.close()  # else the pipe would not break when the worker ends
        threading.Thread(target=self._listen, daemon=True).start()
        threading.Thread(target=self._write, daemon=True).start()

    def tell(self, order: Order, study: Path | None = None) -> None:
        """Send an order; the worker takes it when the one before is done."""
        known, self.study = self.study, study
        sent = study.read_bytes() if study and study != known else b""
        self._orders.put((order, sent))

    def call(self, within: float | None, order: Order) -> Any:
        """What an order returns in the process, which ends if that takes too long.

        Args:
            within: seconds of its processor; None: as many as it takes.
            order: a function with its arguments.
        """
        self.tell(partial(_limited, within, order))
        has_time = True
        returned = None
        try:
            # Ten times as long by the clock: a machine may be busy.
            returned = self._returned.get(timeout=within and 10 * within)
        except Empty:
            self.end()
            has_time = False
        if returned is None:
            self.process.join(1.0)
            if within and not (has_time and self.process.exitcode != -OUT_OF_TIME):
                raise DataError(
                    f"reading was stopped after {within:.0f} s. Keep fewer samples, or "
                    "read the file in Python."
                )
            raise DataError(
                "the process that reads files ended unexpectedly, perhaps as memory "
                "is short. Try again with fewer samples."
            )
        if returned.error is not None:
            raise returned.error
        return returned.value

    def end(self) -> None:
        """End the process: politely, and after a second in any case."""
        for end in (self.process.terminate, self.process.kill):
            end()
            self.process.join(1.0)

    def _listen(self) -> None:
        message: Any = ""
        while message is not None:
            try:
                message = self._connection.recv()
            except (EOFError, OSError):
                message = None
                self._orders.put(None)
            if message is None or isinstance(message, Returned):
                TURNS.give_back(self)
                if not self._solves:  # `call` waits for it
                    self._returned.put(message)
            self._on_message(self, message)

    def _write(self) -> None:
        """Send studies and orders, each order when it is its turn."""
        with suppress(OSError):  # the process has ended; the other thread tells
            while (told := self._orders.get()) is not None:
                order, study = told
                if self._solves:  # to read takes no long time
                    TURNS.take(self, partial(self._on_message, self))
                if study:
                    self._connection.send_bytes(study)
                self._connection.send(order)
        TURNS.give_back(self)  # what was taken after the process had ended


# ---- the process ---------------------------------------------------------------------


class _Process:
    """What this process has: its end of the pipe, and the study once it is fitted."""

    connection: Connection | None = None
    study: Study | None = None


def tell(message: Any) -> None:
    """Send a line of progress; a study keeps this function, so it has a name."""
    if _Process.connection is not None:
        _Process.connection.send(message)


def work(connection: Connection, solves: bool) -> None:
    """Carry out orders until the pipe breaks; messages go back through it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the server's
    _Process.connection = connection
    is_needed = connection.poll() or not solves
    orders: SimpleQueue[Any] = SimpleQueue()
    listener = threading.Thread(target=_listen, args=(connection, orders), daemon=True)
    listener.start()
    if not is_needed:  # everything is imported and compiled before it is needed
        slowest = example("house")  # its units take most to read
        StudyFile.read(slowest).study().content(forces=True)
    while True:
        order = orders.get()
        if isinstance(order, Study):
            _Process.study = order
        else:
            connection.send(_returned(order))


def _limited(within: float | None, order: Order) -> Any:
    """What an order returns; the process is ended if that takes too much of its time.

    Where the system can (not on Windows); a process that waits for others takes none.
    """
    with suppress(ImportError, ValueError, OSError):
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_CPU)
        until = most if within is None else int(time.process_time() + within) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (until, most))
    return order()


def _returned(order: Order) -> Returned:
    try:
        return Returned(order())
    except StudyFileError as error:
        return Returned(error=error)
    except PhsiOptError as error:
        said = str(error)
    except Exception as error:  # the page says it; the process goes on
        said = f"This is a bug in phsi_opt: {error!r}"
    return Returned(error=DataError(said))


def _listen(connection: Connection, orders: "SimpleQueue[Any]") -> None:
    """Take what comes in; end this process at once where the server is gone."""
    while True:
        try:
            orders.put(connection.recv())
        except (EOFError, OSError):
            os._exit(0)


# ---- orders to the process that solves; all but a report return the laws -------------


def fit(path: Path, places: Mapping[str, Path], origin: Path | None) -> Any:
    """Fit a study file, with the fits that commands kept beside ``origin``; diagnose.

    Args:
        path: of the study file.
        places: where the data files lie, by their names.
        origin: the study file beside which commands have kept fits, if any.
    """
    file = StudyFile.read(path, places)
    kept = KeptFits.of(origin, file, file.split()[0]) if origin else None
    _Process.study = file.study(tell, kept=kept)
    return diagnose()


def diagnose() -> Any:
    """Diagnose the last step, and show it before and after."""
    study = _study()
    if study.record.present is None:
        study.record = replace(study.record, stopped="")  # it goes on
        _show(study)
        study.diagnose()
        _show(study)
    return study.record.laws()  # the verdict does not wait for these


def add(effect: str) -> Any:
    """Add an effect by its name, or with "" what the diagnosis proposes; diagnose."""
    _study().add(effect or None)
    return diagnose()


def auto() -> Any:
    """Add while an effect is decisive."""
    study = _study()
    n_steps = 0
    while len(study.steps) > n_steps:
        n_steps = len(study.steps)
        diagnose()
        study.auto(max_steps=1)
    _show(study)  # with why it stopped
    return study.record.laws()


def report(path: Path) -> Path:
    """Write the report, or the model where the name is that of an export."""
    study = _study()
    if path.suffix in SUFFIXES:
        return study.fit.export(path, study.record.last.held_out)
    return study.report(path)


def _study() -> Study:
    if _Process.study is None:
        raise DataError("Nothing has been fitted yet; press Fit first.")
    return _Process.study


def _show(study: Study) -> None:
    """Send what is shown of a study, with the study itself."""
    content = study.content(forces=True)
    tell(Shown(content, bytes(ForkingPickler.dumps(study))))
