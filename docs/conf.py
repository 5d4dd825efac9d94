"""How Sphinx makes the site: `make docs` writes it into docs/_build/html.

The pages of the rooms are written by ``room_pages`` from the packages' files, so that
no module is forgotten, those of measured machines by ``result_pages`` from results/,
that of the base models by ``model_pages``. A public name is documented once, on its
user's page; links to it and to the module that defines it lead there. Nothing is read
from the network.
"""

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.domains.python import PyObject, PythonDomain
from sphinx.environment import BuildEnvironment

import phsi_opt

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS))

import model_pages  # noqa: E402
import result_pages  # noqa: E402  (found only with docs/ on the path)
import room_pages  # noqa: E402

project = "phsi_opt"
author = "the phsi_opt authors"
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "myst_parser",
]
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = "phsi_opt"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_copyright = False
myst_heading_anchors = 3

add_module_names = False
default_role = "py:obj"  # `name` is a link where there is such an object, else literal
python_maximum_signature_line_length = 100  # longer ones: one argument a line
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = False
napoleon_use_ivar = True  # attributes are a list in their class's text,
napoleon_attr_annotations = False  # their types are in its signature
napoleon_use_rtype = False

# Types of other packages have no page here, and nothing is read from the network.
nitpick_ignore_regex = [
    (
        "py:.*",
        r"(ca|casadi|markupsafe|matplotlib|np|numpy|pandas|pd|scipy|sp|starlette|sympy|torch)(\..*)?",
    ),
    (
        "py:.*",
        r"(abc|ast|collections|concurrent|datetime|decimal|enum|functools|os|pathlib|types|typing)(\..*)?",
    ),
    (
        "py:.*",
        r"(jinja2|multiprocessing|nicegui|ui|events)(\..*)?|Environment|Template|Tensor|Optimizer",
    ),
    (
        "py:class",
        r"(.*\.)?(Annotated|Content)",
    ),  # an option of the command line; a type variable
    (
        "py:class",
        r"Arguments|Axes|Dtype|Figure|RenderableType|(dict|tuple)\[str",
    ),  # imported for types alone; cut up
    (
        "py:class",
        r"phsi_opt\..*\.(_\w+|AnyModel|AnyMeasurements|Call|E|T|Result)",
    ),  # private; type variables
    ("py:class", r"P"),  # the arguments of what `interruptible` wraps, a ParamSpec
]

SOURCE_PAGES = "_modules/"  # where sphinx.ext.viewcode puts them
NAVIGATION: dict[tuple[Any, ...], str] = {}  # by depth of the page and options
BEFORE_THE_THEME = 100  # in the order of events; a theme has 500
PUBLIC = {id(getattr(phsi_opt, name)): name for name in phsi_opt.__all__}


def public_name(value: object) -> str | None:
    """The name under which a user imports an object; None for all others."""
    return PUBLIC.get(id(value))


def skip_public_names(
    app: Sphinx, what: str, name: str, value: object, skip: bool, options: Any
) -> bool | None:
    """Leave public names out of the pages of the rooms: users' pages have them."""
    on_room_page = app.env.docname.startswith(room_pages.FOLDER)
    if what == "module" and on_room_page and public_name(value):
        return True
    return None


def name_public_names(
    app: Sphinx,
    what: str,
    name: str,
    value: object,
    options: Any,
    lines: list[str],
) -> None:
    """Link a module to the public names that it defines."""
    if not isinstance(value, ModuleType):
        return
    links = []
    for member in vars(value).values():
        public = public_name(member)
        if public and getattr(member, "__module__", None) == name:
            links.append(f"`phsi_opt.{public}`")
    if links:
        lines.extend(["", f"Public: {', '.join(links)}."])


def hide_representations(
    app: Sphinx,
    what: str,
    name: str,
    value: object,
    options: Any,
    signature: str | None,
    returned: str | None,
) -> tuple[str | None, str | None]:
    """Write defaults such as <factory> and <function f> as ``...``, to be set well."""
    if signature is not None:
        signature = re.sub(r"<\w[^<>]*>", "...", signature)
    return signature, returned


def resolve_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, text: nodes.TextElement
) -> nodes.Node | None:
    """Find the object that a name alone, or the place of its definition, stands for.

    `Fit` and ``phsi_opt.estimation.fit.Fit`` are ``phsi_opt.Fit``; a class that no
    user imports is found by its name where only one has it. Single backticks around
    what is no object become literal text.
    """
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"]
    name = target.rsplit(".", 1)[-1]
    domain = env.domains.python_domain
    full = None
    if name in phsi_opt.__all__ and (target == name or _stands_at(target, name)):
        full = f"phsi_opt.{name}"
    elif target == name and name[:1].isupper():
        full = _only_class(domain, name)
    if full is not None:
        page = node["refdoc"]
        return domain.resolve_xref(env, page, app.builder, "obj", full, node, text)
    is_full = target.startswith("phsi_opt.")  # meant as a link, so that it must be one
    return text if node["reftype"] == "obj" and not is_full else None


def _stands_at(target: str, name: str) -> bool:
    """Whether a public object is found at a place, where it is defined or passed on."""
    module = sys.modules.get(target.rpartition(".")[0])
    return getattr(module, name, None) is getattr(phsi_opt, name)


def _only_class(domain: PythonDomain, name: str) -> str | None:
    found = []
    for full, entry in domain.objects.items():
        is_class = entry.objtype == "class" and not entry.aliased
        if is_class and full.endswith(f".{name}"):
            found.append(full)
    return found[0] if len(found) == 1 else None


def share_navigation(
    app: Sphinx,
    page: str,
    template: str,
    context: dict[str, Any],
    doctree: nodes.document | None,
) -> None:
    """Make the tree of links once for all pages of source code that are equally deep.

    None of them stands in the tree, so that theirs differ by the way up alone; made for
    each of some 400 pages the trees took half of the time of the site.
    """
    if not page.startswith(SOURCE_PAGES):
        return
    made = context["toctree"]

    def shared(**options: Any) -> str:
        key = (page.count("/"), *sorted(options.items()))
        if key not in NAVIGATION:
            NAVIGATION[key] = made(**options)
        return NAVIGATION[key]

    context["toctree"] = shared


def setup(app: Sphinx) -> None:
    """Connect the functions above with Sphinx."""
    room_pages.write(DOCS)
    result_pages.write(DOCS)
    model_pages.write(DOCS)
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
    app.connect("autodoc-skip-member", skip_public_names)
    app.connect("autodoc-process-docstring", name_public_names)
    app.connect("autodoc-process-signature", hide_representations)
    app.connect("missing-reference", resolve_name)
    app.connect("html-page-context", share_navigation, priority=BEFORE_THE_THEME)
