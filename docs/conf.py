"""Sphinx configuration. Build with ``make docs``: no network, warnings are errors."""

import sys
from pathlib import Path

import reframe_jax

sys.path.insert(0, str(Path(__file__).parent))  # for mathml.py in this folder

project = "reframe_jax"
copyright = "the authors of reframe_jax, Apache-2.0"
version = release = reframe_jax.__version__

extensions = [
    "mathml",
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # types are in the signatures of the source; shapes and units in the text
autodoc_default_options = {"members": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"reframe_jax {version}"
html_static_path: list[str] = []
