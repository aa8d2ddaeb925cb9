"""Sphinx reads this: ``uv run --extra docs sphinx-build -n -W docs build/docs``; pages are MyST Markdown."""

from warpmag import __version__

project, author = "warpmag", "warpmag contributors"
copyright = "warpmag contributors, Apache-2.0"
version = release = __version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # formulas without a network
]
exclude_patterns = ["paper/*"]
html_theme = "furo"
html_title = f"warpmag {release}"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_use_ivar = True
napoleon_custom_sections = ["Warns"]
# Warp's, Newton's, NumPy's and USD's own pages are not asked for, and what is not public has none
nitpick_ignore_regex = [("py:.*", r"(?!warpmag\.[A-Za-z_]+$).*")]
