"""Fits and models in JSON files: every record is a mapping of its fields.

Formulas stay text. Reading one goes through the whitelist of `expressions`, when the
model checks its terms; nothing of a file is ever run as code.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from phsi_opt.data.checks import Hold
from phsi_opt.errors import DataError, PhsiOptError
from phsi_opt.later import Later
from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
from phsi_opt.model.parameters import Scan, Share, Tried
from phsi_opt.model.slots import BY_EQUATION
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.presentation.units import Scale, Unit
from phsi_opt.reading import file_text, why_not_read

Result = TypeVar("Result")
Content = dict[str, Any]

NOT_IN_FILES = {"in_file": False}  # says a field that no file has
KINDS: dict[str, type[Model]] = {
    "PseudoHamiltonian": PseudoHamiltonian,
    "FirstOrder": FirstOrder,
}
GUESSES: dict[str, type[Scan | Share | Tried]] = {
    "Scan": Scan,
    "Share": Share,
    "Tried": Tried,
}
MODEL_PARTS: Mapping[str, Any] = {
    **dict.fromkeys(("states", "inputs", "memory", "S"), Any),
    **{"H": Dictionary, **dict.fromkeys(BY_EQUATION, Mapping[str, Dictionary])},
}
# What a damaged content can raise while an object is made of it.
DAMAGE = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
    MemoryError,
    RecursionError,
)


def encoded(value: Any) -> Any:
    """What JSON holds of a value: mappings of fields, lists, numbers and text."""
    if isinstance(value, Later):
        return encoded(value.value)
    if isinstance(value, Model):
        return model_content(value)
    if isinstance(value, Dictionary):
        return encoded(value.terms)
    if isinstance(value, Scan | Share | Tried):
        return [type(value).__name__, *vars(value).values()]
    if is_dataclass(value):
        return {name: encoded(getattr(value, name)) for name in _kept_fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(name): encoded(one) for name, one in value.items()}
    if isinstance(value, tuple | list):
        return list(map(encoded, value))
    if isinstance(value, Unit):
        return {"computed": str(value), **vars(value.scale)}
    return value


def digest_of(*values: Any) -> str:
    """SHA-256 of all that the values say, as hex digits."""
    text = json.dumps(encoded(values), default=repr)
    return hashlib.sha256(text.encode()).hexdigest()


def decoded(kind: Any, value: Any) -> Any:
    """A value of a type, from its content; a whole number passes for a float.

    Raises:
        LookupError, TypeError, ValueError, AttributeError: The content is damaged.
    """
    origin = get_origin(kind)
    args = get_args(kind)
    if kind in (Any, Hold) or (value is None and type(None) in args):
        return value
    if type(None) in args:
        return decoded(args[0], value)
    if kind is Scan:  # or another guess
        name, *settings = value
        return GUESSES[name](*settings)
    if origin is Later:
        return Later.known(decoded(args[0], value))
    if kind is Model:
        return model_from(value)
    if kind is Dictionary:
        return Dictionary(decoded(tuple[Term, ...], value))
    if kind is np.ndarray:
        array = np.array(value)
        if array.dtype.kind not in "if":
            raise TypeError(f"an array of {array.dtype}, not of numbers")
        return array
    if origin in (Mapping, dict):
        return {decoded(args[0], k): decoded(args[1], v) for k, v in value.items()}
    if origin is tuple and isinstance(value, list):
        return tuple(decoded(args[0], one) for one in value)
    if isinstance(kind, type) and is_dataclass(kind):
        every = get_type_hints(kind)
        hints = {name: every[name] for name in _kept_fields(kind)}
        check_keys(value, hints)
        return kind(**{name: decoded(hints[name], v) for name, v in value.items()})
    if kind is str and isinstance(value, Mapping):
        return Unit(
            value["computed"], Scale(value["unit"], value["size"], value["zero"])
        )
    if kind is float and type(value) is int:
        return float(value)
    if issubclass(kind, StrEnum):
        return kind(value)
    if type(value) is not kind:
        raise TypeError(f"{value!r} is not of type {kind.__name__}")
    return value


def _kept_fields(record: Any) -> list[str]:
    """Names of the fields of a record that a file has."""
    return [one.name for one in fields(record) if one.metadata.get("in_file", True)]


def check_keys(content: Mapping[str, Any], known: Iterable[str]) -> None:
    """Refuse a content that lacks a name, or has another one.

    Raises:
        LookupError: it is damaged.
    """
    for name in sorted(set(known) ^ content.keys()):
        what = "unknown" if name in content else "missing"
        raise LookupError(f"{name!r} is {what}")


def model_content(model: Model) -> Content:
    """The content of a model."""
    content = {"kind": type(model).__name__, "kinds": dict(model.kind)}
    for name in MODEL_PARTS:
        content[name] = encoded(getattr(model, name))
    return content


def model_from(content: Content) -> Model:
    """The model of a content that `model_content` made.

    Raises:
        ModelError: A formula is not one, or the model contradicts itself.
        LookupError, TypeError, ValueError, AttributeError: The content is damaged.
    """
    parts = {"kind": content["kinds"]}
    for name, kind in MODEL_PARTS.items():
        parts[name] = decoded(kind, content[name])
    return KINDS[content["kind"]](**parts)


def read_json(
    path: str | Path,
    expected: str,
    what: str,
    from_content: Callable[[Content], Result],
) -> Result:
    """Read a JSON file of the ``format`` expected and make an object of its content.

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
        raise DataError(f"{path} contains a model that is not valid: {error}") from None
    except DAMAGE as error:
        raise DataError(
            f"{path} is damaged: {type(error).__name__} {error}. "
            "Write it again with save."
        ) from None


def _content(path: str | Path, what: str) -> Any:
    try:
        return json.loads(file_text(path))
    except OSError as error:
        reason = why_not_read(error)
    except RecursionError:
        reason = "its lists or mappings are nested too deeply"
    except (TypeError, ValueError) as error:
        reason = str(error)
    raise DataError(
        f"{path} cannot be read as {what}: {reason}. Write one with save(path)."
    )
