"""Complaints about a study file in the words of the page's fields."""

import re

from phsi_opt.errors import Complaint

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
        r"A parameter stands in the section \[parameters\]: .*",
        "Correct the name, or make it a parameter below.",
    ),
    (
        r"the model has it: give \{ column = \"\.\.\.\" \}.*?measured = false \}\.",
        "the model has it: choose a column for it, or that it is not measured.",
    ),
    (
        r"the model has it: give \{ column = \"\.\.\.\" \}\.",
        "the model has it: choose a column for it.",
    ),
    (
        r"a fixed parameter needs a value: .*",
        "a value that is known needs its number, such as 2.5.",
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
    return f"{place_words(complaint.key)}{written}: {said}"


def place_words(key: str) -> str:
    """What the page calls the field of a key."""
    for pattern, words in FIELD_NAMES:
        if re.fullmatch(pattern, key):
            return re.sub(f"^{pattern}$", words, key)
    return key
