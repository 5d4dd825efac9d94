"""Small parts that all views are made of."""

from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from typing import Any

from nicegui import events, ui
from nicegui.elements.mixins.text_element import TextElement

from phsi_opt.errors import Complaint
from phsi_opt.page.complaint_words import complaint_words

DEBOUNCE = "debounce=400"  # ms without a key before a text is checked
Then = Callable[[], Awaitable[None]]


def heading(text: str, level: int = 2) -> TextElement:
    """A heading that screen readers know."""
    return TextElement(tag=f"h{level}", text=text)


def strong(text: str) -> ui.label:
    """What is to be understood at once."""
    return ui.label(text).style("font-weight: 600; line-height: 1.35")


def card() -> ui.element:
    """A box with a border."""
    return ui.column().classes("card gap-3")


def text_field(
    owner: Any,
    name: str,
    label: str,
    then: Then,
    *,
    width: str = "12em",
    hint: str = "",
    is_formula: bool = False,
) -> ui.input:
    """A text of a draft, told while it is typed.

    Args:
        owner: a record or a dictionary; ``name``: of the text in it.
        label: of the field.
        then: called after every change.
        width: of the field; ``hint``: what an empty one shows.
        is_formula: whether it is written in letters of one width.
    """
    is_table = isinstance(owner, dict)
    value = owner.get(name, "") if is_table else getattr(owner, name)

    async def changed(e: events.ValueChangeEventArguments) -> None:
        text = (e.value or "").strip()
        if is_table:
            owner[name] = text
        else:
            setattr(owner, name, text)
        await then()

    field = ui.input(label, value=value, on_change=changed)
    field.props("dense outlined").props(DEBOUNCE).props["placeholder"] = hint
    return field.style(f"width: {width}; max-width: 100%").classes(
        "formula" if is_formula else ""
    )


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
