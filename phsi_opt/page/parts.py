"""Small parts that all views are made of."""

import json
import re
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

from nicegui import events, ui
from nicegui.elements.mixins.text_element import TextElement

from phsi_opt.errors import Complaint
from phsi_opt.page.drafts import NAMES, PAIRS, TERMS, TEXT, Content, Kind
from phsi_opt.presentation.charts import Chart, figure
from phsi_opt.presentation.sentences import environment

DEBOUNCE = "debounce=400"  # ms without a key before a text is checked
FORMULAS = (NAMES, PAIRS, TERMS)  # kinds that are set in the type of formulas
Then = Callable[[], Awaitable[None]]


def heading(text: str, level: int = 2) -> TextElement:
    """A heading that screen readers know."""
    return TextElement(tag=f"h{level}", text=text)


def card() -> ui.element:
    """A box with a border."""
    return ui.column().classes("card gap-3")


def field_row() -> ui.element:
    """Fields side by side, below a line."""
    return ui.element("div").classes("fields candidate")


class Field(NamedTuple):
    """A text of a table of a draft: its key, its label, its width, what shows it empty.

    The label may have ``{name}`` in it, for what the table is of; where there is no
    key, the name is the key.
    """

    key: str
    label: str
    width: str = "14em"
    hint: str = ""
    kind: Kind = TEXT


def text_fields(
    table: Content, fields: Iterable[Field], then: Then, name: str = ""
) -> None:
    """Texts of a table, told while they are typed.

    Args:
        table: of a draft; a key that is empty is taken out.
        fields: which ones.
        then: called after every change.
        name: of what the table is of.
    """
    for field in fields:
        _text_field(table, field, then, name)


def _text_field(table: Content, field: Field, then: Then, name: str) -> None:
    key = field.key or name

    async def changed(e: events.ValueChangeEventArguments) -> None:
        text = (e.value or "").strip()
        if text:
            table[key] = field.kind.value(text)
        else:
            table.pop(key, None)
        await then()

    value = field.kind.text(table[key]) if key in table else ""
    made = ui.input(field.label.format(name=name), value=value, on_change=changed)
    made.props("dense outlined").props(DEBOUNCE).props["placeholder"] = field.hint
    made.style(f"width: {field.width}; max-width: 100%")
    made.classes("formula" if field.kind in FORMULAS else "")


def choice(
    label: str,
    options: Sequence[str] | Mapping[Any, str],
    value: Any,
    changed: Callable[[Any], Any],
    *,
    width: str = "12em",
) -> ui.select:
    """One of several."""
    listed: Any = dict(options) if isinstance(options, Mapping) else list(options)
    field = ui.select(
        listed, label=label, value=value, on_change=lambda e: changed(e.value)
    )
    field.props("dense outlined options-dense")
    return field.style(f"width: {width}; max-width: 100%")


def alert(text: str) -> None:
    """What went wrong, told to screen readers at once."""
    with ui.element("div").classes("alert").props('role="alert"'):
        ui.label(text)


def complaints(listed: Iterable[Complaint], fine: str) -> None:
    """What is to correct, or a word that nothing is."""
    found = list(listed)
    is_begun = any(one.value for one in found)
    look = "fine" if not found else "alert" if is_begun else "open"
    with ui.element("div").classes(look).props('role="status"'):
        begin = "To correct" if is_begun else "Still to give"
        said = ui.label(f"{begin}: {len(found)}" if found else fine)
        if found:
            said.style("font-weight: 600")
        for one in found:
            ui.label(complaint_words(one))


def button(label: str, then: Callable[[], Any], quiet: bool = False) -> ui.button:
    """A button: filled, or quiet beside one that is."""
    made = ui.button(label, on_click=then)
    return made.props("outline" if quiet else "text-color=onprimary")


@cache
def _texts() -> Any:
    templates = environment("phsi_opt.page", autoescape=True)
    return templates.get_template("study.html.jinja").module


def words(name: str, *facts: Any) -> str:
    """What a macro of ``study.html.jinja`` says; names in it mean nothing in HTML."""
    return str(getattr(_texts(), name)(*facts))


def said_by(name: str, *facts: Any) -> None:
    """Show the `words` of a macro."""
    ui.html(words(name, *facts), sanitize=False).classes("told w-full")


def plotted(chart: Chart, told: str, height: int) -> ui.element:
    """A chart; ``told`` to screen readers, ``height`` in pixels."""
    plot = ui.element("div").classes("live w-full").style(f"height: {height}px")
    plot.props["data-label"] = told
    plot.props["data-figure"] = json.dumps(figure(chart), allow_nan=False)
    return plot


def plotted_data(chart: Chart) -> None:
    """The measurements over time."""
    heading("What was measured")
    height = 90 + 120 * len(chart.panels)
    plotted(chart, "Chart: all channels over time", height)


# ---- complaints in the words of the fields -------------------------------------------

# Keys of a study file, as patterns, and what the page calls their fields.
FIELD_NAMES = (
    (r"data\.time.*", "Time column"),
    (r"data\.(states|inputs)\.([^.]+).*", r"Column of \2"),
    (r"data\.trajectory", "Column of runs"),
    (r"data.*", "Measurements"),
    (r"held_out.*", "Held out"),
    (r"model\.H.*", "Energy H"),
    (r"model\.R\.([^.\[]+).*", r"Loss R of \1"),
    (r"model\.F\.([^.\[]+).*", r"Force F on \1"),
    (r"model\.(states|inputs|pairs)", r"Field \1"),
    (r"model.*", "Model"),
    (r"parameters\.([^.]+)\.(.+)", r"Parameter \1, \2"),
    (r"parameters\.([^.]+)", r"Parameter \1"),
)
# Advice of the study file's reader that names its sections, and the page's own.
ADVICE = (
    (
        r"Define parameters in the section \[parameters\]: .*",
        "Correct the name, or make it a parameter below.",
    ),
    (
        r"the model has this name: give \{ column = \"\.\.\.\" \}"
        r".*?measured = false \}\.",
        "it is in the model: choose its column, or mark it as not measured.",
    ),
    (
        r"the model has this name: give \{ column = \"\.\.\.\" \}\.",
        "it is in the model: choose its column.",
    ),
    (
        r"a fixed parameter needs a value: .*",
        "enter the known value, such as 2.5.",
    ),
    (
        r"the names of the (states|inputs), such as \[\"(.+?)\", \"(.+?)\"\]\.",
        r"the names of the \1, such as \2, \3.",
    ),
)


def complaint_words(complaint: Complaint) -> str:
    """Where it is, what stands there, what to do."""
    said = complaint.said
    for pattern, words in ADVICE:
        said = re.sub(pattern, words, said)
    if not complaint.key:
        return said
    value = complaint.value
    is_field = bool(value) and not value.startswith("{")  # a section's text is no field
    written = f" ({value})" if is_field else ""
    return f"{_place_words(complaint.key)}{written}: {said}"


def _place_words(key: str) -> str:
    """What the page calls the field of a key."""
    for pattern, words in FIELD_NAMES:
        if re.fullmatch(pattern, key):
            return re.sub(f"^{pattern}$", words, key)
    return key
