"""The first two parts of the page: the table and its columns, and the base model."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

from nicegui import events, run, ui

from phsi_opt.errors import Complaint
from phsi_opt.page.drafts import (
    MOST_FILES,
    MOST_UPLOADED,
    NOTHING,
    PARTS_OF_COLUMNS,
    STUDY_KIND,
    TABLE_KINDS,
    USUAL,
    USUAL_WAYS,
    WAYS,
    Content,
    DataDraft,
    ModelDraft,
    in_megabytes,
    let_be_known,
    parameter_of,
)
from phsi_opt.page.parts import (
    Then,
    alert,
    button,
    card,
    choice,
    complaints,
    field_row,
    fields,
    heading,
    label_of,
    plotted,
    plotted_data,
    said_by,
)
from phsi_opt.page.session import Session
from phsi_opt.presentation.numbers import number_of
from phsi_opt.study_file.columns import (
    INPUT,
    KEYS_OF_PARTS,
    RUN,
    STATE,
    TIME,
    UNUSED,
    Column,
)
from phsi_opt.study_file.gallery import GALLERY, BaseModel
from phsi_opt.study_file.keys import key_at, listed
from phsi_opt.study_file.model_reading import WITH_ENERGY, WITHOUT_ENERGY
from phsi_opt.study_file.survey import value_words

# ---- part 1: the measurements --------------------------------------------------------

ABOUT = (
    "phsi_opt compares your model of a machine with measurements, and finds which "
    "physical effect is missing in it and how large it is. Begin with a table: CSV, "
    "text or Excel, one line per sample below a header, or a logger's MDF or TDMS "
    f"file, of at most {in_megabytes(MOST_UPLOADED)}. Several files with the same "
    "columns are several runs. A study file (.toml) opens with its tables; "
    "one with blocks, or a model alone, is the base model."
)
EXAMPLES = {
    "spring": "Damped spring",
    "motor": "Motor with steps of voltage",
    "house": "Heated room",
}
DATA_PART = "1 Data"
MODEL_PART = "2 Model"
STUDY_PART = "3 Study"
# What the server is told of files that the browser does not even send.
TELL_REJECTED = """(rejected) => emit(
  rejected.map(one => ({name: one.file.name, size: one.file.size})))"""
DATA_SECTIONS = ("data", *USUAL_WAYS)
FIELDS_OF_PART = {
    TIME: "unit date_format",
    STATE: "name unit noise",
    INPUT: "name unit hold",
}


@dataclass(eq=False)
class DataView:
    """Draws the draft of the data."""

    session: Session  # whose draft it is
    checked: Then  # called after every change of the draft
    go: Callable[[str], Any]  # shows a part

    def build(self) -> None:
        with card():
            heading("Measurements")
            ui.label(ABOUT).classes("faint")
            with ui.element("div").classes("drop"):
                upload = ui.upload(
                    auto_upload=True,
                    multiple=True,
                    max_file_size=MOST_UPLOADED,
                    max_files=MOST_FILES,
                    on_upload=self._upload,
                )
                upload.on("rejected", self._rejected, js_handler=TELL_REJECTED)
                upload.props["accept"] = ",".join((*TABLE_KINDS, STUDY_KIND))
                ui.label("Drop tables here, or").classes("said q-mb-sm")
                button("Choose files", lambda: upload.run_method("pickFiles"))
            self.error()
        self.examples()
        self.seen()
        self.table()
        self.wrong()

    async def _upload(self, e: events.UploadEventArguments) -> None:
        content = await e.file.read()
        await run.io_bound(self.session.upload, e.file.name, content)
        e.sender.run_method("reset")

    def _rejected(self, e: events.GenericEventArguments) -> None:
        named = [f"{one['name']} ({in_megabytes(one['size'])})" for one in e.args]
        self.session.upload_error = (
            f"{', '.join(named)} was rejected: the page accepts tables "
            f"({', '.join(TABLE_KINDS)}) of at most {in_megabytes(MOST_UPLOADED)}, up "
            f"to {MOST_FILES} of them."
        )
        self.session.shape += 1

    @ui.refreshable_method
    def examples(self) -> None:
        if self.session.draft.data is not None:
            return
        with card():
            heading("Or try an example")
            ui.label("Simulated measurements; one effect is missing from the model.")
            with ui.row():
                for name, title in EXAMPLES.items():
                    button(title, partial(self._open_example, name), quiet=True)

    async def _open_example(self, name: str) -> None:
        await run.io_bound(self.session.open_example, name)
        self.go(STUDY_PART)

    @ui.refreshable_method
    def seen(self) -> None:
        chart = self.session.seen_data.chart
        if chart is not None:
            with card():
                plot = plotted_data(chart)
                if chart.clock:
                    self._offer_stretch(plot)
                said_by("noticed", self.session.seen_data.rows)
                spectrum = self.session.seen_data.spectrum
                if spectrum is not None and spectrum.panels:
                    with ui.expansion("Spectrum").classes("w-full"):
                        height = 90 + 120 * len(spectrum.panels)
                        plotted(spectrum, "Chart: the spectrum of each channel", height)

    def _offer_stretch(self, plot: ui.element) -> None:
        """A button that keeps only the stretch that the chart shows."""
        stretch: list[float] = []

        def zoomed(e: events.GenericEventArguments) -> None:
            stretch[:] = e.args["detail"]
            use.set_visibility(bool(stretch))
            use.set_text("Use only t = {} to {}".format(*stretch or (0, 0)))

        async def keep() -> None:
            data = self.session.draft.data
            if data is not None and stretch:
                data.settings["between"] = list(stretch)
                self.table.refresh()
                await self.checked()

        plot.on("stretch", zoomed, ["detail"])
        use = button("Use only this", keep, quiet=True)
        use.set_visibility(False)

    @ui.refreshable_method
    def error(self) -> None:
        if self.session.upload_error:
            alert(f"This file cannot be used. {self.session.upload_error}")

    @ui.refreshable_method
    def wrong(self) -> None:
        if self.session.draft.data is None:
            return
        with card():
            found = self.session.complaints
            of_data = [one for one in found if one.key.split(".")[0] in DATA_SECTIONS]
            complaints(of_data, "The data are valid.")
            button("Next: the model", lambda: self.go(MODEL_PART))

    @ui.refreshable_method
    def table(self) -> None:
        data = self.session.draft.data
        if data is None:
            return
        with card():
            heading("Columns")
            files = ", ".join(data.places)
            runs = number_of(len(data.runs), "run")
            ui.label(f"{files}: {data.n_samples} samples, {runs}")
            with ui.row().classes("gap-2"):
                for file in data.places:
                    drop = partial(run.io_bound, self.session.remove_file, file)
                    remove = ui.button(f"Remove {file}", on_click=drop)
                    remove.props("flat dense")
            if len(data.sheets) > 1:
                word = "sheet" if "sheet" in data.settings else "group of channels"
                choice(word, sorted(data.sheets), data.sheets[0], self._set_sheet)
            for column in data.columns:
                self._column(data, column)
            if not data.of_part(TIME):
                fields(data.time, "data.time", "step unit", self.checked, "the times")
            with ui.element("div").classes("fields"):
                keys = "between detrended resampled thinned"
                fields(data.settings, "data", keys, self.checked)
            about = self.session.draft.kept.setdefault("study", {})
            fields(about, "study", "title", self.checked)
        with card():
            heading("Data not used for fitting")
            self.parts()

    async def _set_sheet(self, name: str) -> None:
        await run.io_bound(self.session.choose_sheet, name)

    def _column(self, data: DataDraft, column: Column) -> None:
        async def set_part(part: str) -> None:
            if part in (TIME, RUN):
                for known in data.of_part(part):
                    known.part = UNUSED  # there is one time, and one column of runs
            column.part = part
            self.table.refresh()
            await self.checked()

        with field_row():
            with ui.element("div").style("width: 11em"):
                ui.label(column.heading).style("font-weight: 600")
                with ui.row().classes("gap-2 faint formula"):  # broken between them
                    for example in column.examples:
                        ui.label(example)
            parts = PARTS_OF_COLUMNS if column.is_numeric else (TIME, RUN, UNUSED)
            choice(f"{column.heading} is", parts, column.part, set_part)
            if column.part in KEYS_OF_PARTS:
                shown = (KEYS_OF_PARTS[column.part], FIELDS_OF_PART[column.part])
                fields(vars(column), *shown, self.checked, column.heading)

    @ui.refreshable_method
    def parts(self) -> None:
        """The data held out and those for the end: in which way, and which."""
        data = self.session.draft.data
        if data is None:
            return
        for section in USUAL_WAYS:
            ui.label(key_at(section).sentence).classes("faint")
            with ui.element("div").classes("fields"):
                self._part(section, data.runs, data.parts[section])

    def _part(self, section: str, runs: list[str], part: Content) -> None:
        async def set_way(way: str) -> None:
            part["way"] = way
            self.parts.refresh()
            await self.checked()

        async def set_runs(e: events.ValueChangeEventArguments) -> None:
            part["runs"] = list(e.value)
            await self.checked()

        known = (USUAL_WAYS[section], *WAYS, NOTHING)
        ways = {one: WAYS.get(one, one) for one in known}
        if USUAL in ways and len(runs) < 3:
            ways[USUAL] = "none (too few runs)"
        choice(label_of(section), ways, part["way"], set_way)
        if part["way"] == "runs":
            chosen = set(listed(part.get("runs", ())))
            field = ui.select(
                runs,
                label=label_of(f"{section}.runs"),
                multiple=True,
                value=[run for run in runs if run in chosen],
                on_change=set_runs,
            )
            field.props("dense outlined use-chips").style("min-width: 14em")
        elif part["way"] in WAYS:
            fields(part, section, part["way"], self.checked)


# ---- part 2: the base model, picked or written, with a live check --------------------

FOCUS_SOON = "setTimeout(() => document.getElementById('ID')?.focus(), 400)"
# A remark that goes leaves its place, so that no button moves from under a click.
STAYING_PLACE = "min-height: 2.5em; width: 100%"
PARAMETER = "parameters.*"
UNKNOWN = re.compile(r"'(\w+)' is not known here")  # what a formula has that is wrong
MODEL_TYPES = {
    WITH_ENERGY: "energy: dx/dt = (S - R) grad H + F",
    WITHOUT_ENERGY: "first order: dx/dt = F",
}


@dataclass(eq=False)
class ModelView:
    """Draws the draft of the model."""

    session: Session  # whose draft it is
    checked: Then  # called after every change of the draft

    @property
    def _draft(self) -> ModelDraft:
        return self.session.draft.model

    def build(self) -> None:
        self.gallery()
        self.fields()
        with card():
            self.wrong()

    @ui.refreshable_method
    def gallery(self) -> None:
        with card():
            heading("Base model")
            ui.label("Choose a base model of the machine, then edit it below.")
            with ui.element("div").classes("tiles"):
                for number, base in enumerate(GALLERY.values()):
                    self._tile(f"base-{number}", base)

    def _tile(self, tile_id: str, base: BaseModel) -> None:
        async def choose() -> None:
            page = ui.context.client  # the tile itself is drawn anew by then
            await run.io_bound(self.session.choose, base)
            await self.checked()
            page.run_javascript(FOCUS_SOON.replace("ID", tile_id))

        is_chosen = base.name == self._draft.title
        tile = ui.element("button").classes("tile").props('type="button"')
        tile.props["aria-pressed"] = str(is_chosen).lower()
        tile.props["id"] = tile_id
        tile.classes("chosen" if is_chosen else "")
        with tile:
            drawing = ui.html(base.picture, sanitize=False).classes("picture")
            drawing.props('aria-hidden="true"')
            title = ui.label(base.title + (" (chosen)" if is_chosen else ""))
            title.style("font-weight: 600; line-height: 1.35")
            ui.label(base.about).classes("faint")
        tile.on("click", choose)

    @ui.refreshable_method
    def wrong(self) -> None:
        """What is wrong with the model; parameters that formulas ask for."""
        if self.session.failure:
            alert(self.session.failure)
        if self.session.complaints or not self.session.failure:
            complaints(self.session.complaints, "Model and data are valid.")
        for name in unknown_names(self.session.complaints):
            add = partial(self._add_parameter, name)
            button(f"Make {name} a parameter", add, quiet=True)

    @ui.refreshable_method
    def fields(self) -> None:
        draft = self._draft
        with card():
            heading("The model in formulas")
            ui.label(
                "Names in formulas are states, inputs, the time t, efforts such as "
                "dH_dp, and the parameters below."
            ).classes("faint")
            with ui.element("div").classes("fields"):
                choice("kind of model", MODEL_TYPES, draft.type, self._set_type)
                fields(draft.table, "model", "states inputs", self._named)
                if draft.type == WITH_ENERGY:
                    fields(draft.table, "model", "pairs H", self.checked)
            self.by_state()
        with card():
            heading("Parameters")
            self.parameters()

    async def _set_type(self, value: str) -> None:
        self._draft.table["type"] = value
        self.fields.refresh()
        await self.checked()

    async def _named(self) -> None:
        self.by_state.refresh()
        await self.checked()

    @ui.refreshable_method
    def by_state(self) -> None:
        draft = self._draft
        states = draft.names("states")
        every = dict.fromkeys((*states, *draft.table["R"], *draft.table["F"]))
        for name in every:
            if name.isidentifier() and name not in states:
                continue
            label = f"d{name}/dt" if name in states else name
            with field_row():
                ui.label(label).classes("formula").style("width: 5em")
                if draft.type == WITH_ENERGY:
                    fields(draft.table["R"], "model.R", "*", self.checked, name)
                fields(draft.table["F"], "model.F", "*", self.checked, name)

    @ui.refreshable_method
    def parameters(self) -> None:
        for one in self._draft.parameters:
            self._parameter(one)
        button("Add a parameter", partial(self._add_parameter, ""), quiet=True)

    def _parameter(self, one: Content) -> None:
        is_known = bool(one.get("fixed"))
        name = str(one.get("name", ""))

        async def given() -> None:
            one["is_assumed"] = False
            await self.checked()

        async def renamed() -> None:
            now = str(one.get("name", ""))
            for key, field in made.items():
                field.props["label"] = label_of(f"{PARAMETER}.{key}", now)
            removing.props["aria-label"] = f"Remove {now or 'this parameter'}"
            await self.checked()

        def set_known(e: events.ValueChangeEventArguments) -> Any:
            let_be_known(one, bool(e.value))
            return self._redraw_parameters()

        def remove() -> Any:
            self._draft.parameters.remove(one)
            return self._redraw_parameters()

        with field_row():
            key = "value" if is_known else "start"
            made = fields(one, PARAMETER, "name", renamed, name)
            made |= fields(one, PARAMETER, key, given, name)
            made |= fields(one, PARAMETER, "lower upper unit", self.checked, name)
            ui.checkbox("known", value=is_known).on_value_change(set_known)
            removing = ui.button("Remove", on_click=remove).props("flat")
            removing.props["aria-label"] = f"Remove {name or 'this parameter'}"
            if one.get("is_assumed"):
                place = ui.element("div").style(STAYING_PLACE)
                with place, ui.row().classes("items-center") as row:
                    words = value_words(name, one)
                    said = f"{words} is an assumption: enter your value, or"
                    ui.label(said).classes("bad")
                    button(f"Confirm {words}", given, quiet=True).props("dense")
                row.bind_visibility_from(one, "is_assumed")

    async def _add_parameter(self, name: str) -> None:
        self._draft.parameters.append(parameter_of(name, {}))
        await self._redraw_parameters()

    async def _redraw_parameters(self) -> None:
        self.parameters.refresh()
        await self.checked()


def unknown_names(complaints: Iterable[Complaint]) -> list[str]:
    """The names in formulas that are neither variables nor parameters, each once."""
    found = filter(None, [UNKNOWN.match(one.said) for one in complaints])
    return list(dict.fromkeys(one[1] for one in found))
