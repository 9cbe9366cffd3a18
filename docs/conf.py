"""How the documentation is built: the pages beside this file, and the reference from the docstrings.

`make docs` turns warnings into errors. What is built asks nothing of any other machine, and that is checked
at the end.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.domains.python import PyXRefRole
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

import siq

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs" / "extensions"))

project = "siq"
author = "The siq developers"
copyright = author
language = "en"
release = version = siq.__version__

extensions = [
    "mathml",  # docs/extensions
    "mechanism_pages",  # docs/extensions
    "myst_nb",
    "schemas",  # docs/extensions
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build", "make", "**/.ipynb_checkpoints"]
nb_execution_mode = "off"  # `make docs` shows the outputs that `make docs-full` has made
myst_heading_anchors = 3
myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist", "dollarmath", "substitution"]
# Figures that pages quote, as `{{ figures.archetype3d.certified }}`; `docs/make/figures.py` writes the file.
myst_substitutions = {
    "figures": {
        study: {name: one["value"] for name, one in group.items()}
        for study, group in json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8")).items()
    }
}
html_math_renderer = "mathml"

autodoc_default_options = {"members": True, "member-order": "bysource", "show-inheritance": True}
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autosummary_generate = False  # the reference is there already; summaries point into it
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = [
    ("Main attributes", "Attributes"),
    ("Other attributes", "Attributes"),
    ("Main arguments", "Parameters"),
    ("Other arguments", "Other Parameters"),
]
napoleon_use_rtype = False
default_role = "name"  # what stands between single backquotes: see `Name`
suppress_warnings = ["ref.python"]  # of two classes of one name, a link may lead to either
maximum_signature_line_length = 90

html_theme = "furo"
html_title = f"siq {release}"
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["pages.css"]
html_js_files = ["pages.js"]
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
html_show_sphinx = False

_ELSEWHERE = re.compile(
    r"<(?:script|img|iframe)[^>]*\ssrc=[\"'](?:https?:)?//[^\"']*"
    r"|<link(?![^>]*rel=[\"']canonical)[^>]*\shref=[\"'](?:https?:)?//[^\"']*"
    r"|(?:url\(|@import )\s*[\"']?(?:https?:)?//[^\"')]*"
)


class Name(PyXRefRole):
    """A module, class or function of `siq` as a link; a parameter, which has no page, as code."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """Decide by the look of the name."""
        if not re.match(r"siq\.|[A-Z]\w*[a-z]", self.text):
            return [nodes.literal(self.rawtext, self.text)], []
        self.name = "py:obj"
        return super().run()


def write_reference(app: Sphinx, config: Config) -> None:
    """Write a page for each package, with a section for each of its modules."""
    folder = Path(app.srcdir) / "api"
    folder.mkdir(exist_ok=True)
    packages = sorted(file.parent for file in (ROOT / "siq").rglob("__init__.py"))
    pages = {name: [name] for name in ("siq.errors", "siq.remarks", "siq.sklearn")}
    for package in packages:
        name = ".".join(package.relative_to(ROOT).parts)
        modules = [f"{name}.{file.stem}" for file in sorted(package.glob("[!_]*.py"))]
        pages[name] = [name, *modules]
    del pages["siq"]  # its names are shown where they are defined
    for page, modules in pages.items():
        text = "".join(
            f"{module}\n{('=' if module == page else '-') * len(module)}\n\n.. automodule:: {module}\n\n"
            for module in modules
        )
        write_if_changed(folder / f"{page}.rst", text)
    for file in folder.glob("*.rst"):
        if file.stem not in pages:
            file.unlink()


def write_if_changed(file: Path, text: str) -> None:
    """Leave a file alone whose text is the same: Sphinx reads again what is newer."""
    if not file.is_file() or file.read_text(encoding="utf-8") != text:
        file.write_text(text, encoding="utf-8")


def what_is_not_offline(app: Sphinx, failure: Exception | None) -> None:
    """Warn of every script, style, font or image that a page would fetch from another machine."""
    log = logging.getLogger(__name__)
    for file in sorted(Path(app.outdir).rglob("*")) if failure is None else ():
        if file.suffix in (".html", ".css"):
            for found in _ELSEWHERE.findall(file.read_text(encoding="utf-8")):
                log.warning("%s asks another machine: %s", file.relative_to(app.outdir), found)


def classes_without_members(app: Sphinx, domain: str, kind: str, content: nodes.Element) -> None:
    """Keep the members of classes out of the contents, which every page carries whole."""
    if kind in ("attribute", "method", "property"):
        for signature in content.parent.findall(addnodes.desc_signature):
            signature["_toc_name"] = ""


class PublicNames(SphinxDirective):
    """A table of the names that `siq` itself offers, with the first sentence of each."""

    def run(self) -> list[nodes.Node]:
        """Summarise each name where it is defined."""
        names = [f"~{siq._MODULES[name]}.{name}" for name in siq.__all__]
        text = "\n".join(["```{eval-rst}", ".. autosummary::", "", *(f"   {name}" for name in names), "```"])
        return self.parse_text_to_nodes(text)


def equations(app: Sphinx, kind: str, name: str, of: object, options: object, lines: list[str]) -> None:
    """Keep an equation as it was typed: a block that is indented, after an empty line, is no quotation."""
    typed = [""] * 2 + lines
    lines.clear()
    for before, empty, line in zip(typed, typed[1:], typed[2:], strict=False):
        deeper = len(line) - len(line.lstrip()) > len(before) - len(before.lstrip())
        if line.strip() and not empty.strip() and before.strip() and deeper:
            lines += [before[: len(before) - len(before.lstrip())] + "::", ""]
        lines.append(line)


def setup(app: Sphinx) -> None:
    """Write the reference before anything is read, and look at the pages when they are written."""
    app.add_role("name", Name())
    app.add_directive("public-names", PublicNames)
    app.connect("config-inited", write_reference)
    app.connect("autodoc-process-docstring", equations, priority=400)  # before the sections are read
    app.connect("object-description-transform", classes_without_members)
    app.connect("build-finished", what_is_not_offline)
