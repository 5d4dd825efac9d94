"""The page in a real Chromium: a study from the table to the report, and what may go wrong."""

import math
import os
import re
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.page_tools import browser_path, faults, served, spring_table
from tests.waiting import HANGS_AFTER

pytestmark = pytest.mark.slow

CLICKED = re.compile("^At t = ")
CALLED = "Coulomb friction in the equation of p"
NAMED = re.compile(rf"{CALLED} \(.* N\) is missing\.")
PATIENCE = 1000 * HANGS_AFTER  # ms
# What Chromium writes where the page breaks its own policy.
POLICY = "Content Security Policy"
expect.set_options(timeout=PATIENCE)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    browser_path()  # skips before a server is started in vain
    with served(tmp_path_factory.mktemp("server")) as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    path = browser_path()
    # Its sandbox refuses to run as root, which containers of tests do.
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=arguments)
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser: Browser, address: str) -> Iterator[Page]:
    """A fresh browser session; errors of its scripts fail the test."""
    context = browser.new_context()
    found = context.new_page()
    found.set_default_timeout(PATIENCE)
    errors: list[str] = []
    told: list[str] = []
    found.on("pageerror", lambda error: errors.append(str(error)))
    found.on("console", lambda message: told.append(message.text))
    found.goto(address)
    yield found
    context.close()
    assert errors == []
    assert [one for one in told if POLICY in one] == []


def drop(page: Page, name: str, content: bytes) -> None:
    file = {"name": name, "mimeType": "text/csv", "buffer": content}
    page.locator("input[type=file]").set_input_files(file)  # type: ignore[arg-type]


def prepare(page: Page, content: bytes) -> None:
    """Table and model, as a user gives them."""
    assert faults(page) == []
    drop(page, "spring.csv", content)
    expect(page.get_by_label("unit of position_m")).to_have_value("m")
    assert faults(page) == []
    page.get_by_role("tab", name="2 Model").click()
    page.get_by_role("button", name="Mass with forces A mass").click()
    page.get_by_label("known value of m").fill("2.5")
    expect(page.get_by_text("is an assumption: enter your")).to_be_hidden()
    expect(page.get_by_text("Model and data are valid.")).to_be_visible()
    assert faults(page) == []


def press_fit(page: Page) -> None:
    page.get_by_role("button", name="Fit", exact=True).click()
    expect(page.get_by_role("button", name="Cancel")).to_be_visible()


def facts(page: Page) -> str:
    """What the first screen says once it is known."""
    region = page.get_by_role("region", name="Verdict")
    region.get_by_text("What is wrong").wait_for()
    return region.inner_text().replace("\N{NO-BREAK SPACE}", " ")


def nothing_is_solved(page: Page) -> None:
    cancel = page.get_by_role("button", name="Cancel")
    expect(cancel).to_be_hidden()


def test_the_hidden_effect_is_found_and_added_and_the_report_is_opened(
    page: Page, tmp_path: Path
) -> None:
    prepare(page, spring_table())
    press_fit(page)
    said = facts(page)
    assert NAMED.search(said)
    assert "In the equation of p." in said
    assert re.search("(strongest|most clearly visible) at t = ", said)
    assert "The equation of p lacks a force of" in said
    assert f"{CALLED} (" in said
    assert "found" in said and "missing: named" not in said
    assert "Study of spring.csv: Position measured in" in said
    assert "1.4 times the noise." in said
    assert "± is one standard error." in said
    expect(page.get_by_text("worst moment").first).to_be_visible()
    expect(page.get_by_text("Ready.")).to_be_hidden()
    nothing_is_solved(page)
    error_before = held_out_error(page, step=0)

    plot = page.locator(".live > svg").first
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    assert box is not None
    time = page.get_by_label("show the time (s)")
    offered = time.input_value()
    page.mouse.click(box["x"] + 0.6 * box["width"], box["y"] + 0.3 * box["height"])
    expect(time).not_to_have_value(offered)
    expect(page.get_by_text(CLICKED)).to_contain_text("the equation of p lacks")
    looked_at = time.input_value()
    assert float(looked_at) > 2.0
    run_shown = page.get_by_label("run", exact=True).input_value()

    page.get_by_role("button", name=f"Add {CALLED}", exact=True).press("Enter")
    expect(page.get_by_text("nothing more that is missing").first).to_be_visible()
    nothing_is_solved(page)
    assert held_out_error(page, step=1) < 0.8 * error_before
    # The same place before and after, and nothing more is offered.
    assert page.get_by_label("show the time (s)").input_value() == looked_at
    assert page.get_by_label("run", exact=True).input_value() == run_shown
    automatic = page.get_by_role("button", name="Add effects automatically until")
    expect(automatic).to_have_count(0)
    expect(page.get_by_text("Tried, none needed")).to_be_visible()
    expect(page.get_by_text("A bar is the error")).to_have_count(0)  # there is none
    expect(page.get_by_role("heading", name="What was missing")).to_be_visible()
    verdict = page.get_by_role("region", name="Verdict")
    expect(verdict).to_contain_text("What to do next")
    for width, colours in ((1280, "dark"), (390, "light")):
        page.set_viewport_size({"width": width, "height": 900})
        looks: Any = {"color_scheme": colours, "reduced_motion": "reduce"}
        page.emulate_media(**looks)
        assert faults(page) == []
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    # What nobody sees yet is not drawn, and points are one element: a page is sooner
    # there. Both were most of 1800 elements.
    assert page.locator("*").count() < 800
    assert page.locator(".live circle").count() < 20
    page.get_by_text(re.compile("^[0-9]+ more$")).click()
    expect(page.get_by_role("button", name="Add anyway").nth(8)).to_be_visible()

    # The report is worked out like a solve, and is there when the page says so.
    with page.expect_download() as download:
        page.get_by_role("button", name="Report").click()
        handed = page.get_by_text("report.html was downloaded by")
        expect(handed).to_be_visible()
    report = tmp_path / download.value.suggested_filename
    download.value.save_as(report)
    assert report.suffix == ".html"
    page.goto(report.as_uri())
    expect(page.get_by_role("heading", level=1)).to_be_visible()
    assert CALLED in page.inner_text("body")


