"""The second part of the page: the base model, picked or written, with a live check."""

from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from nicegui import ui

from phsi_opt.errors import ModelError
from phsi_opt.model.expressions import names_of
from phsi_opt.model.slots import Variables
from phsi_opt.page.drafts import (
    ENERGY,
    FIRST_ORDER,
    INPUT,
    NAMES,
    PAIRS,
    REAL,
    STATE,
    TERMS,
    ColumnDraft,
    ModelDraft,
    ParameterDraft,
)
from phsi_opt.page.gallery import GALLERY, BaseModel
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
from phsi_opt.study_file.keys import listed

NOT_MEASURED = "not measured"
# The tiles are drawn anew a moment after one was chosen.
FOCUS_SOON = "setTimeout(() => document.getElementById('ID')?.focus(), 400)"
# A remark that goes leaves its place, so that no button moves from under a click.
STAYING_PLACE = "min-height: 1.5em"
NAME_FIELDS = (
    Field("states", "states", hint="q, p", kind=NAMES),
    Field("inputs", "inputs", hint="u", kind=NAMES),
)
ENERGY_FIELDS = (
    Field("pairs", "pairs: dq/dt = dH/dp", hint="q-p", kind=PAIRS),
    Field("H", "energy H", "100%", "k*q**2/2 + p**2/(2*m)", TERMS),
)
LOSS_FIELD = Field("", "loss R of {name}", "15em", "c", TERMS)
FORCE_FIELD = Field("", "force F on {name}", "15em", "u", TERMS)
PARAMETER_NAME_FIELD = Field("name", "name", "8em", "k")
START_FIELD = Field("start", "start of {name}", "10em", "found in data", REAL)
KNOWN_FIELD = Field("value", "known value of {name}", "10em", "found in data", REAL)
LIMIT_FIELDS = (
    Field("lower", "least {name}", "8em", "none", REAL),
    Field("upper", "largest {name}", "8em", "none", REAL),
    Field("unit", "unit of {name}", "8em", "N/m"),
)
MODEL_TYPES = {
    ENERGY: "energy: dx/dt = (S - R) grad H + F",
    FIRST_ORDER: "first order: dx/dt = F",
}


