"""All sessions of a server, one per browser."""

import tempfile
import time
from pathlib import Path

from phsi_opt.page.limits import FORGOTTEN_SESSION, IDLE_WORKER, MOST_SESSIONS
from phsi_opt.page.session import Session


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
        """The session of a browser; a new one where it has none."""
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
        """Forget the session that was seen longest ago, where there are too many."""
        if len(self._by_key) < MOST_SESSIONS:
            return
        oldest = min(self._by_key, key=lambda key: self._by_key[key].seen)
        self._by_key.pop(oldest).close()
