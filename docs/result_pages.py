"""The pages of measured machines, from results/ into the site.

They stay where the scripts write them; the site has copies, made when it is built, with
links to the pictures in results/.
"""

from pathlib import Path

FOLDER = "measured/"
PAGES = (
    "measured_stories",
    "silverbox",
    "emps_story",
    "ball_and_hoop",
    "quarter_drone",
    "cascaded_tanks",
)
INDEX = """\
# Pages of measured machines

Written by the scripts under `problems/measured`.

```{toctree}
:maxdepth: 1

"""


def write(docs: Path) -> None:
    """Write the pages, and an index of them, into the folder of the docs."""
    folder = docs / FOLDER
    folder.mkdir(exist_ok=True)
    index = INDEX
    for name in PAGES:
        text = (docs.parent / "results" / f"{name}.md").read_text("utf-8")
        _write_if_changed(folder / f"{name}.md", _for_site(text))
        index += f"{name}\n"
    _write_if_changed(folder / "index.md", f"{index}```\n")


def _for_site(text: str) -> str:
    """A page with paths to its pictures from the copy's folder."""
    return text.replace("](measured/", "](../../results/measured/")


def _write_if_changed(path: Path, text: str) -> None:
    """An untouched file is not read by Sphinx again."""
    if not path.exists() or path.read_text("utf-8") != text:
        path.write_text(text, "utf-8")
