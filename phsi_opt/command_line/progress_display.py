"""What is being done, since when, and how much longer: on standard error.

One line that changes in a terminal, plain lines elsewhere (a file, a log of a server).
"""

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Self

from phsi_opt.presentation.forecast import Forecast

if TYPE_CHECKING:
    from rich.status import Status

SPINNER = 3  # columns of the terminal that the turning sign takes
CUT = "..."  # the end of a line that is too long for the terminal


class ProgressDisplay:
    """Shows the lines that the work says; a context, which clears the line at its end.

    Args:
        forecast: of the time that is left.
    """

    def __init__(self, forecast: Forecast) -> None:
        self.forecast = forecast
        self.line = "starting"
        self._status: Status | None = None

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console

            self._status = Console(stderr=True).status("")
            self._status.start()
            self.refresh()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._status is not None:
            self._status.stop()
            self._status = None

    def say(self, line: str) -> None:
        """Show a new line."""
        self.forecast.said(line)
        self.line = " ".join(line.split())
        if self._status is None:
            print(self._plain_text(), file=sys.stderr, flush=True)
        self.refresh()

    def refresh(self) -> None:
        """Show the time again."""
        if self._status is not None:
            self._status.update(self._text())

    def _plain_text(self) -> str:
        return f"[{self.forecast.words}] {self.line}"

    def _text(self) -> str:
        from rich.markup import escape

        assert self._status is not None
        text = self._plain_text()
        width = self._status.console.width - SPINNER
        if len(text) > width:
            text = f"{text[: width - len(CUT)]}{CUT}"
        return escape(text)
