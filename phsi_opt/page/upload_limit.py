"""Requests that are too large are refused before they are read.

The browser's own check is a courtesy; this one holds for every client.
"""

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from phsi_opt.page.limits import MOST_UPLOADED, UPLOAD_OVERHEAD, in_megabytes

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Message, Receive, Send], Awaitable[None]]
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
            await _refuse(send)
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
    for name, value in scope["headers"]:
        if name == b"content-length" and value.isdigit():
            return int(value)
    return 0


async def _refuse(send: Send) -> None:
    text = f"A file may have at most {in_megabytes(MOST_UPLOADED)}.".encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": TOO_LARGE, "headers": headers})
    await send({"type": "http.response.body", "body": text})
