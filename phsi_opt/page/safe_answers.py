"""Headers of all answers: what a browser may load, run and show of the page.

Scripts come from the server alone, or stand in its HTML with a number that is new each
time. NiceGUI compiles what it draws in the browser, so "unsafe-eval" cannot go; its
style sheets and Tailwind's are written in the browser too.
"""

import secrets

from phsi_opt.page.asgi import Application, Message, Receive, Send

POLICY = (
    "default-src 'self'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
HEADERS = (
    (b"x-frame-options", b"DENY"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
)


class SafeAnswers:
    """An application (ASGI) whose answers have these headers.

    Args:
        application: the one behind it.
    """

    def __init__(self, application: Application) -> None:
        self._application = application

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Pass on the request; complete the answer."""
        if scope["type"] == "http":
            send = _Completed(send).send
        await self._application(scope, receive, send)


class _Completed:
    """One answer on its way: its headers wait for its body where that is HTML."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._nonce = secrets.token_urlsafe(16)
        self._start: Message = {}
        self._body = b""

    async def send(self, message: Message) -> None:
        """Send a part, or keep it until all of a page is there."""
        if message["type"] == "http.response.start":
            policy = POLICY.format(nonce=self._nonce).encode()
            further = [*HEADERS, (b"content-security-policy", policy)]
            message = {**message, "headers": [*message["headers"], *further]}
            if _is_html(message):
                self._start = message
                return
        elif self._start:
            self._body += message.get("body", b"")
            if not message.get("more_body", False):
                await self._send_page()
            return
        await self._send(message)

    async def _send_page(self) -> None:
        """The page; each of its scripts bears the number of the policy."""
        marked = f'<script nonce="{self._nonce}"'.encode()
        body = self._body.replace(b"<script", marked)
        headers = []
        for name, value in self._start["headers"]:
            is_length = name.lower() == b"content-length"
            headers.append((name, str(len(body)).encode() if is_length else value))
        await self._send({**self._start, "headers": headers})
        await self._send({"type": "http.response.body", "body": body})


def _is_html(message: Message) -> bool:
    for name, value in message["headers"]:
        if name.lower() == b"content-type":
            return bool(value.startswith(b"text/html"))
    return False
