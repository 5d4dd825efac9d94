"""Who may change a session of the page, and what files of strangers can do: nothing."""

import http.client
import pickle
import re
import secrets
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode, urlsplit

import pytest

import phsi_opt as ph
import phsi_opt.page
from phsi_opt.page.guards import is_own_origin
from phsi_opt.page.serve import Sessions
from phsi_opt.page.session import Session
from tests.page_tools import loaded_table, served
from tests.waiting import HANGS_AFTER, wait_for

FORBIDDEN = 403
SWITCHED = 101  # to a websocket
TABLE = b"t,q\n0,1\n1,3\n2,2\n"
HEADERS = {
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}
STRANGE_NAMES = [
    *("", ".", "..", "\0.csv", "a\nb.csv", "\udcff.csv"),
    *("study.checkpoint", "table", ".csv.exe"),
]


@dataclass
class Answer:
    """What a server answers: a status, headers in lower case, and a text."""

    status: int
    headers: dict[str, str]
    body: str


class Visitor:
    """A plain HTTP client that has loaded the page."""

    def __init__(self, address: str) -> None:
        self.place = urlsplit(address)
        self.origin = address
        self.loaded = self.ask("GET", "/")
        self.cookie = self.loaded.headers["set-cookie"].partition(";")[0]
        found = re.search("/_nicegui/client/([^/]+)/upload/[0-9]+", self.loaded.body)
        assert found is not None
        self.upload_path = found[0]
        self.client = found[1]

    def ask(
        self, method: str, path: str, body: bytes | None = None, /, **headers: str
    ) -> Answer:
        port = self.place.port
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=HANGS_AFTER)
        told = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, body, told)
        answer = connection.getresponse()
        switched = answer.status == SWITCHED
        text = "" if switched else answer.read().decode()
        found = {name.lower(): value for name, value in answer.getheaders()}
        connection.close()
        return Answer(answer.status, found, text)

    def upload(self, name: str, content: bytes, **headers: str) -> Answer:
        """Post a file as a form does."""
        sign = secrets.token_hex(8)
        head = (
            f'--{sign}\r\nContent-Disposition: form-data; name="f"; '
            f'filename="{name}"\r\nContent-Type: text/csv\r\n\r\n'
        )
        body = head.encode() + content + f"\r\n--{sign}--\r\n".encode()
        kind = f"multipart/form-data; boundary={sign}"
        return self.ask("POST", self.upload_path, body, Content_Type=kind, **headers)

    def socket_path(self, transport: str, client: str = "") -> str:
        query = {
            "EIO": "4",
            "transport": transport,
            "client_id": client or self.client,
            "next_message_id": "0",
            "implicit_handshake": "true",
        }
        return f"/_nicegui_ws/socket.io/?{urlencode(query)}"

    def open_socket(self, client: str = "", **headers: str) -> Answer:
        """Ask for a websocket, as the page does when it is loaded."""
        key = {"Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ=="}
        told = {"Connection": "Upgrade", "Upgrade": "websocket", **key, **headers}
        told["Sec_WebSocket_Version"] = "13"
        return self.ask("GET", self.socket_path("websocket", client), **told)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("server")


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    pytest.importorskip("nicegui", reason="needs the extra 'app'")
    with served(folder) as found:
        yield found


@pytest.fixture
def visitor(address: str) -> Visitor:
    return Visitor(address)


def uploaded(folder: Path) -> list[Path]:
    return list(folder.glob("phsi_opt_page_*/uploads/*"))


# ---- files ---------------------------------------------------------------------------


