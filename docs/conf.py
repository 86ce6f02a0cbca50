"""How Sphinx makes the site (`make docs`): of the repository itself, so that links between its files hold there too."""

import sys
from importlib import metadata
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.domains.python import PyFunction

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from docs.pages import write_all  # noqa: E402  # found from the root alone

write_all(ROOT / "docs" / "generated")

project = "etsplat"
author = "The etsplat authors"
project_copyright = author
release = version = metadata.version("etsplat")

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_parser", "sphinx_copybutton"]
root_doc = "docs/index"
include_patterns = ["docs/**.md", "docs/**.rst", "research/*.md", "studies/README.md", "*.md"]
exclude_patterns = ["README.md", "build", "dist", ".*", "runs", "out", "**/.*"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

# MyST checks links to headings, by the anchors that GitHub has; `Name` in a docstring leads to that name.
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence", "dollarmath", "fieldlist"]
default_role = "py:obj"
smartquotes = False  # of --options they would make dashes

# Docstrings are Google's. Shapes stand in the annotations, so signatures keep them, one parameter a line.
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False  # the signature of the class has them
napoleon_use_rtype = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
maximum_signature_line_length = 88
python_use_unqualified_type_names = True
python_display_short_literal_types = True
add_module_names = False
toc_object_entries_show_parents = "hide"

copybutton_prompt_text = r">>> |\.\.\. "  # and what is printed is not copied
copybutton_prompt_is_regexp = True

html_theme = "furo"
html_title = f"etsplat {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}
pygments_style = "friendly"
pygments_dark_style = "github-dark"


def setup(app: Sphinx) -> None:
    """What Sphinx has no settings for."""
    for field in PyFunction.doc_field_types:  # one list for all kinds of names
        field.label = {"variable": "Attributes"}.get(field.name, field.label)

    def skip(app: Sphinx, what: str, name: str, member: object, skip: bool, options: object) -> bool | None:
        """Fields of named tuples: the class says what they are."""
        return True if (getattr(member, "__doc__", None) or "").startswith("Alias for field number") else None

    def lead_on(app: Sphinx, error: Exception | None) -> None:
        """The front page lies in docs/, so the site's root leads there."""
        if error is None and app.builder.name == "html":
            page = '<!doctype html><meta charset="utf-8"><title>etsplat</title>'
            page += '<meta http-equiv="refresh" content="0; url=docs/index.html"><a href="docs/index.html">etsplat</a>'
            (Path(app.outdir) / "index.html").write_text(page + "\n", encoding="utf-8")

    def dashes(app: Sphinx, doctree: nodes.document) -> None:
        """Between a parameter and what it is."""
        for text in list(doctree.findall(nodes.Text)):
            if text == " -- ":
                text.parent.replace(text, nodes.Text(" – "))

    app.connect("autodoc-skip-member", skip)
    app.connect("doctree-read", dashes)
    app.connect("build-finished", lead_on)
