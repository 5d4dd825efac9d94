"""The process that solves: it holds one study and does what it is told, one by one.

It is spawned, so that nothing of the server is in it, and ends with the server: its
pipe breaks then. With every result the study goes to the server, which keeps it as it
came and hands it to the next process, to go on where one was cancelled. It goes through
the pipe alone: what lies on the disk is never unpickled.
"""

import os
import signal
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from queue import SimpleQueue
from types import MappingProxyType
from typing import Any

from phsi_opt.errors import Complaint, PhsiOptError, StudyFileError
from phsi_opt.model.effect import Effect
from phsi_opt.presentation.content import StudyContent
from phsi_opt.study import Study
from phsi_opt.study_file.sections import DEFAULT_MAX_STEPS
from phsi_opt.study_file.study_file import StudyFile

FIT = "fit"
DIAGNOSE = "diagnose"
ADD = "add"
UNDO = "undo"
AUTO = "auto"
REPORT = "report"


@dataclass(frozen=True)
class Order:
    """What the worker is told: one of the verbs, and what it needs.

    Attributes:
        verb: such as ``ADD``.
        what: a path for ``FIT`` and ``REPORT``; for ``ADD`` names of effects.
        places: for ``FIT``: where the data files lie, by their names.
    """

    verb: str
    what: tuple[str, ...] = ()
    places: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Said:
    """A line of progress."""

    line: str


@dataclass(frozen=True)
class Shown:
    """The study as it stands now.

    Attributes:
        content: what the page shows of it.
        study: the study itself as bytes, for the next worker alone.
    """

    content: StudyContent
    study: bytes


@dataclass(frozen=True)
class Wrote:
    """A file that was asked for."""

    path: str


@dataclass(frozen=True)
class Refused:
    """Why an order could not be carried out; with the complaints about a study file."""

    message: str
    complaints: tuple[Complaint, ...] = ()


@dataclass(frozen=True)
class Done:
    """The order is carried out, or refused; the worker waits for the next."""


class _Pipe:
    """The end of the pipe of this process; progress lines go through it."""

    connection: Connection | None = None


def tell(line: str) -> None:
    """Send a line of progress; a study keeps this function, so it has a name."""
    if _Pipe.connection is not None:
        _Pipe.connection.send(Said(line))


def work(connection: Connection) -> None:
    """Carry out orders until the pipe breaks.

    Args:
        connection: the study to go on from, or None, comes in first, then orders;
            messages go out.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the server's
    _Pipe.connection = connection
    ForkingPickler.register(MappingProxyType, _reduced)
    orders: SimpleQueue[Any] = SimpleQueue()
    listener = threading.Thread(target=_listen, args=(connection, orders), daemon=True)
    listener.start()
    bench = Bench(orders.get())
    while True:
        order = orders.get()
        connection.send(_answer(bench, order, connection))
        connection.send(Done())


def _listen(connection: Connection, orders: "SimpleQueue[Any]") -> None:
    """Take what comes in; end this process at once where the server is gone."""
    while True:
        try:
            orders.put(connection.recv())
        except (EOFError, OSError):
            os._exit(0)


def _answer(bench: "Bench", order: Order, connection: Connection) -> Any:
    """What is said at the end of an order."""
    try:
        return bench.carry_out(order, connection)
    except StudyFileError as error:
        return Refused("The draft cannot be used yet.", error.complaints)
    except PhsiOptError as error:
        return Refused(str(error))
    except Exception as error:  # the page says it; the process goes on
        return Refused(f"This is an error of the package: {error!r}")


class Bench:
    """A study in work.

    Args:
        study: to go on from; None: there is none yet.
    """

    def __init__(self, study: Study | None) -> None:
        self.study = study

    def carry_out(self, order: Order, connection: Connection) -> Any:
        """Do it, sending what there is on the way; return the last message.

        Raises:
            DataError: the data cannot be used, or nothing was fitted yet.
            ModelError: an effect is unknown, or there is nothing to undo.
            SolveError: a model could not be fitted.
        """
        if order.verb == FIT:
            self.study = StudyFile.read(order.what[0], order.places).study(tell)
        study = self.study
        if study is None:
            return Refused("Nothing has been fitted yet; press Fit first.")
        if order.verb == REPORT:
            return Wrote(str(study.report(order.what[0])))
        if order.verb == ADD:
            study.add(_effect_named(study, order.what[0]))
        elif order.verb == UNDO:
            study.undo()
        elif order.verb == AUTO:
            self._add_all(study, connection)
        connection.send(_shown(study))
        study.diagnose()
        return _shown(study)

    def _add_all(self, study: Study, connection: Connection) -> None:
        """What ``Study.auto`` does, shown after each step."""
        for _ in range(DEFAULT_MAX_STEPS):
            n_steps = len(study.steps)
            study.auto(max_steps=1)
            if len(study.steps) == n_steps:
                return
            connection.send(_shown(study))


def _shown(study: Study) -> Shown:
    """What is shown of a study, with the study itself."""
    content = study.content(forces=True)
    return Shown(content, bytes(ForkingPickler.dumps(study)))


def _effect_named(study: Study, name: str) -> Effect:
    """One of the candidates, by its name and equation."""
    for candidate in study.diagnose().ranking:
        if candidate.name == name:
            return candidate.effect
    return effect_meant(study, name)


def effect_meant(study: Study, name: str) -> Effect:
    """An effect of the catalogue, such as "coulomb friction on p".

    Raises:
        ModelError: there is none of that name.
    """
    from phsi_opt.model.catalogue import effect_named

    before, _, equation = name.rpartition(" on ")
    return effect_named(study.model, before, equation, study.train.units)


def _reduced(proxy: Mapping[Any, Any]) -> tuple[Any, ...]:
    """How a read-only mapping goes through the pipe."""
    return read_only, (dict(proxy),)


def read_only(mapping: dict[Any, Any]) -> Mapping[Any, Any]:
    """The mapping, which nobody can change any more."""
    return MappingProxyType(mapping)