def test_nothing_that_is_uploaded_is_run(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    session = Session(tmp_path / "own")
    content = loaded_table(marker)
    state = ("working_study.toml", "fitted_study.toml", "report.html")
    for name in ("study.checkpoint", "innocent.csv", *state):
        session.upload(name, content)
    session.rest()
    session.diagnose()  # answered once the worker is there
    wait_for(lambda: session.job is None)
    assert session.message.startswith("Nothing has been fitted yet")
    session.close()
    assert not marker.exists()
    pickle.loads(content)
    assert marker.exists(), "where it is unpickled, it does run"


def test_the_page_reads_no_pickle_and_parses_no_name_as_an_attribute() -> None:
    (room,) = phsi_opt.page.__path__
    for path in Path(room).glob("*.py"):
        code = path.read_text()
        imported = r"^ *(import|from) (pickle|marshal|shelve|joblib)\b"
        assert not re.search(imported, code, re.MULTILINE), path
        assert not re.search(r"\.props\(\s*r?f", code), path


@pytest.mark.parametrize("name", STRANGE_NAMES, ids=repr)
def test_a_name_that_no_table_has_is_refused_in_a_sentence(name, tmp_path) -> None:
    session = Session(tmp_path)
    assert not session.upload(name, TABLE)
    session.close()
    assert re.search(r"; expected .+\.$", session.upload_error)
    assert session.draft.data is None
    assert session.upload_error.isprintable()
    assert len(session.upload_error) < 300


@pytest.mark.parametrize(
    "name", ["spring.csv", "Meßreihe 3 (neu).CSV", "a:b*?.txt", "a" * 251 + ".csv"]
)
def test_a_users_name_is_shown_and_stands_in_no_path(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Session, "_call", lambda _, __, read, *given: read(*given))
    monkeypatch.setattr(Session, "_ready_worker", lambda _: None)
    session = Session(tmp_path / "own")
    assert session.upload(name, TABLE), session.upload_error
    assert session.draft.data is not None
    assert session.draft.content()["data"]["files"] == [name]
    assert session.draft.data.runs == [Path(name).stem]
    stored = [path.name for path in session.folder.rglob("*")]
    assert sorted(stored) == [
        "state",
        "table_1" + Path(name).suffix.lower(),
        "uploads",
        "working_study.toml",
    ]
    session.upload(name, b"t,q\n0,1\n1,x\n2,2\n3,4\n")
    found = {one.key: one.said for one in session.check()}
    session.close()
    assert f"file {name!r}, column 'q', line 3" in found["data.states.q.column"]


# ---- requests ------------------------------------------------------------------------


def test_an_upload_without_the_cookie_of_its_session_is_refused(
    visitor: Visitor, address: str, folder: Path
) -> None:
    known = uploaded(folder)
    assert visitor.upload("a.csv", TABLE).status == FORBIDDEN
    stranger = Visitor(address)
    assert visitor.upload("a.csv", TABLE, Cookie=stranger.cookie).status == FORBIDDEN
    told, _, signature = visitor.cookie.rpartition(".")
    # The first letter: all of its bits count, of the last one's only some do.
    forged = f"{told}.{'B' if signature[0] == 'A' else 'A'}{signature[1:]}"
    assert visitor.upload("a.csv", TABLE, Cookie=forged).status == FORBIDDEN
    assert uploaded(folder) == known


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://localhost"]
)
def test_another_site_may_neither_upload_nor_connect_nor_read(
    visitor: Visitor, origin: str, folder: Path
) -> None:
    known = uploaded(folder)
    from_there = {"Origin": origin, "Cookie": visitor.cookie}
    polling = visitor.socket_path("polling")
    for answer in (
        visitor.upload("a.csv", TABLE, **from_there),
        visitor.open_socket(**from_there),
        visitor.ask("GET", polling, **from_there),
        visitor.ask("POST", polling, b"1", **from_there),
        visitor.ask("GET", "/", **from_there),
        visitor.ask("OPTIONS", visitor.upload_path, **from_there),
    ):
        assert answer.status == FORBIDDEN
        assert "access-control-allow-origin" not in answer.headers
    assert uploaded(folder) == known


def test_the_page_itself_connects_and_uploads(visitor: Visitor, folder: Path) -> None:
    known = uploaded(folder)
    own = {"Cookie": visitor.cookie, "Origin": visitor.origin}
    assert visitor.open_socket(**own).status == SWITCHED
    answer = visitor.ask("GET", visitor.socket_path("polling"), **own)
    assert answer.status == 200
    assert answer.headers["access-control-allow-origin"] == visitor.origin
    assert visitor.upload("a.csv", TABLE, **own).status == 200
    wait_for(lambda: len(uploaded(folder)) == len(known) + 1)


