"""The server's end of a worker: start, tell, listen, end within two seconds."""

import multiprocessing
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from phsi_opt.page.limits import CANCEL_GRACE
from phsi_opt.page.worker import Order, work

Receiver = Callable[["WorkerHandle", Any], None]


class WorkerHandle:
    """One spawned process and the thread that listens to it.

    Args:
        checkpoint: the file in which the worker keeps its study.
        on_message: called from the listening thread with every message, and with None
            when the process has ended.
    """

    def __init__(self, checkpoint: Path, on_message: Receiver) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        self._connection = ours
        self._on_message = on_message
        self._process = context.Process(
            target=work, args=(theirs, str(checkpoint)), daemon=True
        )
        self._process.start()
        theirs.close()  # else the pipe would not break when the worker ends
        listener = threading.Thread(target=self._listen, daemon=True)
        listener.start()

    @property
    def pid(self) -> int:
        """The number of the process."""
        return self._process.pid or 0

    @property
    def is_alive(self) -> bool:
        """Whether the process is there."""
        return self._process.is_alive()

    def tell(self, order: Order) -> None:
        """Send an order; the worker takes it when the one before is done."""
        self._connection.send(order)

    def end(self) -> None:
        """End the process: politely, and after ``CANCEL_GRACE`` seconds in any case."""
        self._process.terminate()
        self._process.join(CANCEL_GRACE)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(CANCEL_GRACE)

    def _listen(self) -> None:
        while True:
            try:
                message = self._connection.recv()
            except (EOFError, OSError):
                self._on_message(self, None)
                return
            self._on_message(self, message)
