"""How soon the page shows what it has: its examples, in Chromium.

    python -m problems.benchmarks.page

Results: results/page.md.
"""

import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pandas as pd
from playwright.sync_api import Page, sync_playwright

from problems.tools import provenance
from problems.tools.pages import render

EXAMPLES = ("Damped spring", "Motor with steps of voltage", "Heated room")
PATIENCE = 120_000  # ms
PRESENT = "The present model"
ADDED = "What was added"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ROUNDS = 9  # of undo, redo and reload, of which the median counts


@contextmanager
def served() -> Iterator[str]:
    """The page in a process of its own; its address."""
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
        yield address
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


def main() -> None:
    """Measure, and write the page."""
    path = next(filter(None, map(shutil.which, BROWSERS)))
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    rows = []
    with served() as address, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=arguments)
        for example in EXAMPLES:
            page = chromium.new_context().new_page()
            page.goto(address, timeout=PATIENCE)
            rows.append(measured(page, example))
            page.context.close()
        chromium.close()
    table = pd.DataFrame(rows).round(2)
    print(table.to_string(index=False))
    load = f"{os.getloadavg()[0]:.1f}"
    provenance.write(
        "page.md", render("benchmarks/pages/page.md", rows=table, load=load)
    )


if __name__ == "__main__":
    main()
