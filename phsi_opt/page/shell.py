"""The page as a whole: its three parts, the work that goes on, and keeping up with it.

A page asks its session a few times a second whether something has changed, and draws
that anew. So it does not matter how often it is loaded, or in how many windows.
"""

import traceback
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from nicegui import app, run, ui

from phsi_opt.errors import concise
from phsi_opt.page.draft_views import (
    DATA_PART,
    MODEL_PART,
    STUDY_PART,
    DataView,
    ModelView,
)
from phsi_opt.page.parts import alert, button, heading
from phsi_opt.page.session import Session
from phsi_opt.page.study_view import StudyView
from phsi_opt.presentation.html_report import ours
from phsi_opt.study_file.survey import value_words

PRIMARY = "#1f5fa8"  # 6.5:1 below white text
ON_PRIMARY = "#ffffff"
# The next key acts on the part that is shown, and its top is seen.
FOCUS_CONTENT = """
window.scrollTo(0, 0);
document.getElementById('content').focus({preventScroll: true});
"""
# Where the key that began a solve was redrawn, the focus goes to what came of it.
FOCUS_VERDICT = """
if (document.activeElement === document.body || document.activeElement.disabled)
  document.getElementById('verdict')?.focus({preventScroll: true});
"""
# Keys press the buttons of the header; a text field undoes what is typed in it itself.
UNDO_BY_KEYS = """
document.documentElement.lang = "en";
document.addEventListener("keydown", (event) => {
  const field = event.target.closest("input, textarea"), key = event.key.toLowerCase();
  if (!(event.ctrlKey || event.metaKey) || event.altKey || !"zy".includes(key)) return;
  if (field && !field.readOnly && field.type !== "checkbox") return;
  const name = key === "y" || event.shiftKey ? "Control+Y" : "Control+Z";
  document.querySelector(`[aria-keyshortcuts="${name}"]`)?.click();
  event.preventDefault();
});
"""
READY = "Ready."
FAILED = (
    "This is a bug in phsi_opt: {} ({}). A part of the page may be missing, and the "
    "last change may not have been made. Load the page again; if this comes back, "
    "use `phsi-opt` on the command line, and report the bug with this text."
)
PAGE_PARTS = (DATA_PART, MODEL_PART, STUDY_PART)
# Their buttons, and the keys that press them.
UNDO_AND_REDO = {-1: ("Undo", "Control+Z"), 1: ("Redo", "Control+Y")}
HEADER_BUTTON = "flat color=primary"


