"""The documentation site: Sphinx with MyST over docs/, the reports in results/, the changelog and how to contribute (`make docs-site`).

The root of the repository is the source folder, so that links between docs/ and results/ are the same on the site and in a checkout.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

ROOT = Path(__file__).resolve().parents[1]

project = "vehest"
author = "the authors of vehest"
copyright = "the authors of vehest, MIT licence"
release = re.findall(
    r'__version__ = "([^"]+)"', (ROOT / "src" / "vehest" / "version.py").read_text(encoding="utf-8")
)[0]

extensions = ["myst_parser", "sphinx_copybutton", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = [
    "docs/*.md",
    "docs/estimators/*.md",
    "docs/sources/*.md",
    "results/*.md",
    "results/*/*.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
]
exclude_patterns = [
    ".*",
    "build",
    "outputs",
    "src",
    "tests",
    "conf",
    "pipelines",
    "benchmarks",
    "docs/examples",
]

myst_heading_anchors = 5
myst_enable_extensions = ["colon_fence"]
myst_fence_as_directive = ["math"]
html_math_renderer = "mathml"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]  # types and errors of the interface that no page describes
highlight_language = "text"
smartquotes_action = "q"  # the dashes of options stay
copybutton_prompt_text = r"\$ "
copybutton_prompt_is_regexp = True

html_theme = "furo"
html_title = f"vehest {release}"
html_copy_source = False
html_show_sourcelink = False
html_extra_path = ["site"]
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_theme_options = {
    "light_css_variables": {
        "color-brand-primary": "#0b4f9c",
        "color-brand-content": "#0b4f9c",
        "color-brand-visited": "#0b4f9c",
    },
    "dark_css_variables": {
        "color-brand-primary": "#8cc4f5",
        "color-brand-content": "#8cc4f5",
        "color-brand-visited": "#8cc4f5",
    },
    "navigation_with_keys": True,
}


def _inline_mathml(translator: Any, node: nodes.Element) -> None:
    translator.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _displayed_mathml(translator: Any, node: nodes.Element) -> None:
    translator.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Render equations as MathML while the site is built, so that a page needs neither script nor network for them."""
    app.add_html_math_renderer("mathml", (_inline_mathml, None), (_displayed_mathml, None))
