"""A report as one HTML file: nothing is loaded, everything of the data is escaped.

The chart library is in the file once, compressed; the browser unpacks it. Until it has,
on paper, and where no script runs, static pictures stand in place of the charts.
"""

import base64
import gzip
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from phsi_opt.presentation.numbers import capitalised, number, said, typeset
from phsi_opt.presentation.report_content import Force, Report
from phsi_opt.presentation.report_pictures import (
    follows_picture,
    force_picture,
    glance_picture,
    map_picture,
    runs_picture,
    staircase_picture,
)

TEMPLATES = "templates"
# Characters that could end a script, or begin a comment in one, and their escapes.
ESCAPES = {
    "<": "\\u003c",
    ">": "\\u003e",
    "&": "\\u0026",
    "\u2028": "\\u2028",
    "\u2029": "\\u2029",
}


@dataclass(frozen=True)
class ForcePictures:
    """The static pictures of one force, as addresses that hold them."""

    over_time: str
    map: str
    follows: str


def html_report(report: Report) -> str:
    """The whole report as the text of an HTML file."""
    environment = Environment(
        loader=PackageLoader("phsi_opt.presentation", TEMPLATES),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters["number"] = number
    environment.filters["typeset"] = typeset
    environment.filters["said"] = said
    environment.filters["capital"] = capitalised
    template = environment.get_template("report.html.jinja")
    pictures = []
    for failure in report.failures:
        pictures.append([_pictures_of(force) for force in failure.forces])
    return template.render(
        report=report,
        staircase_picture=as_address(staircase_picture(report.staircase)),
        glance_picture=_glance_picture(report),
        runs_picture=as_address(runs_picture(report.runs)),
        law_pictures=[
            as_address(follows_picture(law.follows, law.label)) for law in report.laws
        ],
        force_pictures=pictures,
        style=_own_file("report.css"),
        script=_own_file("report.js"),
        data=script_json(_chart_data(report)),
        library=Markup(_packed_library()),
    )


def _glance_picture(report: Report) -> str:
    """The picture beside the verdict; "" for none."""
    if report.glance is None:
        return ""
    return as_address(glance_picture(report.glance, report.runs))


def _pictures_of(force: Force) -> ForcePictures:
    over_states = "" if force.map is None else map_picture(force.map, force.label)
    follows = ""
    if force.follows is not None:
        follows = follows_picture(force.follows, force.label)
    return ForcePictures(
        as_address(force_picture(force)),
        as_address(over_states),
        as_address(follows),
    )


def as_address(svg: str) -> str:
    """A picture as an address that holds it; "" for no picture."""
    if not svg:
        return ""
    packed = base64.b64encode(svg.encode()).decode()
    return f"data:image/svg+xml;base64,{packed}"


def script_json(content: Mapping[str, Any]) -> Markup:
    """Content as JSON that may stand in a script element, whatever its texts hold."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    for character, escape in ESCAPES.items():
        text = text.replace(character, escape)
    return Markup(text)


def _chart_data(report: Report) -> dict[str, Any]:
    """What the charts show."""
    forces = []
    for failure in report.failures:
        forces.append([asdict(force) for force in failure.forces])
    return {
        "staircase": asdict(report.staircase),
        "glance": None if report.glance is None else asdict(report.glance),
        "runs": asdict(report.runs),
        "laws": [asdict(law) for law in report.laws],
        "forces": forces,
    }


def _own_file(name: str) -> Markup:
    """A file of the package, which needs no escape."""
    path = files("phsi_opt.presentation") / TEMPLATES / name
    return Markup(path.read_text(encoding="utf-8"))


@cache
def _packed_library() -> str:
    """The chart library, compressed, in base64."""
    from plotly.offline import get_plotlyjs

    packed = gzip.compress(get_plotlyjs().encode(), 9, mtime=0)
    return base64.b64encode(packed).decode()
