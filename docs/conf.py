"""How the site is built: `make docs`. It opens from disk and loads nothing from the network."""

import sys
from importlib.metadata import version as _version_of
from pathlib import Path

_HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(_HERE.parent), str(_HERE / "_ext")]

project = "nir_render"
author = "the nir_render contributors"
version = release = _version_of("nir-render")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "docstrings",
    "mathml",
    "offline",
    "references",
]
exclude_patterns = ["_build", "_ext"]

# Markdown: formulas between dollars, headings that can be linked to.
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
html_math_renderer = "mathml"

# Docstrings are NumPy's kind; a word between single backticks is code.
default_role = "code"
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_attr_annotations = False
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
smartquotes = False
python_maximum_signature_line_length = 88
python_display_short_literal_types = True
add_module_names = False
toc_object_entries_show_parents = "hide"

# Of names in signatures, those of other libraries lead nowhere: their pages are on the network.
nitpicky = True
nitpick_ignore_regex = [(r"py:.*", r"(?!(nir_render|perception)\.[a-z_.]+$).*")]

html_theme = "furo"
html_title = "nir_render"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#9a3412", "color-brand-content": "#9a3412"},
    "dark_css_variables": {"color-brand-primary": "#fdba74", "color-brand-content": "#fdba74"},
}
