"""What stands before the page: refuse what is not its own or too large, mark answers.

Requests of other sites, or of other browsers than the one that loaded a page, are
refused: what changes something (uploads, the socket through which the page tells what
was pressed) needs the cookie of that browser, which no other site may send along.

Answers say what a browser may load, run and show. Scripts come from the server alone,
or stand in its HTML with a number that is new each time. NiceGUI compiles what it draws
in the browser, so "unsafe-eval" cannot go; its style sheets are written there too.
"""

import re
import secrets
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from starlette import status
from starlette.middleware.base import BaseHTTPMiddleware, RequestResponseEndpoint
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from phsi_opt.page.drafts import MOST_UPLOADED, in_megabytes

READING = ("GET", "HEAD")
SOCKET = "/_nicegui_ws"
# Where NiceGUI puts what belongs to one page that was loaded, such as its uploads.
OF_CLIENT = re.compile(r"/_nicegui/client/([^/]+)/")
OTHER_SITE = (
    "This request comes from another site; only requests of this page are accepted."
)
OTHER_BROWSER = (
    "This request has no cookie of the browser that loaded the page; allow "
    "cookies and load the page again."
)
# A link of another site comes without the cookie. Loaded again from here, it has it.
LOAD_AGAIN = (
    '<!doctype html><title>phsi_opt</title><meta http-equiv="refresh" content="0">'
)
POLICY = (
    "default-src 'self'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
HEADERS = {
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}


@dataclass(frozen=True)
class OwnRequests:
    """An application (ASGI) that passes on the page's own requests."""

    app: ASGIApp  # the one behind it
    # The key of the browser that loaded a page, by the page's number; None where
    # there is no such page.
    owner_of: Callable[[str], str | None]
    cookie: str  # the name of the session's cookie

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        refusal = self._refusal(request)
        has_cookie = self.cookie in request.cookies
        is_link = request.headers.get("sec-fetch-site") == "cross-site"
        if refusal and scope["type"] == "websocket":
            await send(
                {"type": "websocket.close", "code": status.WS_1008_POLICY_VIOLATION}
            )
            return
        if not refusal and (has_cookie or not is_link):
            await self.app(scope, receive, send)
            return
        if not has_cookie:  # no new one may take the place of the one not sent
            request.session.clear()
        again = HTMLResponse(LOAD_AGAIN)
        answer = PlainTextResponse(refusal, HTTPStatus.FORBIDDEN) if refusal else again
        await answer(scope, receive, send)

    def _refusal(self, request: HTTPConnection) -> str:
        """Why a request is refused; "" where it is the page's own."""
        headers = request.headers
        origin = headers.get("origin", "")
        if origin and not is_own_origin(origin, headers.get("host", "")):
            return OTHER_SITE
        scope = request.scope
        is_socket = scope["path"].startswith(SOCKET)
        changes = is_socket or scope.get("method") not in READING
        return OTHER_BROWSER if changes and not self._is_of_owner(request) else ""

    def _is_of_owner(self, request: HTTPConnection) -> bool:
        """Whether it comes from the browser that loaded the page it speaks for."""
        path = request.scope["path"]
        query = request.query_params
        found = OF_CLIENT.match(path)
        client = found[1] if found else query.get("client_id", "")
        owner = self.owner_of(client)
        if owner is None and path.startswith(SOCKET):
            # A page of a server that ended: NiceGUI tells it to load itself anew.
            return query.get("implicit_handshake") == "true" and bool(client)
        return owner is not None and owner == request.session.get("id")


def is_own_origin(origin: str, host: str) -> bool:
    """Whether a page of this origin was loaded from this host and port."""
    scheme, _, own = origin.lower().partition("://")
    return scheme in ("http", "https") and own == host.lower() != ""


@dataclass(frozen=True)
class UploadLimit:
    """An application (ASGI) that passes on what is small enough."""

    app: ASGIApp  # the one behind it
    # Bytes of a request's body: a file, with names and boundaries.
    most: int = MOST_UPLOADED + 100_000

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse by the length that is told, or cut off what is longer than told."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        told = HTTPConnection(scope).headers.get("content-length", "")
        if told.isascii() and told.isdigit() and int(told) > self.most:
            refusal = f"A file may have at most {in_megabytes(MOST_UPLOADED)}."
            await PlainTextResponse(refusal, 413)(scope, receive, send)
            return
        n_received = 0

        async def counted() -> Message:
            nonlocal n_received
            message = await receive()
            n_received += len(message.get("body", b""))
            if n_received > self.most:
                return {"type": "http.disconnect"}
            return message

        await self.app(scope, counted, send)


class SafeAnswers(BaseHTTPMiddleware):
    """An application (ASGI) whose answers have the headers above."""

    async def dispatch(
        self, request: Request, call_next: RequestResponseEndpoint
    ) -> Response:
        """Pass on the request; complete the answer.

        HTML waits until all of it is there: each of its scripts gets the number.
        """
        nonce = secrets.token_urlsafe(16)
        answer: Any = await call_next(request)
        answer.headers.update(HEADERS)
        answer.headers["content-security-policy"] = POLICY.format(nonce=nonce)
        if answer.headers.get("content-type", "").startswith("text/html"):
            page = b"".join([part async for part in answer.body_iterator])
            page = page.replace(b"<script", f'<script nonce="{nonce}"'.encode())
            answer.headers["content-length"] = str(len(page))
            answer.body_iterator = _at_once(page)
        made: Response = answer
        return made


async def _at_once(page: bytes) -> AsyncIterator[bytes]:
    yield page