@dataclass(eq=False)
class ModelView:
    """Draws the draft of the model.

    Attributes:
        session: whose draft it is.
        checked: called after every change of the draft.
    """

    session: Session
    checked: Then

    @property
    def _draft(self) -> ModelDraft:
        return self.session.draft.model

    def build(self) -> None:
        """Draw it all."""
        self.gallery()
        self.fields()
        with card():
            self.wrong()

    @ui.refreshable_method
    def gallery(self) -> None:
        """The base models to begin with."""
        with card():
            heading("Base model")
            ui.label("What is known of the machine. Pick one, then change it below.")
            with ui.element("div").classes("tiles"):
                for base in GALLERY.values():
                    self._tile(base)
            if self.session.left_over:
                ui.label(self.session.left_over).classes("bad").props('role="status"')

    def _tile(self, base: BaseModel) -> None:
        is_chosen = base.title == self._draft.title
        tile = ui.element("button").classes("tile").props('type="button"')
        tile.props["aria-pressed"] = str(is_chosen).lower()
        tile.props["id"] = _tile_id(base)
        if is_chosen:
            tile.classes("chosen")
        with tile:
            chosen = " (chosen)" if is_chosen else ""
            title = ui.label(f"{base.title}{chosen}")
            title.style("font-weight: 600; line-height: 1.35")
            ui.label(base.about).classes("faint")
        tile.on("click", lambda: self._choose(base))

    async def _choose(self, base: BaseModel) -> None:
        page = ui.context.client  # the tile itself is drawn anew by then
        self.session.choose(base)
        await self.checked()
        page.run_javascript(FOCUS_SOON.replace("ID", _tile_id(base)))

    @ui.refreshable_method
    def wrong(self) -> None:
        """What is wrong with the model; parameters that formulas ask for."""
        if self.session.failure:
            alert(self.session.failure)
        if self.session.complaints or not self.session.failure:
            complaints(self.session.complaints, "Model and data can be used.")
        for name in unknown_names(self._draft):
            add = partial(self._add_parameter, name)
            button(f"Make {name} a parameter", add, quiet=True)

    @ui.refreshable_method
    def fields(self) -> None:
        """The model as it is written."""
        draft = self._draft
        with card():
            heading("The model in formulas")
            ui.label(
                "Names in formulas are states, inputs, the time t, efforts such as "
                "dH_dp, and the parameters below."
            ).classes("faint")
            with ui.element("div").classes("fields"):
                kinds = (MODEL_TYPES, draft.type, self._set_type)
                choice("kind of model", *kinds, width="20em")
                text_fields(draft.table, NAME_FIELDS, self._named)
                if draft.type == ENERGY:
                    text_fields(draft.table, ENERGY_FIELDS, self.checked)
            self.by_state()
        with card():
            heading("Parameters")
            self.parameters()

    async def _set_type(self, value: str) -> None:
        self._draft.table["type"] = value
        self.fields.refresh()
        await self.checked()

    async def _named(self) -> None:
        """States or inputs have other names now; the fields below follow."""
        self.by_state.refresh()
        await self.checked()

    @ui.refreshable_method
    def by_state(self) -> None:
        """Loss, force and column of each state; the column of each input."""
        draft = self._draft
        for name in draft.names("states"):
            with ui.element("div").classes("fields candidate"):
                ui.label(f"d{name}/dt").classes("formula").style("width: 5em")
                if draft.type == ENERGY:
                    text_fields(draft.table["R"], [LOSS_FIELD], self.checked, name)
                text_fields(draft.table["F"], [FORCE_FIELD], self.checked, name)
                self._column(STATE, name)
        for name in draft.names("inputs"):
            with ui.element("div").classes("fields candidate"):
                ui.label(name).classes("formula").style("width: 5em")
                self._column(INPUT, name)

    def _column(self, role: str, name: str) -> None:
        """Which column of the table shows a state or an input."""
        data = self.session.draft.data
        if data is None:
            return
        options = [NOT_MEASURED] if role == STATE else []
        options += [str(one.column) for one in data.columns if one.is_numeric]
        known: ColumnDraft | None = data.column_named(role, name)

        async def changed(column: str) -> None:
            chosen = None if column == NOT_MEASURED else column
            data.measure(role, name, chosen)
            self.session.shape += 1
            await self.checked()

        value = NOT_MEASURED if known is None else str(known.column)
        if value not in options:
            options.append(value)
        choice(f"column of {name}", options, value, changed, width="12em")

    @ui.refreshable_method
    def parameters(self) -> None:
        """A row for each."""
        for one in self._draft.parameters:
            self._parameter(one)
        button("Add a parameter", partial(self._add_parameter, ""), quiet=True)

    def _parameter(self, one: ParameterDraft) -> None:
        name = one.name or "new parameter"
        with ui.element("div").classes("fields candidate"):
            value = KNOWN_FIELD if one.is_known else START_FIELD
            text_fields(one.table, [PARAMETER_NAME_FIELD], self.checked)
            text_fields(one.table, [value], partial(self._given, one), name)
            text_fields(one.table, LIMIT_FIELDS, self.checked, name)
            known = ui.checkbox("known", value=one.is_known)
            known.on_value_change(lambda e: self._set_known(one, bool(e.value)))
            remove = ui.button("Remove", on_click=lambda: self._remove(one))
            remove.props("flat").props["aria-label"] = f"Remove {name}"
            if one.is_assumed:
                said = f"{one.words} is an assumption: give yours."
                note = ui.label(said).classes("bad w-full").style(STAYING_PLACE)
                note.bind_text_from(one, "is_assumed", lambda it: said if it else "")

    async def _given(self, one: ParameterDraft) -> None:
        one.is_assumed = False
        await self.checked()

    async def _set_known(self, one: ParameterDraft, is_known: bool) -> None:
        one.let_be_known(is_known)
        self.parameters.refresh()
        await self.checked()

    async def _add_parameter(self, name: str) -> None:
        self._draft.parameters.append(ParameterDraft.of(name, {}))
        self.parameters.refresh()
        await self.checked()

    async def _remove(self, one: ParameterDraft) -> None:
        self._draft.parameters.remove(one)
        self.parameters.refresh()
        await self.checked()


def _tile_id(base: BaseModel) -> str:
    return f"base-{list(GALLERY).index(base.title)}"


def unknown_names(draft: ModelDraft) -> list[str]:
    """The names that are neither variables nor parameters, each once."""
    variables = Variables(tuple(draft.names("states")), tuple(draft.names("inputs")))
    known = {one.name for one in draft.parameters}
    found: dict[str, None] = {}
    model = draft.content()
    slots = [("H", model.get("H", "")), *((s, model.get(s, {}).values()) for s in "RF")]
    for slot, formulas in slots:
        for formula in listed(formulas):
            if not isinstance(formula, str) or not formula.strip():
                continue
            with suppress(ModelError):  # the check says what is wrong with it
                names = names_of(formula) - variables.of_slot(slot) - known
                found |= dict.fromkeys(sorted(names))
    return list(found)
