"""What stands empty in a study file and may stay so: told, but no mistake.

What must be filled in is a complaint of `reading`.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from phsi_opt.study_file.reading import tables_of
from phsi_opt.study_file.toml_text import toml_value

NAMES_IN_MODEL = ("states", "inputs", "pairs", "kind", "memory", "type")


def unfilled(path: Path, has_dates: bool = False) -> tuple[str, ...]:
    """What stands empty, a sentence each, with an example.

    Args:
        path: of the study file.
        has_dates: whether the times are dates, which are read in seconds.

    Raises:
        StudyFileError: it cannot be read, or is no TOML.
    """
    content = tables_of(path)
    model = _table(content, "model")
    states = _texts(model, "states")
    inputs = _texts(model, "inputs")
    state = states[-1] if states else "p"
    said = []
    if not content.get("parameters") and model.get("H", "") in ("", []):
        said.append(
            "parameters: none yet; every name in a formula that is no state, input or "
            'effort needs one, such as k = { start = 10.0, lower = 0, unit = "N/m" }'
        )
    if not model.get("R") and model.get("type") != "FirstOrder":
        said.append(f'model.R: no losses, such as R = {{ {state} = "c" }}')
    if not model.get("F"):
        force = inputs[0] if inputs else "u"
        said.append(f'model.F: no forces, such as F = {{ {state} = "{force}" }}')
    if model.get("pairs") == [] and len(states) > 1:
        pair = toml_value([states[:2]])
        said.append(
            "model.pairs: no state is driven by another's energy; a body has pairs = "
            f"{pair}, position first"
        )
    said += _idle_inputs(content, inputs)
    return (*said, *_without_unit(content, has_dates))


def _table(content: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """A table; empty where there is none."""
    found = content.get(name)
    return found if isinstance(found, Mapping) else {}


def _texts(content: Mapping[str, Any], name: str) -> list[str]:
    """A list of texts; empty where it is none."""
    found = content.get(name)
    return list(filter(_is_text, found)) if isinstance(found, list) else []


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _idle_inputs(content: Mapping[str, Any], inputs: list[str]) -> list[str]:
    """Inputs that stand in no formula, where there are formulas already."""
    formulas = dict(_table(content, "model"))
    if not formulas.get("H") and not formulas.get("F"):
        return []
    for name in NAMES_IN_MODEL:
        formulas.pop(name, None)
    text = str([*formulas.values(), content.get("effects", [])])
    idle = [name for name in inputs if not re.search(rf"\b{re.escape(name)}\b", text)]
    if not idle:
        return []
    return [f"model.inputs: no formula has {', '.join(idle)}"]


def _without_unit(content: Mapping[str, Any], has_dates: bool) -> list[str]:
    """Channels without a unit; these are printed beside numbers, no more."""
    data = _table(content, "data")
    without = []
    if not has_dates and not _table(data, "time").get("unit"):
        without.append("the time")
    for what in ("states", "inputs"):
        channels = _table(data, what)
        without += [name for name in channels if not _table(channels, name).get("unit")]
    if not data or not without:
        return []
    return [
        f'units: none is given for {", ".join(without)}, such as unit = "m"; sizes are '
        "told without it"
    ]