def smooth_table() -> bytes:
    """A mass with an input that is held nowhere."""
    lines = [f"{t / 50},{math.sin(t / 9)},{math.cos(t / 7)}" for t in range(200)]
    return "\n".join(["t (s),q (m),u (N)", *lines]).encode()


def test_a_table_with_a_smooth_input_has_every_field(page: Page) -> None:
    drop(page, "smooth.csv", smooth_table())
    for label in (
        "u (N) between samples",
        "number of samples to average",
        "held-out data",
    ):
        expect(page.get_by_label(label)).to_be_visible()
    expect(page.get_by_label("u (N) between samples")).to_have_value("linear")
    expect(
        page.get_by_label("title of the report, such as the machine")
    ).to_be_visible()
    heading = page.get_by_role("heading", name="Data not used for fitting")
    expect(heading).to_be_visible()
    expect(page.get_by_role("alert")).to_have_count(0)


def test_a_part_that_fails_is_told_and_stops_no_other(
    browser: Browser, tmp_path: Path
) -> None:
    failing = "draft_views.DataView._column = lambda *_: 1 / 0"
    with served(tmp_path, failing, "ZeroDivisionError: division by zero") as address:
        page = browser.new_page()
        page.goto(address)
        drop(page, "smooth.csv", smooth_table())
        told = page.get_by_role("alert")
        expect(told).to_contain_text("This is a bug in phsi_opt: ZeroDivisionError")
        expect(told).to_contain_text("(line 6 of server.py)")
        expect(page.get_by_text("What was measured")).to_be_visible()
        page.get_by_role("tab", name="2 Model").click()
        page.get_by_role("button", name="Mass with forces A mass").click()
        expect(page.get_by_text("Model and data are valid.")).to_be_visible()
        expect(told).to_have_count(1)  # it stays, and is told once


def test_a_file_whose_reading_never_ends_stops_nobody(
    browser: Browser, tmp_path: Path
) -> None:
    slow = "session.drafts.look_at, session.READ_WITHIN = page_tools.endless, 8.0"
    with served(tmp_path, slow) as address:
        page = browser.new_page()
        page.goto(address)
        drop(page, "hostile.csv", smooth_table())
        page.wait_for_timeout(1000)  # it is being read
        with urllib.request.urlopen(address, timeout=60) as answer:
            assert b"phsi_opt" in answer.read()
        page.get_by_role("tab", name="2 Model").click()
        expect(page.get_by_text("Choose a base model")).to_be_visible()
        page.get_by_role("tab", name="1 Data").click()
        told = page.get_by_role("alert")
        assert told.count() == 0, "all of this waited until the reading was ended"
        expect(told).to_contain_text("reading was stopped after 8 s", timeout=180_000)


def held_out_error(page: Page, step: int) -> float:
    """The number at a step of the staircase, as the chart tells it to screen readers."""
    chart = page.get_by_role("img", name="Chart: error after each step")
    label = chart.get_attribute("aria-label") or ""
    _, _, steps = label.partition("step: ")
    return float(steps.split(", ")[step].split()[-1])


