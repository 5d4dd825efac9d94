"""Serving the page: on this machine alone, unless told otherwise."""

import gc
import ipaddress
import secrets
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http import HTTPStatus
from pathlib import Path

from phsi_opt.errors import DataError
from phsi_opt.page.session import Session
from phsi_opt.presentation.units import measure_of
from phsi_opt.study_file.study_file import StudyFile

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")


def serve(
    study_file: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    show: bool = True,
) -> None:
    """Serve the page until the process is ended.

    Each browser has a study of its own. Solves run in processes of their own, which end
    with this one. Whoever reaches the address may use the page: it has no passwords, so
    leave ``host`` as it is unless the network is your own.

    Args:
        study_file: with which every study begins; None: with nothing.
        host: the address to listen at; the default is reached from this machine alone.
        port: of the address.
        show: whether to open a browser.

    Raises:
        DataError: the extra ``app`` is not installed.
        StudyFileError: the study file cannot be used.
    """
    if study_file is not None:
        StudyFile.read(study_file)
    try:
        from nicegui import Client, app, run, ui
    except ImportError as error:
        raise DataError(
            "the page needs NiceGUI, which is not installed: "
            "pip install 'phsi_opt[app]'."
        ) from error
    from starlette.middleware.gzip import GZipMiddleware
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.responses import PlainTextResponse

    from phsi_opt.page.guards import OwnRequests, SafeAnswers, UploadLimit
    from phsi_opt.page.shell import Shell

    threading.Thread(target=measure_of, args=("degC",)).start()  # units take a while
    sessions = Sessions(study_file)
    # Cookies go to all ports of a machine: each server has a name for its own.
    cookie = f"phsi_opt_{port}"

    def owner_of(client_id: str) -> str | None:
        client = Client.instances.get(client_id)
        return None if client is None else client.request.session.get("id")

    app.add_middleware(UploadLimit)
    app.add_middleware(OwnRequests, owner_of=owner_of, cookie=cookie)
    if is_loopback(host):  # no other site may reach it through the browser
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=list(LOOPBACK_NAMES))
    app.add_middleware(SafeAnswers)

    async def page() -> PlainTextResponse | None:
        key = app.storage.browser["id"]
        try:
            session = await run.io_bound(sessions.of, key)
        except DataError as error:
            return PlainTextResponse(
                str(error), status_code=HTTPStatus.SERVICE_UNAVAILABLE
            )
        if session is not None:  # None: the server ends
            Shell(session, partial(run.io_bound, sessions.begin_again, key)).build()
        return None

    # Threads that wait for a process; the usual six would let others wait for them.
    run.thread_pool = ThreadPoolExecutor(5 * sessions.most)
    ui.page("/", title="phsi_opt", response_timeout=600.0)(page)
    app.on_startup(gc.freeze)  # what is imported needs no search: 0.1 s of every page
    app.on_startup(lambda: app.timer(60.0, partial(run.io_bound, sessions.tidy)))
    app.on_shutdown(sessions.close)
    ui.run(
        host=host,
        port=port,
        show=show,
        reload=False,
        title="phsi_opt",
        tailwind=False,  # it would style every change anew, in the browser
        # For so many seconds a page that lost its connection keeps its fields (a phone
        # that slept); then it is loaded again. The session stays anyway.
        reconnect_timeout=30.0,
        # Level 9, the default, takes 16 ms of every page for 15 % fewer bytes.
        gzip_middleware_factory=partial(GZipMiddleware, compresslevel=1),
        storage_secret=secrets.token_hex(32),
        session_middleware_kwargs={"session_cookie": cookie, "same_site": "strict"},
    )


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


# ---- a session for each browser ------------------------------------------------------


class Sessions:
    """The sessions by the browser's key; each begins with the study file, if any.

    At most so many are kept; each may hold a process of about 300 MB.
    """

    def __init__(self, study_file: Path | None = None, most: int = 20) -> None:
        self._study_file = study_file
        self.most = most
        self._by_key: dict[str, Session] = {}
        self._making = threading.Lock()  # two windows of a browser have one session

    def of(self, key: str) -> Session:
        """The session of a browser; a new one where it has none."""
        with self._making:
            if key not in self._by_key:
                self._make_room()
                folder = Path(tempfile.mkdtemp(prefix="phsi_opt_page_"))
                self._by_key[key] = Session(folder, self._study_file)
            session = self._by_key[key]
        session.seen = time.monotonic()
        return session

    def begin_again(self, key: str) -> Session:
        if key in self._by_key:
            self._by_key.pop(key).close()
        return self.of(key)

    def tidy(self) -> None:
        """End workers after ten minutes without work; forget sessions after a day.

        A session that ends its worker keeps its study; one is forgotten that no browser
        has shown for so long.
        """
        for key, session in list(self._by_key.items()):
            if time.monotonic() - session.seen > 24 * 3600:
                self._by_key.pop(key).close()
            else:
                session.rest(after=600.0)

    def close(self) -> None:
        for session in list(self._by_key.values()):
            session.close()
        self._by_key.clear()

    def _make_room(self) -> None:
        """End an empty session where there are too many."""
        # First goes what no page ever showed, then what was seen longest ago. A session
        # that holds somebody's work stays.
        if len(self._by_key) < self.most:
            return
        known = self._by_key.items()
        empty = [((s.is_shown, s.seen), key) for key, s in known if s.is_empty]
        if not empty:
            raise DataError(
                f"this page allows {self.most} studies at a time. Try again when "
                "another user has ended a study (New, above)."
            )
        _, first = min(empty)
        self._by_key.pop(first).close()
