"""Settings of Sphinx for the documentation; docs/site/__main__.py gathers the pages and calls it."""

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

project = "Space camera twin"
author = "the space-camera-twin authors"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
include_patterns = ["index.md", "README.md", "docs/**", "reference/**"]
html_theme = "furo"
html_title = "Space camera twin"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True, "top_of_page_buttons": []}

# headings are anchors, as they are where the pages are read on a forge
myst_heading_anchors = 4
myst_enable_extensions = ["attrs_block"]
# files beside the pages, as programs and examples, are offered for download
suppress_warnings = ["mystnb.unknown_mime_type"]

nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_ivar = True
add_module_names = False
maximum_signature_line_length = 80
toc_object_entries = False


def setup(app: Sphinx) -> None:
    """Register CSV as text without highlighting."""
    app.add_lexer("csv", TextLexer)
