"""Serving the page: on this machine alone, unless told otherwise."""

import ipaddress
import secrets
from pathlib import Path

from phsi_opt.errors import DataError
from phsi_opt.page.sessions import Sessions
from phsi_opt.study_file.study_file import StudyFile

TIDY_EVERY = 60.0  # s between looks for sessions that nobody uses
# s for which a page that lost its connection keeps its fields: a phone that slept, a
# machine that is busy. After it the page is loaded again; the session stays anyway.
RECONNECT_WITHIN = 30.0
UNAVAILABLE = 503
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
        from nicegui import Client, app, ui
    except ImportError as error:
        raise DataError(
            "the page needs NiceGUI, which is not installed: "
            "pip install 'phsi_opt[app]'."
        ) from error
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.responses import PlainTextResponse

    from phsi_opt.page.guards import OwnRequests, SafeAnswers, UploadLimit
    from phsi_opt.page.shell import Shell

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

    def page() -> PlainTextResponse | None:
        key = app.storage.browser["id"]
        try:
            session = sessions.of(key)
        except DataError as error:
            return PlainTextResponse(str(error), status_code=UNAVAILABLE)
        Shell(session, lambda: sessions.begin_again(key)).build()
        return None

    ui.page("/", title="phsi_opt")(page)
    app.on_startup(lambda: app.timer(TIDY_EVERY, sessions.tidy))
    app.on_shutdown(sessions.close)
    ui.run(
        host=host,
        port=port,
        show=show,
        reload=False,
        title="phsi_opt",
        reconnect_timeout=RECONNECT_WITHIN,
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
