"""The third part of the page: the verdict, the charts, the ranking, the exports."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from nicegui import ui

from phsi_opt.errors import PhsiOptError
from phsi_opt.page import charts
from phsi_opt.page.fit_view import FitView
from phsi_opt.page.parts import alert, button, card, heading
from phsi_opt.page.session import Session
from phsi_opt.page.snapshot import CandidateRow, Diagnosed, Snapshot
from phsi_opt.page.verdict_words import (
    error_words,
    facts_of,
    preview_words,
    proposed_size,
    share_left,
)
from phsi_opt.presentation.numbers import (
    capitalised,
    proper_names,
    said,
    typeset,
    with_error,
)
from phsi_opt.presentation.report_content import Answer

N_SHOWN = 5  # candidates that are shown at once
# A button that may not be pressed loses the focus; it goes to what comes of the work.
FOCUS_ON = """setTimeout(() => {
  const now = document.activeElement;
  if (now === document.body || now.disabled)
    document.getElementById('verdict')?.focus({preventScroll: true});
}, 400)"""
ADD_ALL = "Add effects automatically until the error reaches noise"
BAR = (
    "A bar is the error that would be left with the effect; a full bar is the error "
    "of the present model, and the mark in it is the noise floor."
)
STAIRCASE_HEIGHT = "height: 280px"


class StudyView:
    """Draws the study as it stands.

    Args:
        session: whose study it is.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._fit_view = FitView(session)
        self._wants_report = False
        self._resting: list[ui.button] = []  # pressed only while nothing is solved

    def show_job(self) -> None:
        """Let the buttons that begin work be pressed, or not."""
        for one in self._resting:
            one.set_enabled(self._session.job is None)

    def _begins(
        self, label: str, then: Callable[[], Any], quiet: bool, *, redraws: bool = True
    ) -> ui.button:
        """A button that begins work; it rests meanwhile.

        The focus goes on to what is drawn anew, where anything is.
        """

        def begin() -> None:
            then()
            if redraws:
                ui.run_javascript(FOCUS_ON)

        made = button(label, begin, quiet)
        made.set_enabled(self._session.job is None)
        self._resting.append(made)
        return made

    @ui.refreshable_method
    def build(self) -> None:
        """Draw it all."""
        self._resting.clear()
        snapshot = self._session.snapshot
        if snapshot is None:
            self._nothing_yet()
            return
        if self._session.failure:
            alert(self._session.failure)
        if self._session.is_stale:
            with card():
                ui.label(
                    "Data or model have changed since this was fitted. What follows "
                    "is of the model as it was."
                )
                self._begins("Fit again", self._session.fit, quiet=False)
        self._facts(snapshot)
        with ui.element("div").classes("two w-full"):
            with ui.column().classes("gap-3").style("min-width: 0"):
                self._fit_view.build(snapshot)
                self._model(snapshot)
                self._exports()
            with ui.column().classes("gap-3").style("min-width: 0"):
                self._staircase(snapshot)
                self._ranking(snapshot)

    def _nothing_yet(self) -> None:
        with card():
            heading("Nothing is fitted yet")
            if self._session.message:
                alert(self._session.message)
            if self._session.job is not None:
                ui.label("The first results come in a moment.")
            elif self._session.complaints:
                ui.label("Give the measurements and the model first: parts 1 and 2.")
            else:
                ui.label("Data and model can be used: press Fit, below.")

    # ---- the first screen ------------------------------------------------------------

    def _facts(self, snapshot: Snapshot) -> None:
        facts = facts_of(snapshot)
        verdict = card().props('role="region" aria-label="Verdict"')
        with verdict.props('id="verdict" tabindex="-1"'):
            if facts is None:
                self._not_asked(snapshot)
                return
            self._badge(snapshot)
            ui.label(said(facts.sentence)).classes("sentence")
            if snapshot.diagnosed is not None:
                ui.label(snapshot.diagnosed.certainty)
            with ui.element("div").classes("facts w-full"):
                with ui.element("div"):
                    heading("What is wrong", 3).classes("faint")
                    color = "bad" if facts.add or snapshot.diagnosed else ""
                    is_good = snapshot.diagnosed and not snapshot.diagnosed.is_missing
                    self._lead(facts.what.lead, "good" if is_good else color)
                    self._detail(facts.what.detail)
                with ui.element("div"):
                    heading("Where", 3).classes("faint")
                    self._lead(facts.where.lead)
                    self._detail(facts.where.detail)
                with ui.element("div"):
                    heading("Since when", 3).classes("faint")
                    self._lead(facts.since.lead)
                    self._detail(facts.since.detail)
                with ui.element("div"):
                    is_told = bool(facts.to_do.lead)
                    question = "What to do next" if is_told else "What to add"
                    heading(question, 3).classes("faint")
                    if is_told:
                        self._to_do(snapshot, facts.to_do)
                    if facts.add or not is_told:
                        self._what_to_add(snapshot, facts.add, facts.preview)
            if snapshot.caution:
                ui.label(snapshot.caution)
            if snapshot.warning:
                alert(snapshot.warning)

    @staticmethod
    def _badge(snapshot: Snapshot) -> None:
        """The verdict in its own words."""
        diagnosed = snapshot.diagnosed
        if diagnosed is None:
            return
        color = "bad" if diagnosed.is_missing else "good"
        with ui.row().classes("w-full items-center gap-2"):
            ui.label(diagnosed.verdict).classes(f"badge {color}")
            if diagnosed.beside:
                ui.label(diagnosed.beside).classes("badge look")
            if snapshot.unestablished:
                ui.label(snapshot.unestablished).classes("badge look")

    @staticmethod
    def _lead(text: str, color: str = "") -> None:
        """What is to be understood at once."""
        ui.label(said(text)).classes(color).style("font-weight: 600; line-height: 1.35")

    @staticmethod
    def _detail(text: str) -> None:
        """What stands behind it."""
        if text:
            ui.label(said(text)).classes("faint")

    def _not_asked(self, snapshot: Snapshot) -> None:
        error = snapshot.steps[-1]
        heading("Fitted; what is missing is not known yet")
        ui.label(
            f"The error is {error_words(snapshot, error.judged)}; noise alone would "
            f"leave {error_words(snapshot, error.floor)}."
        )
        self._begins("Look for what is missing", self._session.diagnose, False)

    def _to_do(self, snapshot: Snapshot, to_do: Answer) -> None:
        """What to do where nothing is named, with a button where the page can."""
        self._lead(to_do.lead)
        averaged = 0 if snapshot.diagnosed is None else snapshot.diagnosed.averaged
        if averaged and not self._session.is_stale:
            label = f"Average every {averaged} samples and fit again"
            self._begins(label, lambda: self._session.average(averaged), quiet=False)
        self._detail(to_do.detail)

    def _what_to_add(self, snapshot: Snapshot, add: str, preview: str) -> None:
        if not add or snapshot.diagnosed is None:
            ui.label("Nothing more." if snapshot.added else "Nothing.")
            if snapshot.added:
                ui.label(proper_names(f"Added: {' and '.join(snapshot.added)}."))
            ui.label(preview).classes("faint")
            return
        size = proposed_size(snapshot)
        is_named = snapshot.diagnosed.is_named
        if is_named:
            ui.label(said(capitalised(f"{add}{size}"))).style("font-weight: 600")
            ui.label(said(preview))
        else:
            told = f"Nearest, but not proven: {add}{size}. {preview}."
            ui.label(said(told)).classes("faint")
        if not self._session.is_stale:
            begin = "Add" if is_named else "Try"
            label = proper_names(f"{begin} {add}")
            self._add_button(label, add, quiet=not is_named)

    def _add_button(self, label: str, effect: str, quiet: bool = False) -> ui.button:
        return self._begins(label, lambda: self._session.add(effect), quiet)

    # ---- staircase and ranking -------------------------------------------------------

    def _staircase(self, snapshot: Snapshot) -> None:
        with card():
            heading("Error after each step")
            figure = charts.staircase(snapshot.steps, snapshot.unit)
            errors = ", ".join(
                f"{step.label} {step.judged:.3g}" for step in snapshot.steps
            )
            plot = ui.plotly(figure).classes("w-full").style(STAIRCASE_HEIGHT)
            told = f"Chart: error after each step: {errors}"
            plot.props('role="img"').props["aria-label"] = told
            with ui.row():
                if len(snapshot.steps) > 1:
                    self._begins("Undo the last step", self._session.undo, True)
                diagnosed = snapshot.diagnosed
                if diagnosed is None or diagnosed.proposed:
                    auto = self._session.auto
                    self._begins(ADD_ALL, auto, True)

    def _ranking(self, snapshot: Snapshot) -> None:
        diagnosed = snapshot.diagnosed
        if diagnosed is None:
            return
        with card():
            heading(_title_of_ranking(diagnosed))
            ui.label(BAR).classes("faint")
            for row in diagnosed.candidates[:N_SHOWN]:
                self._candidate(snapshot, row)
            further = diagnosed.candidates[N_SHOWN:]
            if further:
                with ui.expansion(f"{len(further)} more").classes("w-full"):
                    for row in further:
                        self._candidate(snapshot, row)

    def _candidate(self, snapshot: Snapshot, row: CandidateRow) -> None:
        with ui.column().classes("candidate gap-1"):
            proposed = " (proposed)" if row.is_proposed else ""
            size = f": {row.size}" if row.size else ""
            with ui.row().classes("w-full items-center no-wrap justify-between"):
                told = proper_names(typeset(f"{row.effect}{size}{proposed}"))
                ui.label(told).style("font-weight: 600")
                if not self._session.is_stale:
                    self._add_of_ranking(row)
            left, floor = share_left(snapshot, row)
            with ui.element("div").classes("track").props('aria-hidden="true"'):
                ui.element("div").style(f"width: {100 * left:.1f}%")
                ui.element("i").style(f"left: {100 * floor:.1f}%")
            ui.label(said(f"Evidence: {row.evidence}. {preview_words(snapshot, row)}"))
            if row.lost:
                ui.label(f"Not proposed: {said(row.lost)}.").classes("faint")
            if row.confusable_with:
                others = proper_names(", ".join(row.confusable_with))
                ui.label(f"The data do not tell it from {others}.").classes("faint")

    def _add_of_ranking(self, row: CandidateRow) -> None:
        """The button of a candidate; flat where something speaks against it."""
        diagnosed = self._session.snapshot and self._session.snapshot.diagnosed
        is_against = bool(row.lost) or not (diagnosed and diagnosed.is_named)
        label = "Add anyway" if is_against else "Add"
        add = self._add_button(label, row.effect, quiet=True)
        named = proper_names(row.effect)
        add.props("dense").props["aria-label"] = f"{label} {named}, of the ranking"
        if is_against:
            add.props("flat").props(remove="outline")

    # ---- the model and the exports ---------------------------------------------------

    def _model(self, snapshot: Snapshot) -> None:
        with card().classes("last"):
            heading("The model now")
            for equation in snapshot.equations:
                ui.label(typeset(equation)).classes("formula")
            with ui.expansion("Parameters").classes("w-full"):
                for row in snapshot.parameters:
                    value = with_error(row.value, row.std_error)
                    text = f"{row.name} = {value} {row.unit}"
                    ui.label(typeset(text)).classes("formula")
            if snapshot.diagnosed is not None:
                with ui.expansion("What the diagnosis says").classes("w-full"):
                    ui.label(snapshot.diagnosed.verdict).style("font-weight: 600")
                    ui.label(said(snapshot.diagnosed.reason))
                    for sentence in snapshot.diagnosed.sentences:
                        ui.label(said(sentence))
            if snapshot.stopped:
                ui.label(f"The automatic study stopped: {snapshot.stopped}")

    def _exports(self) -> None:
        with card().classes("last"):
            heading("Take it away")
            with ui.row():
                self._begins("Report", self._report, False, redraws=False)
                button("Study file", self._study_file, quiet=True)
                button("Python script", self._script, quiet=True)
            ui.label(
                "Study file and script look for the CSV files beside themselves."
            ).classes("faint")

    def _report(self) -> None:
        self._wants_report = True
        self._session.report()

    def deliver(self) -> None:
        """Send the report to the browser that asked for it, when it is there."""
        path = self._session.report_path
        if self._wants_report and path is not None:
            self._wants_report = False
            self._download(path.read_bytes(), path.name)

    def _download(self, content: bytes | str, name: str) -> None:
        """Hand a file to the browser, and say so where the work is told."""
        ui.download.content(content, name)
        self._session.message = (
            f"{name} was handed to the browser, among its downloads."
        )
        self._session.version += 1

    def _study_file(self) -> None:
        self._send(self._session.study_text, "study.toml")

    def _script(self) -> None:
        self._send(self._session.script, "study.py")

    def _send(self, text: Callable[[], str], name: str) -> None:
        try:
            self._download(text(), Path(name).name)
        except PhsiOptError as error:
            self._session.message = str(error)
            self._session.version += 1


def _title_of_ranking(diagnosed: Diagnosed) -> str:
    """What the list of effects is: none of them may be what is missing."""
    if diagnosed.is_named:
        return "Effects, best first"
    return "Tried, none accepted" if diagnosed.is_missing else "Tried, none needed"
