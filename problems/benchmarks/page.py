"""How soon the page shows what it has, and twenty sessions at once, in Chromium.

    python -m problems.benchmarks.page

Results: results/page.md.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pandas as pd
from playwright.sync_api import Browser, Page, sync_playwright

from problems.tools import provenance
from problems.tools.pages import render

EXAMPLES = ("Damped spring", "Motor with steps of voltage", "Heated room")
PATIENCE = 120_000  # ms
PRESENT = "The present model"
ADDED = "What was added"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ROUNDS = 9  # of undo, redo and reload, of which the median counts


N_SESSIONS = 20
N_DEATHS = 5  # of workers in the middle of a solve
ENDED = "worker process ended unexpectedly"


@contextmanager
def served() -> Iterator[tuple[str, int]]:
    """The page in a process of its own; its address, and the number of the process."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "phsi_opt.command_line", "page", "--no-show"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    server = subprocess.Popen([*command, "--port", str(port)], env=environment)
    address = f"http://127.0.0.1:{port}"
    try:
        is_up = False
        while not is_up:
            time.sleep(0.2)
            with suppress(OSError):
                is_up = urllib.request.urlopen(address, timeout=5).status == 200
        yield address, server.pid
    finally:
        server.terminate()
        server.wait(10)


def until(page: Page, heading: str, began: float) -> float:
    """Seconds from a press until a heading is there, looked for in every frame."""
    found = f"""[...document.querySelectorAll("h2, h3")].some(
        (one) => one.textContent === "{heading}")"""
    page.wait_for_function(found, polling="raf", timeout=PATIENCE)
    return time.perf_counter() - began


def measured(page: Page, example: str) -> dict[str, float | str]:
    """Seconds of one example, from the press on."""
    undo = page.get_by_role("button", name="Undo")
    redo = page.get_by_role("button", name="Redo")
    page.get_by_text("Or try an example").wait_for(timeout=PATIENCE)
    page.wait_for_timeout(4000)  # a reader looks; the worker starts meanwhile
    began = time.perf_counter()
    page.get_by_role("button", name=example).click()
    found: dict[str, float | str] = {"example": example}
    found["measured data"] = until(page, "What was measured", began)
    found["first fit"] = until(page, PRESENT, began)
    found["verdict"] = until(page, "What is wrong", began)
    add = page.get_by_role("button", name="Add ", exact=False).first
    add.click(timeout=PATIENCE)
    until(page, ADDED, began)
    page.get_by_role("button", name="Cancel").wait_for(state="hidden", timeout=PATIENCE)
    times: dict[str, list[float]] = {"undo": [], "redo": [], "reload": []}
    for _ in range(ROUNDS):
        for name, press, shown in (
            ("undo", undo, "What to add"),
            ("redo", redo, ADDED),
        ):
            began = time.perf_counter()
            press.click()
            times[name].append(until(page, shown, began))
    for _ in range(ROUNDS):
        began = time.perf_counter()
        page.reload(wait_until="commit")
        times["reload"].append(until(page, PRESENT, began))
    for name, each in times.items():
        found[name] = sorted(each)[ROUNDS // 2]
    found["elements"] = page.locator("*").count()
    return found


def crowd(chromium: Browser, address: str, server: int) -> dict[str, float | int]:
    """Twenty sessions that solve at once, each loaded again, five without a worker."""
    began = time.perf_counter()
    pages = [chromium.new_context().new_page() for _ in range(N_SESSIONS)]
    for page in pages:
        page.goto(address, timeout=PATIENCE)
    found: dict[str, float | int] = {"opened (s)": time.perf_counter() - began}
    began = time.perf_counter()
    for k, page in enumerate(pages):
        page.get_by_role("button", name=EXAMPLES[k % len(EXAMPLES)]).click()
        page.get_by_role("button", name="Cancel").wait_for(timeout=PATIENCE)
    workers = children(server)
    for worker in workers[-N_DEATHS:]:
        os.kill(worker, signal.SIGKILL)
    for page in pages:
        page.reload(timeout=PATIENCE)
    n_told = 0
    for page in pages:
        told = page.get_by_text(ENDED)
        verdict = page.get_by_role("heading", name="What is wrong")
        told.or_(verdict).first.wait_for(timeout=5 * PATIENCE)
        if verdict.count() == 0:  # what was lost is done again at a press
            n_told += 1
            page.get_by_role("button", name="Fit", exact=True).click()
    for page in pages:
        until(page, "What is wrong", began)
    found |= {"all solved (s)": time.perf_counter() - began}
    found |= {"workers killed": N_DEATHS, "sessions that told it": n_told}
    found |= {"server (MB)": megabytes(server)}
    found |= {"workers (MB)": sum(map(megabytes, children(server)))}
    for page in pages:
        page.context.close()
    return found


def children(process: int) -> list[int]:
    """The processes that a process has begun, the oldest first."""
    of = Path(f"/proc/{process}/task")
    return sorted(int(n) for one in of.iterdir() for n in read(one / "children"))


def megabytes(process: int) -> float:
    """The memory of a process that no other one shares."""
    words = read(Path(f"/proc/{process}/smaps_rollup"))
    return int(words[words.index("Pss:") + 1]) / 1000


def read(path: Path) -> list[str]:
    """The words of a file of the system; none where its process has ended."""
    return path.read_text().split() if path.exists() else []


def main() -> None:
    """Measure, and write the page."""
    path = next(filter(None, map(shutil.which, BROWSERS)))
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    rows = []
    with served() as (address, server), sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=arguments)
        for example in EXAMPLES:
            page = chromium.new_context().new_page()
            page.goto(address, timeout=PATIENCE)
            rows.append(measured(page, example))
            page.context.close()
    load = f"{os.getloadavg()[0]:.1f}"
    # In a server of its own, which has no sessions yet.
    with served() as (address, server), sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=arguments)
        many = crowd(chromium, address, server)
    table = pd.DataFrame(rows).round(2)
    print(table.to_string(index=False))
    crowded = pd.Series(many).round(0).astype(int)
    print(crowded.to_string())
    said = render("benchmarks/pages/page.md", rows=table, crowd=crowded, load=load)
    provenance.write("page.md", said)


if __name__ == "__main__":
    main()
