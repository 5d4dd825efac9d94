"""Small parts that all views are made of."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from nicegui import ui
from nicegui.elements.mixins.text_element import TextElement

from phsi_opt.errors import Complaint
from phsi_opt.page.complaint_words import complaint_words

DEBOUNCE = "debounce=400"  # ms without a key before a text is checked
Changed = Callable[[str], Any]


def heading(text: str, level: int = 2) -> TextElement:
    """A heading that screen readers know."""
    return TextElement(tag=f"h{level}", text=text)


def card() -> ui.element:
    """A box with a border."""
    return ui.column().classes("card gap-3")


def text_field(
    label: str, value: str, changed: Changed, *, width: str = "12em", hint: str = ""
) -> ui.input:
    """A text, told while it is typed."""
    field = ui.input(label, value=value, on_change=lambda e: changed(e.value or ""))
    field.props("dense outlined").props(DEBOUNCE)
    field.style(f"width: {width}; max-width: 100%")
    if hint:
        field.props["placeholder"] = hint
    return field


def choice(
    label: str,
    options: Sequence[str] | dict[Any, str],
    value: Any,
    changed: Callable[[Any], Any],
    *,
    width: str = "12em",
) -> ui.select:
    """One of several."""
    listed: Any = options if isinstance(options, dict) else list(options)
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
    if not found:
        with ui.element("div").classes("fine").props('role="status"'):
            ui.label(fine)
        return
    is_begun = any(one.value for one in found)
    with ui.element("div").classes("alert" if is_begun else "open") as box:
        box.props('role="status"')
        begin = "To correct" if is_begun else "Still to give"
        ui.label(f"{begin}: {len(found)}").style("font-weight: 600")
        for one in found:
            ui.label(complaint_words(one))


def button(label: str, then: Callable[[], Any], quiet: bool = False) -> ui.button:
    """A button: filled, or quiet beside one that is."""
    made = ui.button(label, on_click=then)
    return made.props("outline" if quiet else "text-color=onprimary")
