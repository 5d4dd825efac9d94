"""The report in a real Chromium: charts are drawn, zoomed and chosen; nothing overflows."""

import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from playwright.sync_api import Page, expect, sync_playwright

from phsi_opt.data.measurements import Measurements
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
from phsi_opt.presentation.html_report import html_report, in_css
from phsi_opt.presentation.units import Scale
from tests.page_tools import browser_path, faults
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


def measured(names: list[str]) -> Measurements:
    """Runs whose clocks begin at different times."""
    t = [np.arange(50) / 10 + 3 * k for k in range(len(names))]
    q = [101_325.0 + np.sin(5 * one) / 4 for one in t]
    units = {"t": "s", "q": "Pa"}
    return Measurements.from_arrays(t, q, states=["q"], units=units, names=names)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    path = tmp_path_factory.mktemp("report") / "report.html"
    data = measured([f"measurement_{k}_of_the_test_bench" for k in range(9)])
    chart = data[:6].chart(data[6:8], data[8:])
    path.write_text(html_report(content(), chart), encoding="utf-8")
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
    tools = report.locator("#measured .tools")
    report.locator("#data-chart").hover()
    assert tools.evaluate("one => getComputedStyle(one).opacity") == "0"
    report.locator("#measured").hover()
    assert tools.evaluate("one => getComputedStyle(one).opacity") == "1"
    tools.get_by_role("button", name="Zoom in").click()
    assert np.ptp(ticks(report)) < 0.6 * np.ptp(whole)
    tools.get_by_role("button", name="Reset").click()
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


def saved(page: Page, chart: str, name: str, folder: Path) -> Path:
    """The file that a button of a chart saves."""
    page.locator(chart).hover()
    button = page.locator(f"{chart} .tools").get_by_role("button", name=name)
    with page.expect_download() as download:
        button.click()
    path = folder / download.value.suggested_filename
    download.value.save_as(path)
    return path


@pytest.mark.slow
def test_a_figure_and_its_numbers_are_saved_by_a_button(
    report: Page, tmp_path: Path
) -> None:
    numbers = saved(report, "#measured", "Save the numbers as CSV", tmp_path)
    assert numbers.name == "run_2_held_out_q_m.csv"
    table = pd.read_csv(numbers)
    shown = content().runs[1].channels[0]
    assert table["t (s)"].to_numpy() == pytest.approx(shown.t, abs=1e-5)
    assert table["measured, q (m)"].to_numpy() == pytest.approx(
        shown.measured, abs=1e-5
    )
    residual = table["base model, residual (m)"].to_numpy()
    assert residual == pytest.approx(shown.measured - shown.models[0], abs=1e-5)
    table = pd.read_csv(saved(report, "#data-chart", "Save the numbers", tmp_path))
    assert table["t (s)"].to_numpy()[:50] == pytest.approx(np.arange(50) / 10, abs=1e-3)
    assert table["run"].nunique() == 9 and len(table) == 450
    drawn = saved(report, "#data-chart", "Save the figure as SVG", tmp_path)
    texts = "".join(ElementTree.parse(drawn).getroot().itertext())
    assert "held out: not used for fitting" in texts and "for the final test" in texts
    picture = saved(report, "#data-chart", "Save the figure as PNG", tmp_path)
    pixels = plt.imread(picture)
    assert pixels.shape[1] == 2 * report.locator("#data-chart").evaluate(
        "one => one.clientWidth"
    )
    assert len(np.unique(pixels.reshape(-1, pixels.shape[2]), axis=0)) > 20


# Pairs of texts of a chart that cover each other, and texts that are cut at its edge.
COVERED = """() => [...document.querySelectorAll(".live > svg")].flatMap((svg) => {
  const edge = svg.getBoundingClientRect(), texts = [...svg.querySelectorAll("text")];
  const boxes = texts.map((one) => [one.textContent, one.getBoundingClientRect()]);
  return boxes.flatMap(([text, a], k) => [
    ...(a.left < edge.left - 1 || a.right > edge.right + 1 ? [text] : []),
    ...boxes.slice(k + 1).filter(([, b]) => a.left < b.right - 0.5 && b.left < a.right
      - 0.5 && a.top < b.bottom - 0.5 && b.top < a.bottom - 0.5).map(([other]) =>
      `${text} | ${other}`)]); })"""


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 800, 1400])
def test_no_text_of_a_chart_covers_another_or_is_cut(report: Page, width: int) -> None:
    report.set_viewport_size({"width": width, "height": 900})
    report.wait_for_timeout(200)
    assert report.locator(".live text").count() > 20
    assert report.evaluate(COVERED) == []
    # Numbers whose last digits alone differ are told apart.
    labels = report.locator("#data-chart text[text-anchor=end]").all_text_contents()
    assert len(set(labels)) == len(labels) > 1


@pytest.mark.slow
@pytest.mark.parametrize("colours", ["light", "dark"])
def test_everybody_can_use_a_report(report: Page, colours: Any) -> None:
    report.emulate_media(color_scheme=colours)
    assert faults(report) == []


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


@pytest.mark.slow
def test_paper_has_few_full_pages_with_the_name_of_the_study(report: Page) -> None:
    report.emulate_media(media="print")
    printed = report.pdf(format="A4")
    assert len(re.findall(rb"/Type /Page\b", printed)) == 2
    rules = report.locator("style").text_content() or ""
    assert r'@top-left { content: "Drive 7\3a  nothing missing"; }' in rules
    assert in_css('a"</style>\\') == r'"a\22 \3c \2f style\3e \5c "'
