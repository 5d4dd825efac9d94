"""How tests wait for other processes and threads: for the event, not for the clock."""

import subprocess
import time
from collections.abc import Callable
from typing import Any

# s; far beyond what a busy machine takes for anything here, so that only a hang ends it.
HANGS_AFTER = 600.0


def wait_for(
    is_done: Callable[[], bool], process: "subprocess.Popen[Any] | None" = None
) -> None:
    """Look until something is so; it fails at once if the process has ended."""
    end = time.monotonic() + HANGS_AFTER
    while not is_done():
        has_ended = process is not None and process.poll() is not None
        assert not has_ended, "the process that is waited for has ended"
        assert time.monotonic() < end, "it hangs"
        time.sleep(0.02)
