"""Requests that are too large are refused before they are read.

The browser's own check is a courtesy; this one holds for every client.
"""

from phsi_opt.page.asgi import Application, Message, Receive, Send, answer, header
from phsi_opt.page.limits import MOST_UPLOADED, UPLOAD_OVERHEAD, in_megabytes

TOO_LARGE = 413


class UploadLimit:
    """An application (ASGI) that passes on what is small enough.

    Args:
        application: the one behind it.
        most: bytes of a request's body.
    """

    def __init__(
        self, application: Application, most: int = MOST_UPLOADED + UPLOAD_OVERHEAD
    ) -> None:
        self._application = application
        self._most = most

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Refuse by the length that is told, or cut off what is longer than told."""
        if scope["type"] != "http":
            await self._application(scope, receive, send)
            return
        if _told_length(scope) > self._most:
            refusal = f"A file may have at most {in_megabytes(MOST_UPLOADED)}."
            await answer(send, TOO_LARGE, refusal)
            return
        n_received = 0

        async def counted() -> Message:
            nonlocal n_received
            message = await receive()
            n_received += len(message.get("body", b""))
            if n_received > self._most:
                return {"type": "http.disconnect"}
            return message

        await self._application(scope, counted, send)


def _told_length(scope: Message) -> int:
    told = header(scope, b"content-length")
    return int(told) if told.isascii() and told.isdigit() else 0
