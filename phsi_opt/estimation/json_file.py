"""Reading a JSON file of a known format, with the errors a user can act on.

What the content means is the business of those who wrote it; nothing of a file is ever
run as code.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from phsi_opt.errors import DataError, PhsiOptError
from phsi_opt.reading import file_text, why_not_read

Result = TypeVar("Result")

# What a damaged content can raise while an object is made of it.
DAMAGE = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
    RecursionError,
)


def made_of(kind: type[Result], content: dict[str, Any]) -> Result:
    """A data class of its fields by name, each converted to its type.

    Raises:
        LookupError, TypeError, ValueError: The content is damaged.
    """
    fields = {}
    for name, type_ in get_type_hints(kind).items():
        fields[name] = _converted(type_, content[name])
    return kind(**fields)


def _converted(kind: Any, value: Any) -> Any:
    """A value of a field's type; whole numbers pass for others, nothing else does.

    Raises:
        TypeError: It is of another type.
    """
    if get_origin(kind) is tuple:
        item, *_ = get_args(kind)
        if not isinstance(value, list):
            raise TypeError(f"{value!r} is no list")
        return tuple(_converted(item, one) for one in value)
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    if kind is float and is_whole:
        return float(value)
    if not isinstance(value, kind) or (kind is int and not is_whole):
        raise TypeError(f"{value!r} is not of type {kind.__name__}")
    return value


def read_json(
    path: str | Path,
    expected: str,
    what: str,
    from_content: Callable[[dict[str, Any]], Result],
) -> Result:
    """Read a JSON file and make an object of its content.

    Args:
        path: Of the file.
        expected: Value that ``format`` must have in the file.
        what: What the file should hold, for messages: "a fit".
        from_content: Makes the object.

    Raises:
        DataError: The file cannot be read, is of another format, or is damaged.
    """
    content = _content(path, what)
    if not isinstance(content, dict) or content.get("format") != expected:
        raise DataError(
            f"{path} is not a file of the format {expected!r}; "
            "write one with save(path)."
        )
    try:
        return from_content(content)
    except PhsiOptError as error:
        raise DataError(f"{path} holds a model that is not valid: {error}") from None
    except DAMAGE as error:
        raise DataError(
            f"{path} is damaged: {type(error).__name__} {error}. "
            "Write it again with save."
        ) from None


def _content(path: str | Path, what: str) -> Any:
    try:
        return json.loads(file_text(path))
    except OSError as error:
        said = why_not_read(error)
    except RecursionError:
        said = "its lists or mappings lie too deep in each other"
    except (TypeError, ValueError) as error:
        said = str(error)
    raise DataError(f"{path} cannot be read as {what}: {said}.")