class Shell:
    """One page of a browser; pages whose session is ended are loaded again."""

    def __init__(self, session: Session, begin_again: Callable[[], object]) -> None:
        self._session = session
        self._begin_again = begin_again
        self._failures: set[str] = set()  # that the page shows
        self._data = DataView(session, self._checked, self._go)
        self._model = ModelView(session, self._checked)
        self._study = StudyView(session)
        self._shape = session.shape
        self._version = session.version
        self._drawn = self._to_draw()
        self._job = session.job

    def build(self) -> None:
        self._client = ui.context.client  # what was pressed may be gone by then
        ui.colors(primary=PRIMARY, onprimary=ON_PRIMARY)
        ui.add_css(Path(str(files("phsi_opt.page") / "page.css")))
        ui.add_css(ours("chart.css"))
        ui.add_body_html(f"<script>{ours('chart.js')}{UNDO_BY_KEYS}</script>")
        ui.dark_mode(value=None)  # as the system
        views: Any = (self._data, self._model, self._study)
        self._to_build = dict(zip(PAGE_PARTS, views, strict=True))
        with ui.header().classes("items-center justify-between q-py-xs"):
            ui.link("Skip to the content", "#content").classes("skip")
            heading("phsi_opt", 1)
            with ui.tabs().props("dense no-caps") as self._tabs:
                for name in PAGE_PARTS:
                    ui.tab(name)
            with ui.row().classes("gap-1 no-wrap items-center"):
                self._steps = {}
                for by, (name, keys) in UNDO_AND_REDO.items():
                    step = ui.button(name, on_click=partial(self._step, by))
                    self._steps[by] = step.props(HEADER_BUTTON)
                    step.props["aria-keyshortcuts"] = keys
                ui.button("New", on_click=self._ask_to_begin_again).props(HEADER_BUTTON)
        session = self._session
        # Whether there is more to see than fields to fill in.
        has_begun = session.content is not None or session.job is not None
        is_filled = session.draft.data is not None and not session.complaints
        first = STUDY_PART if has_begun or is_filled else DATA_PART
        ui.on_exception(self._tell_failure)
        content = ui.element("div").classes("page").props('id="content" tabindex="-1"')
        with content:
            self._failed = ui.column().classes("w-full")
            panels = ui.tab_panels(self._tabs, value=first, animated=False)
        with panels.classes("w-full"):
            self._panels = {}
            for name in PAGE_PARTS:
                with ui.tab_panel(name), ui.column().classes("w-full gap-3") as panel:
                    self._panels[name] = panel
        self._tabs.on_value_change(lambda e: self._build_part(e.value))
        self._build_part(first)
        with ui.footer().classes("q-pa-none") as self._footer:
            self._build_status()
        self._asking = ui.timer(0.1, self._keep_up)  # s: no reader waits

    def _build_part(self, name: str) -> None:
        """Draw a part when it is first shown."""
        view = self._to_build.pop(name, None)
        if view is not None:
            with self._panels[name]:
                _draw(view.build)

    def _tell_failure(self, error: Exception) -> None:
        """Show what failed, as long as the page is there."""
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f"line {last.lineno} of {Path(last.filename).name}"
        what = concise(f"{type(error).__name__}: {error}")
        said = FAILED.format(what, place)
        if said not in self._failures:
            self._failures.add(said)
            with self._failed:
                alert(said)

    async def _step(self, by: int) -> None:
        """Undo or redo a change; show the part that it is in."""
        part = await run.io_bound(self._session.step, by)
        if part:
            self._tabs.set_value(PAGE_PARTS[("data", "model", "study").index(part)])
        await self._keep_up()

    def _ask_to_begin_again(self) -> None:
        """Ask first: there is no way back."""
        with ui.dialog() as dialog, ui.column().classes("card gap-3"):
            heading("Delete this study?")
            ui.label("Its table, model and results are deleted from this page.")
            with ui.row():
                button("Keep it", dialog.close)
                button("Delete it", self._begin_again, quiet=True)
        dialog.open()

    def _go(self, part: str) -> None:
        self._tabs.set_value(part)
        self._client.run_javascript(FOCUS_CONTENT)

    async def _checked(self) -> None:
        self._session.shape += 1  # other windows draw the fields anew
        self._shape += 1  # here they show it
        await run.io_bound(self._session.check)

    # ---- the work that goes on -------------------------------------------------------

    def _build_status(self) -> None:
        """What is done now, with the button that ends it; or how it ended."""
        # Its parts stay and are changed, so that the button keeps the focus.
        session = self._session
        with ui.row().classes("w-full items-center gap-3 page no-wrap"):
            self._line = ui.label().style("flex: 1; min-width: 0")
            self._line.props('role="status" aria-live="polite"')
            self._times = ui.label().style("max-width: 45%; text-align: right")
            self._cancel = button("Cancel", partial(run.io_bound, session.cancel))
            self._begin = button("Fit", partial(run.io_bound, session.fit))
        self._show_status()

    def _show_status(self) -> None:
        job = self._session.job
        self._study.is_free = job is None
        for by, step in self._steps.items():
            step.set_enabled(self._session.can_step(by))
        self._begin.set_visibility(_can_begin(self._session))
        self._begin.set_enabled(not self._session.complaints)
        for part in (self._times, self._cancel):
            part.set_visibility(job is not None)
        said = self._session.message or _what_next(self._session)
        if job is not None:
            said = job.words
            self._times.set_text(job.times)
        self._line.set_text(said)
        self._footer.set_value(said != READY)  # it would only cover what is below

    async def _keep_up(self) -> None:
        """Draw anew what has changed since the last look."""
        session = self._session
        session.show_up()
        if session.is_closed:
            self._asking.deactivate()
            ui.navigate.reload()
            return
        if session.job is not self._job:  # in whatever window it was begun
            self._job = session.job
            if self._job is not None and self._tabs.value != STUDY_PART:
                self._go(STUDY_PART)
        if session.shape != self._shape:
            self._shape = session.shape
            data = self._data
            _draw(data.error.refresh, data.examples.refresh, data.table.refresh)
            _draw(self._model.gallery.refresh, self._model.fields.refresh)
        if session.version != self._version:
            self._version = session.version
            self._show_changes()
        elif session.job is not None:
            self._show_status()
        await self._study.deliver()

    def _show_changes(self) -> None:
        self._show_status()
        _draw(self._data.wrong.refresh, self._model.wrong.refresh)
        study = self._study.build.refresh
        views = (self._data.seen.refresh, self._study.follows.refresh, study)
        known, self._drawn = self._drawn, self._to_draw()
        for view, before, now in zip(views, known, self._drawn, strict=True):
            if before != now:
                _draw(view)
        if known[-1] != self._drawn[-1]:
            self._client.run_javascript(FOCUS_VERDICT)

    def _to_draw(self) -> tuple[object, ...]:
        """What the views that are drawn anew when it changes are drawn from."""
        session = self._session
        laws = session.model.laws if session.model else ()
        return session.seen_data, laws, self._of_study()

    def _of_study(self) -> tuple[object, ...]:
        session = self._session
        if session.content is None:
            return session.job, session.complaints, session.failure
        is_asked = session.is_diagnosing
        return session.content, session.is_stale, session.failure, is_asked


def _draw(*parts: Callable[[], object]) -> None:
    """Draw each of some parts; one that fails is told, and stops no other."""
    for part in parts:
        try:
            part()
        except Exception as error:
            app.handle_exception(error)


def _can_begin(session: Session) -> bool:
    """Whether there is a draft that was not fitted as it is."""
    if session.job is not None or session.draft.data is None:
        return False
    is_new = session.content is None or session.is_stale or bool(session.failure)
    return is_new and bool(session.draft.model.names("states"))


def _what_next(session: Session) -> str:
    """What to do next, where nothing goes on."""
    if session.content is not None:
        return READY
    if session.draft.data is None:
        return "Start with the measurements: part 1."
    if not session.draft.model.names("states"):
        return "Next, the model: part 2."
    if session.complaints:
        return f"Still to correct: {len(session.complaints)} in part 2."
    said = "Data and model are valid: press Fit."
    parameters = session.draft.model.parameters
    known = [one for one in parameters if one.get("is_assumed")]
    assumed = [value_words(one["name"], one) for one in known]
    if assumed:
        said += f" Assumed, not measured: {', '.join(assumed)}."
    return said
