"""The server's end of a worker: start, tell, listen, end within two seconds."""

import multiprocessing
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

from phsi_opt.page.worker import Order, work

CANCEL_GRACE = 1.0  # s that a cancelled worker has before it is killed
Receiver = Callable[["WorkerHandle", Any], None]


class WorkerHandle:
    """One spawned process, the thread that listens to it and the one that tells it.

    Args:
        study: the study to go on from, as the worker before sent it; None: there is
            none.
        on_message: called from the listening thread with every message, and with None
            when the process has ended.
    """

    def __init__(self, study: bytes | None, on_message: Receiver) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        self._connection = ours
        self._on_message = on_message
        self._orders: SimpleQueue[Order | None] = SimpleQueue()
        self._process = context.Process(target=work, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()  # else the pipe would not break when the worker ends
        threading.Thread(target=self._listen, daemon=True).start()
        threading.Thread(target=self._write, args=(study,), daemon=True).start()

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
        self._orders.put(order)

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
                self._orders.put(None)
                self._on_message(self, None)
                return
            self._on_message(self, message)

    def _write(self, study: bytes | None) -> None:
        """Send the study, which a worker that starts takes late, then the orders."""
        try:
            if study is None:
                self._connection.send(None)
            else:
                self._connection.send_bytes(study)
            while (order := self._orders.get()) is not None:
                self._connection.send(order)
        except OSError:  # the process has ended; the other thread tells
            return
