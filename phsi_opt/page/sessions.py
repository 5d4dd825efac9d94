"""All sessions of a server, one per browser."""

import tempfile
import time
from pathlib import Path

from phsi_opt.errors import DataError
from phsi_opt.page.session import Session

# Browsers that one server keeps; each may hold a process of about 300 MB.
MOST_SESSIONS = 20
# Seconds without work after which a worker ends; the session keeps its study.
IDLE_WORKER = 600.0
# Seconds without a sign of the browser after which a session is forgotten.
FORGOTTEN_SESSION = 24 * 3600.0


class Sessions:
    """The sessions by the browser's key.

    Args:
        study_file: with which every session begins; None: with nothing.
    """

    def __init__(self, study_file: Path | None = None) -> None:
        self._study_file = study_file
        self._by_key: dict[str, Session] = {}

    def __len__(self) -> int:
        return len(self._by_key)

    def of(self, key: str) -> Session:
        """The session of a browser; a new one where it has none.

        Raises:
            DataError: there are ``MOST_SESSIONS`` already, all with somebody's work.
        """
        if key not in self._by_key:
            self._make_room()
            folder = Path(tempfile.mkdtemp(prefix="phsi_opt_page_"))
            self._by_key[key] = Session(folder, self._study_file)
        session = self._by_key[key]
        session.seen = time.monotonic()
        return session

    def begin_again(self, key: str) -> Session:
        """A new session in the place of the one that a browser has."""
        if key in self._by_key:
            self._by_key.pop(key).close()
        return self.of(key)

    def tidy(self) -> None:
        """End workers without work, and sessions whose browser is gone."""
        for key, session in list(self._by_key.items()):
            if time.monotonic() - session.seen > FORGOTTEN_SESSION:
                self._by_key.pop(key).close()
            elif session.idle_seconds > IDLE_WORKER:
                session.rest()

    def close(self) -> None:
        """End everything."""
        for session in self._by_key.values():
            session.close()
        self._by_key.clear()

    def _make_room(self) -> None:
        """End an empty session where there are too many.

        First goes what no page ever showed, then what was seen longest ago. A session
        that holds somebody's work stays.
        """
        if len(self._by_key) < MOST_SESSIONS:
            return
        empty = [key for key, one in self._by_key.items() if one.is_empty]
        if not empty:
            raise DataError(
                f"this page holds {MOST_SESSIONS} studies, and no more at once. Try "
                "again when somebody has ended one: Menu, Begin again."
            )
        self._by_key.pop(min(empty, key=self._usage)).close()

    def _usage(self, key: str) -> tuple[bool, float]:
        session = self._by_key[key]
        return session.is_shown, session.seen
