"""How Sphinx builds the documentation: `make docs`."""

import sys
from pathlib import Path

from orthocas.version import VERSION

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "orthocas"
author = "the orthocas authors"
copyright = f"2026, {author}"  # noqa: A001 (Sphinx wants this name)
release = version = VERSION

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "plain_formulas",
    "native_math",
    "sphinx_copybutton",
    "command_line",
    "tables",
]
exclude_patterns = ["_ext", "joss"]  # the paper is no page
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

nb_execution_mode = "force"  # results always belong to this version
nb_execution_timeout = 240
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
python_maximum_signature_line_length = 88

copybutton_prompt_text = r"\$ |>>> |\.\.\. "
copybutton_prompt_is_regexp = True

html_theme = "furo"
html_title = f"orthocas {release}"
html_static_path = ["_static"]
html_favicon = "_static/favicon.svg"
html_css_files = ["site.css"]
html_search_scorer = str(Path(__file__).parent / "_static" / "search.js")
html_math_renderer = "mathml"
html_copy_source = False
html_show_sourcelink = False
