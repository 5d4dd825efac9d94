"""The report in a real Chromium: charts are drawn, zoomed and chosen; nothing overflows."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect, sync_playwright

from phsi_opt.presentation.content import (
    GOOD,
    Answer,
    Channel,
    Equations,
    ErrorStep,
    Headline,
    Run,
    StudyContent,
)
from phsi_opt.presentation.html_report import html_report
from phsi_opt.presentation.units import Scale
from tests.page_tools import browser_path
from tests.waiting import HANGS_AFTER

NAMES = ("base model", "with friction")
PATIENCE = 1000 * HANGS_AFTER  # ms
expect.set_options(timeout=PATIENCE)


def run(name: str) -> Run:
    t = np.linspace(0.0, 5.0, 200)
    q = np.cos(4 * t)
    return Run(
        name, "held out", (Channel("q", "m", 0.1, t, q, (0.8 * q, q), (0.2, 0.0), 0.7),)
    )


def content() -> StudyContent:
    told = Answer("A friction was missing.", "The error fell.")
    verdict = Answer("Nothing missing.", question="Verdict", severity=GOOD)
    headline = Headline("nothing missing", told, (verdict, told))
    steps = tuple(ErrorStep(name, 0.1, 0.2, 0.1, 1.0) for name in NAMES)
    formula = "<math display='block'><mi>q</mi></math>"
    models = tuple(Equations(name, ("q = 1",), (), (formula,)) for name in NAMES)
    base = dict.fromkeys(StudyContent.__dataclass_fields__, ())
    texts = ("subtitle", "errors", "runs_caption", "code", "stopped")
    empty = StudyContent(**base | dict.fromkeys(texts, ""))  # type: ignore[arg-type]
    return replace(
        empty,
        title="Drive 7",
        headline=headline,
        steps=steps,
        unit="m",
        models=models,
        time=Scale("s"),
        names=NAMES,
        runs=(run("run 1"), run("run 2")),
        shown=1,
        shown_channel=0,
        is_diagnosed=False,
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(html_report(content()), encoding="utf-8")
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    errors: list[str] = []
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(
            executable_path=browser_path(), args=arguments
        )
        page = found.new_page()
        page.set_default_timeout(PATIENCE)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(Path(path).as_uri())
        yield page
        found.close()
    assert errors == []


def ticks(page: Page) -> list[float]:
    """The numbers below the measurements."""
    texts = page.locator("#measured text[text-anchor=middle]").all_text_contents()
    return [float(one) for one in texts if one[:1].isdigit()]


@pytest.mark.slow
def test_charts_are_drawn_zoomed_chosen_and_read(report: Page) -> None:
    expect(report.locator("html")).to_have_attribute("data-drawn", "yes")
    expect(report.locator("#verdict h1")).to_have_text("A friction was missing.")
    expect(report.locator("#runs select").first).to_have_value("1")
    whole = ticks(report)
    report.get_by_role("button", name="Zoom in").first.click()
    assert np.ptp(ticks(report)) < 0.6 * np.ptp(whole)
    report.get_by_role("button", name="Reset").first.click()
    assert ticks(report) == whole
    # Of each curve one path in each panel; the legend hides both.
    paths = report.locator("#measured path")
    n_paths = paths.count()
    key = report.locator("#measured .keys button", has_text="base model")
    key.click()
    expect(paths).to_have_count(n_paths - 2)
    expect(key).to_have_attribute("aria-pressed", "false")
    key.click()
    report.locator("#measured > svg").hover()
    expect(report.locator("#measured output")).to_contain_text("with friction")
    report.locator("#runs select").first.select_option("0")
    expect(paths).to_have_count(n_paths)


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_is_wider_than_the_screen_and_paper_has_pictures(report, width) -> None:
    report.set_viewport_size({"width": width, "height": 900})
    assert report.evaluate("document.documentElement.scrollWidth") <= width
    report.emulate_media(media="print")
    expect(report.locator("#runs .still")).to_be_visible()
    expect(report.locator("#measured")).to_be_hidden()
    report.emulate_media(media="screen")
    expect(report.locator("#measured")).to_be_visible()
