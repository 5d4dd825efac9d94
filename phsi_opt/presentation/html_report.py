"""Reports by templates: one HTML file, or Markdown; everything of the data is escaped.

The HTML file loads nothing. What charts show is in it, compressed; the browser unpacks
and draws it. Until it has, on paper, and where no script runs, static pictures stand in
place of the charts.
"""

import base64
import gzip
import json
import re
from importlib.resources import files
from typing import Any

from markupsafe import Markup

from phsi_opt.presentation.charts import (
    Chart,
    errors_chart,
    figure,
    follows_chart,
    force_chart,
    run_chart,
    svg,
)
from phsi_opt.presentation.content import StudyContent
from phsi_opt.presentation.numbers import unbroken
from phsi_opt.presentation.sentences import environment

PRESENTATION = "phsi_opt.presentation"
TEMPLATES = "templates"
NO_WORD = re.compile(r"[^\w ]")


def charts_of(
    content: StudyContent, data: Chart | None
) -> tuple[dict[str, Chart], dict[str, list[list[Chart]]]]:
    """By the names of their places: the charts that are shown first, and several.

    Several charts have one place, by run and channel.
    """
    runs = []
    for run in content.runs:
        runs.append([run_chart(content, run, k) for k in range(len(run.channels))])
    several = {"measured": runs}
    charts = {
        "staircase": errors_chart(content.steps, content.unit),
        "measured": runs[content.shown][content.shown_channel],
    }
    if data is not None:
        charts["data-chart"] = data
    for k, law in enumerate(content.laws):
        charts[f"law-{k}"] = follows_chart(law)
    for f, diagnosed in enumerate(content.diagnoses):
        for k, force in enumerate(diagnosed.forces):
            name = f"force-{f}-{k}"
            along = [[force_chart([run], content.time.unit)] for run in force.runs]
            several[f"{name}-time"] = along
            charts[f"{name}-time"] = along[force.shown][0]
            charts[f"{name}-follows"] = follows_chart(force.follows)
    return charts, several


def figures_of(content: StudyContent, data: Chart) -> dict[str, Chart]:
    """Every figure of a report, of all runs and channels, by a name for its file."""
    charts, several = charts_of(content, data)
    found = {"errors": charts["staircase"], "measurements": data}
    for run, of_run in zip(content.runs, several["measured"], strict=True):
        for channel, chart in zip(run.channels, of_run, strict=True):
            found[f"{run.title} {channel.name}"] = chart
    for k in range(len(content.laws)):
        found[f"law {k + 1}"] = charts[f"law-{k}"]
    for f, diagnosed in enumerate(content.diagnoses):
        for k, force in enumerate(diagnosed.forces):
            name = f"missing force {f} {force.equation}"
            found[f"{name} follows"] = charts[f"force-{f}-{k}-follows"]
            along = several[f"force-{f}-{k}-time"]
            for one, (chart,) in zip(force.runs, along, strict=True):
                found[f"{name} {one.run}"] = chart
    return {re.sub(r"\W+", "_", name).strip("_"): one for name, one in found.items()}


def html_report(content: StudyContent, data: Chart | None = None) -> str:
    """The whole report as the text of an HTML file, with a chart of all its data."""
    charts, several = charts_of(content, data)

    def picture(name: str, width: float) -> str:
        """An address that holds the picture for paper, of a width in inches."""
        text = svg(charts[name], width).encode()
        return f"data:image/svg+xml;base64,{base64.b64encode(text).decode()}"

    templates = environment(PRESENTATION, TEMPLATES, autoescape=True, finalize=unbroken)
    return templates.get_template("report.html.jinja").render(
        report=content,
        data_chart=data,
        picture=picture,
        markup=Markup,
        style=Markup(ours("chart.css") + ours("report.css")),  # no escape
        heading=Markup(in_css(f"{content.title}: {content.headline.badge}")),
        script=Markup(ours("chart.js") + ours("report.js")),
        data=packed(json.dumps(figure(charts | several), allow_nan=False)),
    )


def ours(name: str) -> str:
    """The text of one of our scripts and style sheets."""
    return (files(PRESENTATION) / TEMPLATES / name).read_text(encoding="utf-8")


def in_css(text: str) -> str:
    """A text as a string of a style sheet, whatever is in it."""
    return '"' + NO_WORD.sub(lambda one: f"\\{ord(one[0]):x} ", text) + '"'


def markdown_report(content: StudyContent) -> str:
    """The same in words and tables, as Markdown."""
    templates = environment(PRESENTATION, TEMPLATES, finalize=_in_markdown)
    templates.filters["code"] = lambda line: Markup(" ".join(line.splitlines()))
    templates.filters["markup"] = Markup
    return templates.get_template("report.md.jinja").render(report=content)


def _in_markdown(value: Any) -> str:
    """A value on one line in which no name is read as HTML or ends a cell."""
    if isinstance(value, Markup):
        return value
    return " ".join(str(value).split()).replace("<", "&lt;").replace("|", "\\|")


def packed(text: str) -> str:
    """A text as a script element may hold it, whatever is in it: compressed."""
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()
