"""Requests that are not the page's own are refused: of other sites, or other browsers.

What changes something (uploads, the socket through which the page tells what was
pressed) needs the cookie of the browser that loaded this page, which no other site may
send along.
"""

import re
from collections.abc import Callable
from urllib.parse import parse_qs, urlsplit

from phsi_opt.page.asgi import Application, Message, Receive, Send, answer, header

FORBIDDEN = 403
POLICY_VIOLATION = 1008  # of a websocket
READING = ("GET", "HEAD")
SOCKET = "/_nicegui_ws"
# Where NiceGUI puts what belongs to one page that was loaded, such as its uploads.
OF_CLIENT = re.compile(r"/_nicegui/client/([^/]+)/")
OTHER_SITE = "This request comes from another site; only the page's own are taken."
OTHER_BROWSER = (
    "This request has not the cookie of the browser that loaded the page; load the "
    "page again, with cookies allowed."
)
# A link of another site comes without the cookie. Loaded again from here, it has it.
LOAD_AGAIN = (
    '<!doctype html><title>phsi_opt</title><meta http-equiv="refresh" content="0">'
)


class OwnRequests:
    """An application (ASGI) that passes on the page's own requests.

    Args:
        application: the one behind it.
        owner_of: the key of the browser that loaded a page, by the page's number; None
            where there is no such page.
        cookie: the name of the session's cookie.
    """

    def __init__(
        self,
        application: Application,
        owner_of: Callable[[str], str | None],
        cookie: str,
    ) -> None:
        self._application = application
        self._owner_of = owner_of
        self._cookie = cookie

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Pass it on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._application(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": POLICY_VIOLATION})
        elif refusal:
            self._keep_cookie(scope)
            await answer(send, FORBIDDEN, refusal)
        elif self._is_followed_link(scope):
            self._keep_cookie(scope)
            await answer(send, 200, LOAD_AGAIN, "text/html")
        else:
            await self._application(scope, receive, send)

    def _refusal(self, scope: Message) -> str:
        """Why a request is refused; "" where it is the page's own."""
        origin = header(scope, b"origin")
        if origin and not is_own_origin(origin, header(scope, b"host")):
            return OTHER_SITE
        if _changes(scope) and not self._is_of_owner(scope):
            return OTHER_BROWSER
        return ""

    def _is_of_owner(self, scope: Message) -> bool:
        """Whether it comes from the browser that loaded the page it speaks for."""
        query = parse_qs(scope.get("query_string", b"").decode("latin-1"))
        found = OF_CLIENT.match(scope["path"])
        client = found[1] if found else query.get("client_id", [""])[0]
        owner = self._owner_of(client)
        if owner is None and scope["path"].startswith(SOCKET):
            # A page of a server that ended: NiceGUI tells it to load itself anew.
            return query.get("implicit_handshake") == ["true"] and bool(client)
        return owner is not None and owner == scope["session"].get("id")

    def _is_followed_link(self, scope: Message) -> bool:
        if self._has_cookie(scope):
            return False
        return header(scope, b"sec-fetch-site") == "cross-site"

    def _has_cookie(self, scope: Message) -> bool:
        return f"{self._cookie}=" in header(scope, b"cookie")

    def _keep_cookie(self, scope: Message) -> None:
        """Let no new cookie take the place of the one that the browser did not send."""
        if not self._has_cookie(scope):
            scope["session"].clear()


def is_own_origin(origin: str, host: str) -> bool:
    """Whether a page of this origin was loaded from this host and port."""
    try:
        parts = urlsplit(origin.lower())
    except ValueError:
        return False
    is_of_web = parts.scheme in ("http", "https") and bool(parts.netloc)
    return is_of_web and parts.netloc == host.lower()


def _changes(scope: Message) -> bool:
    """Whether a request may change something; polling the socket does."""
    if scope["type"] == "websocket" or scope["path"].startswith(SOCKET):
        return True
    return scope["method"] not in READING
