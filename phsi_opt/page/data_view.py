"""The first part of the page: the table, its columns, what is held out."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from nicegui import events, run, ui

from phsi_opt.page.drafts import (
    AFTER,
    HELD_OUT_WAYS,
    INPUT,
    NOT_USED,
    REAL,
    ROLES,
    RUN,
    RUNS,
    SHARE,
    STATE,
    TIME,
    WHOLE,
    ColumnDraft,
    DataDraft,
)
from phsi_opt.page.parts import (
    Field,
    Then,
    alert,
    button,
    card,
    choice,
    complaints,
    heading,
    text_fields,
)
from phsi_opt.page.session import Session
from phsi_opt.page.table_look import (
    MOST_FILES,
    MOST_UPLOADED,
    TABLE_KINDS,
    in_megabytes,
)
from phsi_opt.presentation.numbers import number_of
from phsi_opt.study_file.keys import listed

ABOUT = (
    "A table as CSV, text or Excel workbook: one line per sample below a header. At "
    f"most {in_megabytes(MOST_UPLOADED)} a file. Several files with the same columns "
    "are several runs."
)
# What the server is told of files that the browser does not even send.
TELL_REJECTED = """(rejected) => emit(
  rejected.map(one => ({name: one.file.name, size: one.file.size})))"""
DATA_SECTIONS = ("data", "held_out")
UNIT_FIELD = Field("unit", "unit of {name}", "8em", "m")
NAME_FIELD = Field("name", "name of {name}", "9em", "as in formulas")
NOISE_FIELD = Field("noise", "noise of {name}", "14em", "estimated", REAL)
FIELDS_OF_ROLE = {
    TIME: (UNIT_FIELD,),
    STATE: (NAME_FIELD, UNIT_FIELD, NOISE_FIELD),
    INPUT: (NAME_FIELD, UNIT_FIELD),
}
STEP_FIELD = Field(
    "step", "time between lines", "14em", "no column has the times", REAL
)
THINNED_FIELD = Field(
    "thinned", "samples that become their mean", "17em", "each by itself", WHOLE
)
HELD_OUT_FIELDS = {
    SHARE: (Field("share", "share", "8em", "0.3", REAL),),
    AFTER: (Field("after", "from the time", "8em", "10", REAL),),
}


@dataclass(eq=False)
class DataView:
    """Draws the draft of the data.

    Attributes:
        session: whose draft it is.
        checked: called after every change of the draft.
        go_on: shows the next part.
    """

    session: Session
    checked: Then
    go_on: Callable[[], Any]

    def build(self) -> None:
        """Draw it all."""
        with card():
            heading("Measurements")
            ui.label(ABOUT).classes("faint")
            self._drop_zone()
            self.error()
        self.table()
        self.wrong()

    def _drop_zone(self) -> None:
        with ui.element("div").classes("drop"):
            upload = ui.upload(
                auto_upload=True,
                multiple=True,
                max_file_size=MOST_UPLOADED,
                max_files=MOST_FILES,
                on_upload=self._upload,
            )
            upload.on("rejected", self._rejected, js_handler=TELL_REJECTED)
            upload.props["accept"] = ",".join(TABLE_KINDS)
            ui.label("Drop tables here, or").classes("said q-mb-sm")
            button("Choose files", lambda: upload.run_method("pickFiles"))

    async def _upload(self, e: events.UploadEventArguments) -> None:
        content = await e.file.read()
        await run.io_bound(self.session.upload, e.file.name, content)
        e.sender.run_method("reset")

    def _rejected(self, e: events.GenericEventArguments) -> None:
        size = in_megabytes(MOST_UPLOADED)
        kinds = ", ".join(TABLE_KINDS)
        named = []
        for file in e.args:
            named.append(f"{file['name']} ({in_megabytes(file['size'])})")
        self.session.upload_error = (
            f"{', '.join(named)} was not taken: only tables ({kinds}) of at most "
            f"{size}, and at most {MOST_FILES} of them, are."
        )
        self.session.shape += 1

    @ui.refreshable_method
    def error(self) -> None:
        """Why the last file was refused."""
        if self.session.upload_error:
            alert(f"This file cannot be used. {self.session.upload_error}")

    @ui.refreshable_method
    def wrong(self) -> None:
        """What is wrong with the data as they are described."""
        if self.session.draft.data is None:
            return
        with card():
            found = self.session.complaints
            of_data = [one for one in found if one.key.split(".")[0] in DATA_SECTIONS]
            complaints(of_data, "The data can be used.")
            button("Next: the model", self.go_on)

    @ui.refreshable_method
    def table(self) -> None:
        """The columns and what is held out."""
        data = self.session.draft.data
        if data is None:
            return
        with card():
            heading("Columns")
            files = ", ".join(data.files)
            runs = number_of(len(data.runs), "run")
            ui.label(f"{files}: {data.n_samples} samples, {runs}")
            self._files(data)
            for column in data.columns:
                self._column(column)
            if not data.with_role(TIME):
                text_fields(data.time, [STEP_FIELD], self.checked)
            text_fields(data.settings, [THINNED_FIELD], self.checked)
        with card():
            heading("Held out")
            ui.label("Kept from fitting, to judge by.").classes("faint")
            self.held_out()

    def _files(self, data: DataDraft) -> None:
        """A button for each table that takes it away."""
        with ui.row().classes("gap-2"):
            for file in data.files:
                remove = ui.button(f"Remove {file}", on_click=partial(self._drop, file))
                remove.props("flat dense")

    async def _drop(self, file: str) -> None:
        await run.io_bound(self.session.remove_file, file)

    def _column(self, column: ColumnDraft) -> None:
        with ui.element("div").classes("fields candidate"):
            with ui.element("div").style("width: 11em"):
                ui.label(str(column.column)).style("font-weight: 600")
                ui.label(", ".join(column.examples)).classes("faint formula")
            roles = ROLES if column.is_numeric else (TIME, RUN, NOT_USED)
            set_role = partial(self._set_role, column)
            choice(f"{column.column} is", roles, column.role, set_role, width="10em")
            fields = FIELDS_OF_ROLE.get(column.role, ())
            text_fields(column.table, fields, self.checked, str(column.column))

    async def _set_role(self, column: ColumnDraft, role: str) -> None:
        data = self.session.draft.data
        if role in (TIME, RUN) and data is not None:
            for known in data.with_role(role):
                known.role = NOT_USED  # there is one time, and one column of runs
        column.becomes(role)
        self.table.refresh()
        await self.checked()

    @ui.refreshable_method
    def held_out(self) -> None:
        """In which way, and which part."""
        data = self.session.draft.data
        if data is None:
            return

        async def set_way(way: str) -> None:
            data.way = way
            self.held_out.refresh()
            await self.checked()

        with ui.element("div").classes("fields"):
            choice("what is held out", HELD_OUT_WAYS, data.way, set_way)
            if data.way == RUNS:
                self._runs(data)
            fields = HELD_OUT_FIELDS.get(data.way, ())
            text_fields(data.held_out, fields, self.checked)

    def _runs(self, data: DataDraft) -> None:
        async def changed(e: events.ValueChangeEventArguments) -> None:
            data.held_out["runs"] = list(e.value)
            await self.checked()

        held_out = set(listed(data.held_out.get("runs", ())))
        field = ui.select(
            data.runs,
            label="runs held out",
            multiple=True,
            value=[run for run in data.runs if run in held_out],
            on_change=changed,
        )
        field.props("dense outlined use-chips").style("min-width: 14em")
