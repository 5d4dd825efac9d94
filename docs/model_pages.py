"""The page of base models, from the gallery of the package."""

from pathlib import Path

from phsi_opt.study_file.gallery import GALLERY
from phsi_opt.study_file.study_text import text_of

FOLDER = "models/"
HEAD = """\
# Base models to begin with

`phsi-opt init data.csv --model NAME` writes a study file with one of these models.
Columns of the table become its states and inputs by name, unit and order. The page
offers the same models. Values such as a mass are assumptions; replace them by those of
your machine.

"""
ENTRY = """\
## {title}

<div style="max-width: 300px">{picture}</div>

`{name}`: {about}

    {equation}

{names}

```toml
{text}```

"""


def write(docs: Path) -> None:
    """Write the page into the folder of the docs."""
    text = HEAD
    for one in GALLERY.values():
        model, parameters = one.sections(list(one.inputs))
        sections = text_of({"model": model, "parameters": parameters})
        facts = {**vars(one), "picture": one.picture, "names": one.names}
        text += ENTRY.format(**facts, text=sections)
    folder = docs / FOLDER
    folder.mkdir(exist_ok=True)
    (folder / "index.md").write_text(text, "utf-8")