def test_a_socket_needs_the_cookie_of_its_page(visitor: Visitor, address: str) -> None:
    stranger = Visitor(address)
    for cookie in ("a=b", stranger.cookie):
        assert visitor.open_socket(Cookie=cookie).status == FORBIDDEN
        polling = visitor.socket_path("polling")
        assert visitor.ask("GET", polling, Cookie=cookie).status == FORBIDDEN
    bare = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
    assert visitor.ask("GET", bare, Cookie=visitor.cookie).status == FORBIDDEN


@pytest.mark.parametrize(("origin", "host", "is_own"), [
    ("http://lab:8080", "LAB:8080", True),
    ("https://lab.example", "lab.example", True),  # behind a server with TLS
    ("http://[fe80::1]:8080", "[fe80::1]:8080", True),
    ("http://lab:8081", "lab:8080", False),
    ("http://lab", "lab:8080", False),
    ("http://lab.evil.example", "lab", False),
    ("http://lab@evil.example", "lab", False),
    ("file://lab", "lab", False),
    ("http://[lab", "lab", False),
    ("null", "null", False),
    ("http://", "", False),
])  # fmt: skip
def test_on_a_network_a_page_is_known_by_the_host_it_was_loaded_from(
    origin: str, host: str, is_own: bool
) -> None:
    assert is_own_origin(origin, host) == is_own


def test_a_link_of_another_site_begins_no_session_in_place_of_the_known(
    visitor: Visitor,
) -> None:
    followed = visitor.ask("GET", "/", Sec_Fetch_Site="cross-site")
    assert "set-cookie" not in followed.headers
    assert 'http-equiv="refresh"' in followed.body
    assert "/_nicegui/client/" not in followed.body
    again = visitor.ask("GET", "/", Cookie=visitor.cookie, Sec_Fetch_Site="same-origin")
    assert "/_nicegui/client/" in again.body


def test_answers_say_what_a_browser_may_do_with_them(visitor: Visitor) -> None:
    static = re.search(r"/_nicegui/[^\"]+/nicegui\.js", visitor.loaded.body)
    assert static is not None
    refused = visitor.upload("a.csv", TABLE)
    for answer in (visitor.loaded, visitor.ask("GET", static[0]), refused):
        policy = answer.headers["content-security-policy"]
        for rule in ("default-src 'self'", "frame-ancestors 'none'", "base-uri 'none'"):
            assert rule in policy
        (scripts,) = [one for one in policy.split("; ") if one.startswith("script-src")]
        assert "unsafe-inline" not in scripts
        assert HEADERS.items() <= answer.headers.items()
    told = visitor.loaded.headers["set-cookie"].lower()
    assert told.startswith(f"phsi_opt_{visitor.place.port}=")
    assert "samesite=strict" in told and "httponly" in told
    assert visitor.ask("GET", "/", Host="evil.example").status == 400


# ---- sessions ------------------------------------------------------------------------


def test_a_session_with_work_is_kept_and_the_next_is_refused_in_a_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Session, "_ready_worker", lambda _: None)
    sessions = Sessions(most=3)
    for number in range(3):
        made = sessions.of(str(number))
        if number == 0:
            made.draft.model.table["states"] = ["q", "p"]  # typed, no table yet
        else:
            assert made.upload("a.csv", TABLE)
            made.rest()
    with pytest.raises(ph.DataError, match="allows 3 studies"):
        sessions.of("one too many")
    begun = sessions.begin_again("2")
    assert begun.is_empty
    sessions.of("another")
    assert begun.is_closed, "the empty session made room"
    assert not begun.upload("a.csv", TABLE)
    assert "load the page again" in begun.upload_error
    begun.diagnose()
    assert begun.job is None, "nothing begins in what has ended"
    sessions.close()