def test_what_is_typed_is_undone_and_an_assumption_is_confirmed(
    page: Page, browser: Browser, address: str
) -> None:
    context = browser.new_context()
    other = context.new_page()
    other.goto(address)
    drop(page, "spring.csv", spring_table())
    expect(page.get_by_label("unit of position_m")).to_have_value("m")
    page.get_by_role("tab", name="2 Model").click()
    page.get_by_role("button", name="Mass with forces A mass").click()
    energy = page.get_by_label("energy H")
    expect(energy).to_have_value("k*q**2/2 + p**2/(2*m)")
    confirm = page.get_by_role("button", name="Confirm m = 1 kg")
    confirm.click()
    expect(confirm).to_be_hidden()
    window = page.context.new_page()  # of the same study
    window.goto(address)
    window.get_by_role("tab", name="2 Model").click()
    same = window.get_by_label("energy H")
    expect(same).to_have_value("k*q**2/2 + p**2/(2*m)")
    energy.fill("kk*q**2/2 + p**2/(2*m)")
    expect(page.get_by_text("'kk' is not known here")).to_be_visible()
    expect(same).to_have_value("kk*q**2/2 + p**2/(2*m)")
    expect(energy).to_be_focused()
    undo = page.get_by_role("button", name="Undo")
    undo.click()
    expect(energy).to_have_value("k*q**2/2 + p**2/(2*m)")
    expect(same).to_have_value("k*q**2/2 + p**2/(2*m)")
    expect(page.get_by_text("Model and data are valid.")).to_be_visible()
    page.get_by_role("button", name="Redo").click()
    expect(energy).to_have_value("kk*q**2/2 + p**2/(2*m)")
    for keys, shown in (
        ("Control+z", "k*q**2/2"),
        ("Control+y", "kk*q**2/2"),
        ("Control+z", "k*q**2/2"),
        ("Control+Shift+z", "kk*q**2/2"),
    ):
        page.keyboard.press(keys)
        expect(energy).to_have_value(f"{shown} + p**2/(2*m)")
    energy.press("End")
    energy.type("*3")
    expect(energy).to_have_value("kk*q**2/2 + p**2/(2*m)*3")
    page.wait_for_timeout(600)  # until it counts as a change of its own
    for _ in range(2):  # Chromium takes back the letters of one field
        energy.press("Control+z")
    expect(energy).to_have_value("kk*q**2/2 + p**2/(2*m)")
    window.close()
    page.get_by_role("button", name="Add a parameter").click()
    page.get_by_label("name", exact=True).fill("extra")
    expect(page.get_by_label("start of extra")).to_be_visible()
    # A part is drawn late: it is that of this browser's study all the same.
    for window, n_charts in ((other, 0), (page, 1)):
        window.get_by_role("tab", name="3 Study").click()
        expect(window.get_by_text("Nothing is fitted yet")).to_be_visible()
        measured = window.get_by_role("heading", name="What was measured")
        expect(measured).to_have_count(n_charts)
    context.close()


def test_a_stretch_that_is_chosen_in_the_chart_is_all_that_is_used(page: Page) -> None:
    times = (k * 0.05 for k in range(400))
    lines = (f"{t:.2f},{math.sin(2 * t):.4f}" for t in times)
    drop(page, "wave.csv", "\n".join(["t_s,position_m", *lines]).encode())
    chart = page.get_by_role("img", name="all channels over time")
    expect(chart).to_be_visible()
    use = page.get_by_role("button", name="Use only t =")
    expect(use).to_have_count(0)
    box = chart.bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.3 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], middle, steps=3)
    page.mouse.up()
    expect(use).to_be_visible()
    begin, end = map(float, re.findall(r"[\d.]+", use.inner_text().partition("=")[2]))
    use.click()
    ends = page.get_by_label("first and last time to use")
    expect(ends).to_have_value(f"{begin:g}, {end:g}")
    stated = page.get_by_role("row", name=re.compile("^t "))
    expect(stated).to_contain_text(f"{begin:.2g}")
    page.get_by_role("button", name="Spectrum").click()
    expect(page.get_by_role("img", name="the spectrum of each channel")).to_be_visible()
    page.get_by_role("button", name="Undo").click()
    expect(ends).to_have_value("")


