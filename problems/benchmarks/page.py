"""How soon the page shows what it has, and twenty studies at once, in Chromium.

    python -m problems.benchmarks.page

Results: results/page.md.
"""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from playwright.sync_api import Browser, Page, sync_playwright

from problems.tools import provenance
from problems.tools.pages import render

EXAMPLES = ("Damped spring", "Motor with steps of voltage", "Heated room")
PATIENCE = 120_000  # ms
PRESENT = "The present model"
ADDED = "What was missing"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ROUNDS = 9  # of undo, redo and reload, of which the median counts
N_SESSIONS = 20
N_KILLED = 5  # workers in the middle of a solve
SECONDS_BETWEEN = 5.0  # from one kill to the next, so that solves are at all stages
# What a page says of its work: whether it goes on, in which words, and of a verdict.
SAID = """() => ({
  works: [...document.querySelectorAll("button")].some(
    (one) => one.textContent.trim() === "Cancel" && one.offsetParent),
  words: document.querySelector(".q-footer [role=status]")?.textContent ?? "",
  verdict: [...document.querySelectorAll("h3")].some(
    (one) => one.textContent === "What is wrong")})"""
WAITING = re.compile("waiting until ([0-9]+) other")
GO_ON = re.compile("^(Fit|Diagnose)$")
TIMES = ["waits for", "begun", "loaded again", "killed", "begun again", "verdict"]
COLUMNS = ["example", *TIMES]


@contextmanager
def served() -> Iterator[tuple[str, int]]:
    """The page in a process of its own; its address and the number of the process."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "phsi_opt.command_line", "page", "--no-show"]
    server = subprocess.Popen([*command, "--port", str(port)])
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
            ("undo", undo, "What is missing"),
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


@dataclass
class Watched:
    """One study of many: its page, and when in s what happened to it."""

    page: Page
    row: dict[str, Any] = field(default_factory=dict)

    def look(self, now: float) -> None:
        """Note what is new, load the page again in its solve, go on after a kill."""
        said = self.page.evaluate(SAID)
        if waiting := WAITING.search(said["words"]):
            self.row.setdefault("waits for", int(waiting[1]))
        elif said["works"]:
            self.row.setdefault("begun again" if "killed" in self.row else "begun", now)
            if "loaded again" not in self.row:
                self.row["loaded again"] = now
                self.page.reload(timeout=PATIENCE)
        elif "unexpectedly" in said["words"]:
            self.row["killed"] = now
            self.page.get_by_role("button", name=GO_ON).click(timeout=PATIENCE)
        elif said["verdict"]:
            self.row.setdefault("verdict", now)


def crowd(chromium: Browser, address: str, server: int) -> dict[str, Any]:
    """What happened to many studies at once, in s, and their memory in MB."""
    memory = {"no study": megabytes(server)}
    watched = [Watched(chromium.new_context().new_page()) for _ in range(N_SESSIONS)]
    for one in watched:
        one.page.goto(address, timeout=PATIENCE)
    used = idle = until_idle(server)
    memory["all opened"] = memory["most"] = megabytes(server)
    began = killed_at = time.perf_counter()
    for k, one in enumerate(watched):
        one.row["example"] = EXAMPLES[k % len(EXAMPLES)]
        one.page.get_by_role("button", name=one.row["example"]).click()
    n_killed = 0
    while not all("verdict" in one.row for one in watched):
        time.sleep(1.0)
        for one in watched:
            one.look(time.perf_counter() - began)
        memory["most"] = max(memory["most"], megabytes(server), key=sum)
        before, used = used, {worker: computed(worker) for worker in used}
        solving = max(used, key=lambda worker: used[worker] - before[worker])
        is_time = time.perf_counter() - killed_at > SECONDS_BETWEEN
        if n_killed < N_KILLED and is_time and used[solving] > before[solving]:
            os.kill(solving, signal.SIGKILL)
            n_killed, killed_at = n_killed + 1, time.perf_counter()
    memory["all solved"] = megabytes(server)
    load = os.getloadavg()[0]
    alive = {worker: computed(worker) for worker in children(server)}
    spent = sum(alive.values()) - sum(
        idle[worker] for worker in idle if worker in alive
    )
    for one in watched:
        one.page.get_by_role("button", name="New").click()
        one.page.get_by_role("button", name="Delete it").click()
        one.page.get_by_text("Or try an example").wait_for(timeout=PATIENCE)
    until_idle(server)
    memory["all begun anew"] = megabytes(server)
    table = pd.DataFrame(memory, index=["server", "workers"]).T.round()
    return {
        "studies": pd.DataFrame([one.row for one in watched])[COLUMNS],
        "memory": table.rename_axis("when").reset_index(),
        "spent": spent,
        "crowd_load": load,
    }


def until_idle(server: int) -> dict[int, float]:
    """Wait until all workers are ready; the seconds that each has computed."""
    before: dict[int, float] = {}
    now = {0: 0.0}
    while now != before:
        time.sleep(1.0)
        before, now = now, {worker: computed(worker) for worker in children(server)}
    return now


def children(process: int) -> list[int]:
    """The processes that a process has begun."""
    tasks = Path(f"/proc/{process}/task").iterdir()
    return [int(word) for task in tasks for word in words_of(task / "children")]


def computed(process: int) -> float:
    """For how many seconds a process has computed; 0 where it has ended."""
    ticks = words_of(Path(f"/proc/{process}/stat"))[13:15]
    return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


def megabytes(server: int) -> tuple[float, float]:
    """The memory of the server and of its workers; what is shared is divided."""
    found = []
    for process in (server, *children(server)):
        words = words_of(Path(f"/proc/{process}/smaps_rollup"))
        found.append(int(words[words.index("Pss:") + 1]) / 1000 if words else 0.0)
    return found[0], sum(found[1:])


def words_of(path: Path) -> list[str]:
    """The words of a file of the system; none where its process has ended."""
    try:
        return path.read_text().split()
    except OSError:
        return []


def main() -> None:
    """Measure, and write the page."""
    path = next(filter(None, map(shutil.which, BROWSERS)))
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    rows = []
    with served() as (address, _), sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=arguments)
        for example in EXAMPLES:
            page = chromium.new_context().new_page()
            page.goto(address, timeout=PATIENCE)
            rows.append(measured(page, example))
            page.context.close()
        chromium.close()
    table = pd.DataFrame(rows).round(2)
    print(table.to_string(index=False))
    load = os.getloadavg()[0]
    with served() as (address, server), sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=arguments)
        many = crowd(chromium, address, server)
        chromium.close()
    print(many["studies"].to_string())
    shown = {"rows": table, "load": f"{load:.1f}", "seconds": SECONDS_BETWEEN, **many}
    provenance.write("page.md", render("benchmarks/pages/page.md", **shown))


if __name__ == "__main__":
    main()
