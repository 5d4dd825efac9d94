"""Small parts that all views are made of."""

import json
import re
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from typing import Any

from nicegui import ui
from nicegui.elements.mixins.text_element import TextElement

from phsi_opt.errors import Complaint, concise
from phsi_opt.page.drafts import NAMES, PAIRS, REAL, SPAN, TERMS, TEXT, WHOLE, Content
from phsi_opt.presentation.charts import Chart, figure
from phsi_opt.presentation.numbers import capitalised, unbroken
from phsi_opt.presentation.sentences import environment
from phsi_opt.study_file.keys import KEYS, KEYS_OF, Key

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


# What fields of keys are called, where not by the key alone.
LABELS = {
    "data": "measurements",
    "data.trajectory": "column of runs",
    "data.time": "time column",
    "data.time.column": "time column",
    "data.time.step": "time between lines",
    "data.time.date_format": "format of the dates",
    "data.between": "first and last time to use",
    "data.detrended": "channels to take a trend out of",
    "data.resampled": "time between new samples",
    "data.thinned": "number of samples to average",
    "data.states.*": "column of {name}",
    "data.inputs.*": "column of {name}",
    "data.states.*.clock": "times of {name}",
    "data.inputs.*.clock": "times of {name}",
    "data.inputs.*.hold": "{name} between samples",
    "held_out": "held-out data",
    "held_out.runs": "runs held out",
    "held_out.share": "share held out",
    "held_out.after": "held out from the time",
    "final": "data for a final test",
    "final.runs": "runs for the final test",
    "final.share": "share for the final test",
    "final.after": "final test from the time",
    "study.title": "title of the report, such as the machine",
    "model.pairs": "pairs: dq/dt = dH/dp",
    "model.H": "energy H",
    "model.R.*": "loss R of {name}",
    "model.F.*": "force F on {name}",
    "parameters.*": "parameter {name}",
    "parameters.*.value": "known value of {name}",
    "parameters.*.lower": "lower bound of {name}",
    "parameters.*.upper": "upper bound of {name}",
}
OPTION_LABELS = {"zero": "constant until the next", "cubic": "smooth"}
# How the text of a field is written in a study file, by the form of its key.
KIND_OF = {
    "number": REAL,
    "positive number": REAL,
    "number from 0 to 1": REAL,
    "whole number": WHOLE,
    "list of texts": NAMES,
    "list of two numbers": SPAN,
    "list of pairs": PAIRS,
    "formula, term, or list of these": TERMS,
}
NO_KEY = Key("", "text", "")  # of a name, which a study file has as a key


def label_of(path: str, name: str = "") -> str:
    """What the field of a key is called."""
    key = path.rpartition(".")[2]
    found = LABELS.get(path, f"{key} of {{name}}")
    return (found if name else found.replace(" of {name}", "")).format(name=name)


def fields(
    table: Content, section: str, keys: str, then: Then, name: str = ""
) -> dict[str, ui.element]:
    """Fields of the keys of a section, told while they are typed; "*" is the name."""
    made = {}
    for key in keys.split():
        entry = KEYS_OF[section].get(key, NO_KEY)
        label = label_of(f"{section}.{key}", name)
        made[key] = _field(table, name if key == "*" else key, entry, label, then)
    return made


def _field(table: Content, key: str, entry: Key, label: str, then: Then) -> ui.element:
    kind = KIND_OF.get(entry.form, TEXT)

    async def changed(text: str | None) -> None:
        if text and text.strip():
            table[key] = kind.value(text.strip())
        else:
            table.pop(key, None)
        await then()

    if entry.options:
        options = {one: OPTION_LABELS.get(one, one) for one in entry.options}
        now = table.get(key) or entry.options[0]
        return choice(label, options, now, changed)
    value = kind.text(table[key]) if key in table else ""
    made = ui.input(label, value=value, on_change=lambda e: changed(e.value))
    made.props("dense outlined").props(DEBOUNCE)
    made.props["placeholder"] = entry.meaning.rpartition("default: ")[2]
    width = "100%" if key == "H" else f"{max(8, 2 + 0.6 * len(label)):.0f}em"
    place = "flex: 1 1 15em" if kind is TERMS else f"width: {width}"
    made.style(f"{place}; max-width: 100%")
    return made.classes("formula" if kind in FORMULAS else "")


def choice(
    label: str,
    options: Sequence[str] | Mapping[Any, str],
    value: Any,
    changed: Callable[[Any], Any],
) -> ui.select:
    """One of several; as wide as the longest, which wraps where there is no room."""
    listed: Any = dict(options) if isinstance(options, Mapping) else list(options)
    named = listed.values() if isinstance(listed, dict) else listed
    width = max(10, 4 + 0.45 * len(label), 4 + 0.6 * max(map(len, named)))
    field = ui.select(
        listed, label=label, value=value, on_change=lambda e: changed(e.value)
    )
    field.props("dense outlined options-dense")
    return field.style(f"width: {width:.0f}em; max-width: min(100%, 24em)")


def alert(text: str) -> None:
    """What went wrong, told to screen readers at once."""
    with ui.element("div").classes("alert").props('role="alert"'):
        ui.label(concise(text))


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


def words(name: str, *facts: Any) -> str:
    """What a macro of ``study.html.jinja`` says; names in it mean nothing in HTML."""
    found = environment("phsi_opt.page", autoescape=True, finalize=unbroken)
    return str(getattr(found.get_template("study.html.jinja").module, name)(*facts))


def said_by(name: str, *facts: Any) -> None:
    """Show the `words` of a macro."""
    ui.html(words(name, *facts), sanitize=False).classes("told w-full")


def plotted(chart: Chart, told: str, height: int) -> ui.element:
    """A chart; ``told`` to screen readers, ``height`` in pixels."""
    plot = ui.element("div").classes("live w-full").style(f"height: {height}px")
    plot.props["data-label"] = told
    plot.props["data-figure"] = json.dumps(figure(chart), allow_nan=False)
    return plot


def plotted_data(chart: Chart) -> ui.element:
    """The measurements over time."""
    heading("What was measured")
    height = 90 + 120 * len(chart.panels)
    return plotted(chart, "Chart: all channels over time", height)


# ---- complaints in the words of the fields -------------------------------------------

# Advice of the study file's reader that names its sections, and the page's own.
ADVICE = (
    (
        r"Define parameters in the section \[parameters\]: .*",
        "Correct the name, or make it a parameter below.",
    ),
    (
        r"the model has this name: give \{ column = .*?\}\.",
        "it is in the model: give its name to a column in part 1.",
    ),
    (r"set date_format = ", "give the format of the dates, such as "),
    (r"a fixed parameter needs a value: .*", "enter the known value, such as 2.5."),
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
    return concise(f"{_place_words(complaint.key)}{written}: {said}")


def _place_words(key: str) -> str:
    for entry in reversed(KEYS):  # parts stand behind what they are a part of
        pattern = re.escape(entry.path).replace(r"\*", r"([^.\[]+)")
        found = re.fullmatch(f"{pattern}(\\[.*|\\..*)?", key)
        if found is not None:
            name = found[1] if "*" in entry.path else ""
            return capitalised(label_of(entry.path, name or ""))
    return key
