"""What stands empty in a study file and may stay so: told, but no mistake.

What must be filled in is a complaint of `reading`.
"""

import re
from pathlib import Path

from phsi_opt.study_file.complaints import Complaints, TooManyComplaintsError
from phsi_opt.study_file.keys import usable
from phsi_opt.study_file.reading import tables_of
from phsi_opt.study_file.sections import DataSection
from phsi_opt.study_file.toml_text import toml_value


def unfilled(path: Path, has_dates: bool = False) -> tuple[str, ...]:
    """What stands empty, a sentence each, with an example.

    Args:
        path: of the study file.
        has_dates: whether the times are dates, which are read in seconds.

    Raises:
        StudyFileError: it cannot be read, or is no TOML.
    """
    try:
        tables = tables_of(path)
        file = usable(tables, Complaints(tables))
    except TooManyComplaintsError:
        return ()
    model = file.get("model", {})
    states = model.get("states", ())
    inputs = model.get("inputs", ())
    state = states[-1] if states else "p"
    has_formulas = bool(model.get("H") or model.get("F"))
    formulas = [model.get(name) for name in ("H", "R", "F", "sensor")]
    words = re.findall(r"\w+", str([*formulas, file.get("effects")]))
    idle = [name for name in inputs if name not in words]
    without = _without_unit(DataSection.of(file.get("data", {})), has_dates)
    pairs = toml_value([list(states[:2])])
    force = inputs[0] if inputs else "u"
    told = [
        (
            not file.get("parameters") and not model.get("H"),
            "parameters: none yet; every name in a formula that is no state, input or "
            'effort needs one, such as k = { start = 10.0, lower = 0, unit = "N/m" }',
        ),
        (
            not model.get("R") and model.get("type") != "FirstOrder",
            f'model.R: no losses, such as R = {{ {state} = "c" }}',
        ),
        (
            not model.get("F"),
            f'model.F: no forces, such as F = {{ {state} = "{force}" }}',
        ),
        (
            model.get("pairs") == () and len(states) > 1,
            "model.pairs: no state is driven by another's energy; a body has pairs = "
            f"{pairs}, position first",
        ),
        (
            idle and has_formulas,
            f"model.inputs: no formula has {', '.join(idle)}",
        ),
        (
            without,
            f'units: none is given for {", ".join(without)}, such as unit = "m"; sizes '
            "are told without it",
        ),
    ]
    return tuple(said for applies, said in told if applies)


def _without_unit(data: DataSection, has_dates: bool) -> list[str]:
    """Channels without a unit; these are printed beside numbers, no more."""
    channels = {**data.states, **data.inputs}
    without = [name for name, one in channels.items() if not one.unit]
    if data != DataSection() and not has_dates and not data.time.unit:
        without.insert(0, "the time")
    return without
