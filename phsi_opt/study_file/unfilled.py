"""What stands empty in a study file and may stay so: told, but no mistake.

What must be filled in is a complaint of `reading`.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from phsi_opt.study_file.complaints import Complaints, TooManyComplaintsError, texts
from phsi_opt.study_file.keys import usable
from phsi_opt.study_file.reading import tables_of
from phsi_opt.study_file.toml_text import toml_value

WITH_FORMULAS = ("H", "R", "F", "sensor")


def unfilled(path: Path, has_dates: bool = False) -> tuple[str, ...]:
    """What stands empty, a sentence each, with an example.

    Args:
        path: of the study file.
        has_dates: whether the times are dates, which are read in seconds.

    Raises:
        StudyFileError: it cannot be read, or is no TOML.
    """
    try:
        content = usable(tables_of(path), Complaints())
    except TooManyComplaintsError:
        return ()
    model = content.get("model", {})
    states = texts(model.get("states", ()))
    inputs = texts(model.get("inputs", ()))
    state = states[-1] if states else "p"
    said = []
    if not content.get("parameters") and not model.get("H"):
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
        said.append(
            "model.pairs: no state is driven by another's energy; a body has pairs = "
            f"{toml_value([states[:2]])}, position first"
        )
    formulas = [model.get(name) for name in WITH_FORMULAS]
    words = re.findall(r"\w+", str([*formulas, content.get("effects", [])]))
    idle = [name for name in inputs if name not in words]
    if idle and (model.get("H") or model.get("F")):
        said.append(f"model.inputs: no formula has {', '.join(idle)}")
    without = _without_unit(content.get("data", {}), has_dates)
    if without:
        said.append(
            f'units: none is given for {", ".join(without)}, such as unit = "m"; sizes '
            "are told without it"
        )
    return tuple(said)


def _without_unit(data: Mapping[str, Any], has_dates: bool) -> list[str]:
    """Channels without a unit; these are printed beside numbers, no more."""
    without = []
    if data and not has_dates and not data.get("time", {}).get("unit"):
        without.append("the time")
    for what in ("states", "inputs"):
        channels = data.get(what, {})
        without += [name for name, one in channels.items() if not one.get("unit")]
    return without