def test_an_example_is_worked_through_by_the_keyboard_alone(
    page: Page, address: str
) -> None:
    window = page.context.new_page()  # of the same study
    window.goto(address)
    press(page, "Motor with steps of voltage")
    page.reload()
    for one in (page, window):  # each shows the part in which work goes on
        study = one.get_by_role("tab", name="3 Study")
        expect(study).to_have_attribute("aria-selected", "true")
    window.close()
    expect(page.get_by_role("img", name="Chart").first).to_be_visible()
    region = page.get_by_role("region", name="Verdict")
    region.get_by_text("What is wrong").wait_for()
    nothing_is_solved(page)
    press(page, "Add Coulomb friction in the equation of speed")
    expect(page.get_by_text("nothing more that is missing").first).to_be_visible()
    nothing_is_solved(page)
    expect(page.get_by_text("Side by side")).to_be_visible()
    assert page.get_by_label("run", exact=True).input_value() == "run 2 (held out)"
    press(page, "Undo")
    expect(
        region.get_by_text("Add Coulomb friction in the equation of speed.", exact=True)
    ).to_be_visible()
    press(page, "Redo")
    expect(region.get_by_text("Use the model.")).to_be_visible()
    press(page, "Show model 1: base model")
    expect(
        region.get_by_text("Add Coulomb friction in the equation of speed.", exact=True)
    ).to_be_visible()
    page.set_viewport_size({"width": 390, "height": 844})
    page.get_by_label("compare with").click()
    page.get_by_role(
        "option", name="2: + Coulomb friction in the equation of speed"
    ).click()
    chosen = page.locator(".q-select span", has_text="2: + Coulomb")
    expect(chosen).to_be_visible()
    assert chosen.evaluate("one => one.scrollWidth <= one.clientWidth"), "cut"


def press(page: Page, name: str) -> None:
    """Go to a button by the Tab key and press Enter; its focus must be visible."""
    button = page.get_by_role("button", name=name, exact=True)
    expect(button).to_be_enabled()
    for _ in range(80):
        page.keyboard.press("Tab")
        if button.evaluate("one => one === document.activeElement"):
            break
    look = button.evaluate("one => getComputedStyle(one).boxShadow")
    assert "5px" in look, "nobody sees where the focus is"
    page.keyboard.press("Enter")


IMAGE = "<img src=x onerror=window.hit=1>"
MARKUP = f"{IMAGE}<script>window.hit=1</script>"
STUDY = """
[data]
files = ["a#.csv"]
trajectory = "run#"
time = { column = "t_s#", unit = "s" }
[data.states]
q = { column = "position_m#", unit = "m" }
p = { measured = false, unit = "kg m/s" }
[held_out]
runs = ["run 3#"]
[model]
states = ["q", "p"]
pairs = [["q", "p"]]
H = "k*q**2/2 + p**2/(2*m)"
R = { p = "c" }
[parameters]
m = 2.5
k = { lower = 0, unit = "N/m" }
c = { lower = 0 }
[[effects]]
name = "dry#"
slot = "F"
equation = "p"
term = { body = "-dH_dp*(dH_dp**4 + 1e-6)**(-1/4)" }
[study]
title = "machine#"
effects = ["dry#", "quadratic drag"]
"""


def test_names_of_files_columns_runs_effects_and_studies_are_no_markup(
    page: Page, tmp_path: Path
) -> None:
    def nothing_is_run() -> None:
        assert page.evaluate("window.hit") is None
        assert page.locator("img[src=x]").count() == 0

    lines = spring_table().decode().splitlines()
    lines[0] = ",".join(f"{name}{MARKUP}" for name in lines[0].split(","))
    table = re.sub("(?m)^(run [0-9])", rf"\1{MARKUP}", "\n".join(lines))
    drop(page, f"wrong{IMAGE}.csv", f"t,q{MARKUP}\n1\n".encode())
    expect(page.get_by_role("alert")).to_contain_text(f"'wrong{IMAGE}.csv'")
    drop(page, f"wrong{IMAGE}.toml", f"[data]\nunit{MARKUP}".encode())
    expect(page.get_by_role("alert")).to_contain_text(f"wrong{IMAGE}.toml")
    nothing_is_run()
    drop(page, f"a{MARKUP.replace('/', '')}.csv", table.encode())
    unit = page.get_by_label(f"unit of position_m{MARKUP}")
    unit.fill(IMAGE)
    expect(page.locator("table.models").first).to_contain_text(f"({IMAGE})")
    nothing_is_run()
    study = STUDY.replace("a#", f"a{MARKUP.replace('/', '')}").replace("#", MARKUP)
    drop(page, f"mine{IMAGE}.toml", study.encode())
    expect(unit).to_have_value("m")
    page.reload()
    expect(page.get_by_text("What was measured")).to_be_visible()
    for name in ("1 Data", "2 Model", "3 Study"):
        page.get_by_role("tab", name=name).click()
        nothing_is_run()
    press_fit(page)
    facts(page)
    nothing_is_solved(page)
    assert IMAGE in page.get_by_role("region", name="Verdict").inner_text()
    page.locator(".live > svg").first.hover()
    nothing_is_run()
    with page.expect_download() as download:
        page.get_by_role("button", name="Report").click()
    download.value.save_as(tmp_path / "report.html")
    page.goto((tmp_path / "report.html").as_uri())
    expect(page.locator("body")).to_contain_text(f"machine{IMAGE}")
    expect(page.locator("html")).to_have_attribute("data-drawn", "yes")
    nothing_is_run()
