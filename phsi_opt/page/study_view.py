"""The third part of the page: the verdict, the charts, the ranking, the exports.

All of it is drawn from the content of the study; texts are those of
``study.html.jinja``. A click into a chart marks a time; the missing force at that time
is told. The field for the time does the same for those who use no mouse.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import binding, events, run, ui

from phsi_opt.criteria import FAILING_ERROR, SURE_DEVIATIONS
from phsi_opt.errors import PhsiOptError
from phsi_opt.page.parts import (
    alert,
    button,
    card,
    choice,
    heading,
    plotted,
    plotted_data,
    said_by,
)
from phsi_opt.page.session import REPORT_FILE, Look, Model, Session
from phsi_opt.presentation.charts import (
    Chart,
    errors_chart,
    follows_chart,
    force_chart,
    run_chart,
)
from phsi_opt.presentation.content import Diagnosed, Ranked, Run, StudyContent
from phsi_opt.presentation.numbers import number, proper_names, with_error

ADD_ALL = "Add effects automatically until the error reaches noise"
BAR = (
    "A bar is the error that would remain with the effect; a full bar is the error "
    "of the present model, and its mark is the noise floor."
)
HOW_TO_LOOK = (
    "Click in a chart to see what is missing at that time; drag to zoom, "
    "double-click to reset."
)
NO_MODEL = "no other model"
STALE = (
    "Data or model have changed since the last fit. The results below belong to the "
    "previous model."
)


class StudyView:
    """Draws the study as it stands."""

    is_free = binding.BindableProperty()  # whether nothing is solved

    def __init__(self, session: Session) -> None:
        self._session = session
        self.is_free = session.job is None
        self._wants_report = False

    def _begins(self, label: str, then: Callable[[], Any], quiet: bool) -> ui.button:
        """A button that begins work; it rests meanwhile."""
        begin = partial(run.io_bound, then)
        return button(label, begin, quiet).bind_enabled_from(self, "is_free")

    @ui.refreshable_method
    def build(self) -> None:
        session = self._session
        content = session.content
        if content is None:
            self._nothing_yet()
            return
        if session.failure:
            alert(session.failure)
        if session.is_stale:
            with card():
                ui.label(STALE)
                self._begins("Fit again", session.fit, quiet=False)
        verdict = card().props('role="region" aria-label="Verdict"')
        with verdict.props('id="verdict" tabindex="-1"'):
            self._verdict(content)
        with ui.element("div").classes("two w-full"):
            with ui.column().classes("gap-3").style("min-width: 0"):
                self._measured(content)
                with card().classes("last"):
                    said_by("model", content)
                    self.side_by_side()
                self._exports()
            with ui.column().classes("gap-3").style("min-width: 0"):
                self._models(content)
                if content.present is not None:
                    self._ranking(content, content.present)

    def _nothing_yet(self) -> None:
        with card():
            heading("Nothing is fitted yet")
        if (seen := self._session.seen_data.chart) is not None:
            with card():
                plotted_data(seen)

    def _verdict(self, content: StudyContent) -> None:
        diagnosed = content.present
        if diagnosed is None:
            is_asked = self._session.is_diagnosing
            said_by("not_asked", content.steps[-1], content.unit, is_asked)
            if not is_asked:
                self._begins("Diagnose", self._session.diagnose, False)
            return
        said_by("verdict", content)
        if self._session.is_stale:
            return
        if diagnosed.averaged:
            n = diagnosed.averaged
            label = f"Average every {n} samples and fit again"
            self._begins(label, lambda: self._session.average(n), quiet=False)
        if diagnosed.proposed:
            self._add_button("Add", diagnosed, *diagnosed.proposed)
        elif diagnosed.nearest:
            self._add_button("Try", diagnosed, diagnosed.nearest)

    def _add_button(self, verb: str, diagnosed: Diagnosed, *effects: str) -> None:
        words = [one.words for one in diagnosed.ranking if one.effect in effects]
        label = f"{verb} {proper_names(' and '.join(words))}"
        self._begins(label, partial(self._session.add, *effects), verb != "Add")

    # ---- measured and model, and the force that is missing ---------------------------

    def _measured(self, content: StudyContent) -> None:
        with card():
            heading("Measured and model")
            with ui.element("div").classes("fields"):
                titles = {k: run.title for k, run in enumerate(content.runs)}
                shown = (titles, self._session.look.run, self._set_run)
                runs = choice("run", *shown)
                names = [one.name for one in content.runs[0].channels]
                if len(names) > 1:
                    channels = dict(enumerate(names))
                    now = self._session.look.channel
                    choice("channel", channels, now, lambda k: self._look_at(channel=k))
                unit = content.time.unit
                t = self._session.look.t
                self._field = ui.number(
                    f"show the time ({unit})" if unit else "show the time",
                    value=None if t is None else float(f"{t:.6g}"),
                    on_change=lambda e: self._look_at(t=e.value),
                )
                self._field.props("dense outlined debounce=400").style("width: 12em")
                self._choose_compared()
                worst = Look.worst(content)
                if worst is not None and worst.t is not None:
                    t = worst.t
                    button("Show the worst moment", lambda: show(worst.run, t), True)
            self.overlay()
            ui.label(HOW_TO_LOOK).classes("faint")
        with card():
            is_good = content.headline.status == "nothing missing"
            heading("What was missing" if is_good else "What is missing")
            self.follows()
            if is_good:
                with ui.expansion("What is left, though nothing is missing"):
                    self.force()
            else:
                self.force()

        def show(run: int, t: float) -> None:
            runs.set_value(run)
            self._field.set_value(float(f"{t:.6g}"))

    def _choose_compared(self) -> None:
        """Which other model is drawn beside the one that is shown."""
        session = self._session
        others: dict[int | None, str] = {None: NO_MODEL}
        for place, one in enumerate(session.models):
            if place != session.now:
                others[place] = titled(place, one)

        def compare(place: int | None) -> None:
            session.compared = place
            self.overlay.refresh()
            self.side_by_side.refresh()

        if len(others) > 1:
            now = session.compared
            choice("compare with", others, now, compare)

    @ui.refreshable_method
    def follows(self) -> None:
        """What is missing, or the laws that were added, against what it follows."""
        model = self._session.model
        if model is None:
            return
        present = model.content.present
        missing = present.forces[:2] if present is not None else ()
        for found in tuple(one.follows for one in missing) or model.laws:
            ui.label(found.sentence)
            told = f"Chart: {found.y_label} against {found.x_label}"
            plotted(follows_chart(found), told, 260)

    def _set_run(self, run: int) -> None:
        self._look_at(run=run)
        self._field.set_value(None)

    def _look_at(self, **place: Any) -> None:
        self._session.look = replace(self._session.look, **place)
        self.overlay.refresh()
        self.force.refresh()

    def _plotted(self, chart: Chart, told: str, height: int) -> None:
        """A chart whose clicks mark a time."""

        def click(e: events.GenericEventArguments) -> None:
            self._field.set_value(float(e.args["detail"]))

        plotted(chart, told, height).on("moment", click, ["detail"])

    def _mark(self, run: Run) -> tuple[float, str] | None:
        look = self._session.look
        if look.t is None or not run.holds(look.t):
            return None
        worst = Look.worst(self._session.content) or Look(-1)
        is_worst = (worst.run, number(worst.t)) == (look.run, number(look.t))
        return look.t, "worst moment" if is_worst else "the time shown"

    @ui.refreshable_method
    def overlay(self) -> None:
        """Measured and free runs, with the residuals; what is missing at the mark."""
        content = self._session.content
        if content is None:
            return
        run = content.runs[self._session.look.run]
        channel = self._session.look.channel
        drawn = beside(self._chosen(), run, channel)
        chart = run_chart(*drawn, channel, self._mark(run))
        name = run.channels[channel].name
        label = f"Chart: {name} of {run.title}, measured and model"
        self._plotted(chart, label, 360)
        t = self._session.look.t
        if t is None:
            return
        with ui.element("div").props('role="status"'):
            forces = content.forces_along(run)
            said_by("at_time", forces, run, t, content.time, SURE_DEVIATIONS)

    @ui.refreshable_method
    def force(self) -> None:
        content = self._session.content
        if content is None:
            return
        run = content.runs[self._session.look.run]
        forces = content.forces_along(run)
        if forces:
            chart = force_chart(forces, content.time.unit, self._mark(run))
            self._plotted(chart, "Chart: what is missing over time", 260)

    # ---- models, ranking and exports -------------------------------------------------

    def _chosen(self) -> dict[str, StudyContent]:
        """The model to compare with, if any, and the one that is shown."""
        session = self._session
        chosen = {}
        for place in (session.compared, session.now):
            if place is not None:
                one = session.models[place]
                chosen[titled(place, one)] = one.content
        return chosen

    @ui.refreshable_method
    def side_by_side(self) -> None:
        chosen = self._chosen()
        if len(chosen) > 1:
            said_by("side_by_side", list(chosen), rows_of(list(chosen.values())))

    def _models(self, content: StudyContent) -> None:
        session = self._session
        with card():
            heading("Error after each step")
            chart = errors_chart(content.steps, content.unit)
            errors = [f"{one.label} {number(one.judged, 3)}" for one in content.steps]
            plotted(chart, f"Chart: error after each step: {', '.join(errors)}", 280)
            if content.present is None or content.present.proposed:
                self._begins(ADD_ALL, session.auto, True)
            several = session.models if len(session.models) > 1 else ()
            for place, one in enumerate(several):
                self._listed(place, one)

    def _listed(self, place: int, one: Model) -> None:
        session = self._session
        with ui.row().classes("candidate items-center no-wrap justify-between"):
            said_by("listed_model", titled(place, one), one.content)
            if place == session.now:
                ui.label("shown").classes("faint")
                return
            show = self._begins("Show", partial(session.go_to, place), True)
            show.props("dense flat").props(remove="outline")
            show.props["aria-label"] = f"Show model {titled(place, one)}"

    def _ranking(self, content: StudyContent, diagnosed: Diagnosed) -> None:
        is_good = diagnosed.verdict == "nothing missing"
        title = "Tried, none needed" if is_good else "Tried, none accepted"
        with card():
            heading("Effects, best first" if diagnosed.proposed else title)
            if diagnosed.ranking and diagnosed.ranking[0].train is not None:
                ui.label(BAR).classes("faint")
            others = diagnosed.ranking[5:]
            self._candidates(content, diagnosed, diagnosed.ranking[:5])
            if others:
                more = ui.expansion(f"{len(others)} more").classes("w-full")
                more.on_value_change(lambda: open_others())

        def open_others() -> None:  # drawn late: a page is sooner there
            with more:
                if not more.default_slot.children:
                    self._candidates(content, diagnosed, others)

    def _candidates(
        self, content: StudyContent, diagnosed: Diagnosed, rows: Sequence[Ranked]
    ) -> None:
        """Candidates with their buttons, flat where something speaks against them."""
        is_stale = self._session.is_stale
        for row in rows:
            is_proposed = row.effect in diagnosed.proposed
            with ui.column().classes("candidate gap-1"):
                with ui.row().classes("w-full items-center no-wrap justify-between"):
                    said_by("ranked", row, is_proposed)
                    if not is_stale:
                        label = "Add" if is_proposed else "Add anyway"
                        then = partial(self._session.add, row.effect)
                        add = self._begins(label, then, quiet=True)
                        named = f"{label} {proper_names(row.words)}, of the ranking"
                        add.props("dense").props["aria-label"] = named
                        if not is_proposed:
                            add.props("flat").props(remove="outline")
                said_by(
                    "candidate", row, content.steps[-1], content.unit, FAILING_ERROR
                )

    def _exports(self) -> None:
        with card().classes("last"):
            heading("Export")
            with ui.row():
                self._begins("Report", partial(self._write, REPORT_FILE), False)
                made = self._session.study_file
                for label, text, name in (
                    ("Study file", lambda: made().text(), "study.toml"),
                    ("Python script", lambda: made().script(), "study.py"),
                ):
                    button(label, partial(self._send, text, name), quiet=True)
                for label, name in (("FMU", "model.fmu"), ("C code", "model.c")):
                    self._begins(label, partial(self._write, name), True)
            ui.label(
                "Study file and script expect the CSV files in their own folder."
            ).classes("faint")

    def _write(self, name: str) -> None:
        self._wants_report = True
        self._session.report(name)

    async def deliver(self) -> None:
        """Send what was written to the browser that asked for it, when it is there."""
        path = self._session.report_path
        if self._wants_report and path is not None:
            self._wants_report = False
            await self._send(path.read_bytes, path.name)

    async def _send(self, made: Callable[[], str | bytes], name: str) -> None:
        """Hand a file to the browser, and say so where the work is told."""
        try:
            ui.download.content(await run.io_bound(made) or "", Path(name).name)
        except PhsiOptError as error:
            self._session.message = str(error)
        else:
            self._session.message = f"{name} was downloaded by the browser."
        self._session.version += 1


def titled(place: int, one: Model) -> str:
    """A model with its number."""
    return f"{place + 1}: {one.name}"


def beside(
    models: Mapping[str, StudyContent], run: Run, channel: int
) -> tuple[StudyContent, Run]:
    """Content and run (of the last model) to draw: the free runs of several models."""
    one = run.channels[channel]
    simulated = {}
    for name, content in models.items():
        for known in content.runs:
            for found in known.channels if known.title == run.title else ():
                if (found.name, found.unit) == (one.name, one.unit):
                    simulated[name] = np.interp(one.t, found.t, found.models[-1])
    channels = list(run.channels)
    channels[channel] = replace(one, models=tuple(simulated.values()))
    content = list(models.values())[-1]
    drawn = replace(content, names=tuple(simulated))
    return drawn, replace(run, channels=tuple(channels))


def rows_of(models: Sequence[StudyContent]) -> dict[str, list[str]]:
    """Errors and parameters, a text for each model; "" where it has none."""
    rows: dict[str, list[str]] = {}
    for k, one in enumerate(models):
        step = one.steps[-1]
        errors = {"training error": step.train, "held-out error": step.held_out}
        said = {}
        for name, error in errors.items():
            said[name] = "" if error is None else f"{number(error, 3)} {one.unit}"
        for row in one.models[-1].parameters:
            said[row.name] = f"{with_error(row.value, row.std_error)} {row.unit}"
        for name, text in said.items():
            rows.setdefault(name, [""] * len(models))[k] = text
    return rows
