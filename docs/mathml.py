"""Convert formulas to MathML, which browsers draw without scripts and without a network."""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

_log = logging.getLogger(__name__)


def formula(text: str, block: bool) -> str:
    """Convert a TeX formula to MathML.

    Raises:
        MathError: for TeX that docutils does not support, or reads differently from TeX.
    """
    if re.search(r"frac\s*\d|[_^]\d\d", text):
        raise MathError("put the arguments of fractions and numbers of two digits into braces")
    return str(tex2mathml(text, as_block=block))


def _formula(node: Any, block: bool) -> str:
    try:
        return formula(node.astext(), block)
    except MathError as error:  # a warning, which is an error in `make docs`
        _log.warning("no MathML for %r: %s", node.astext(), error, location=node)
        return ""


def _inline(writer: Any, node: Any) -> None:
    writer.body.append(_formula(node, block=False))
    raise nodes.SkipNode


def _block(writer: Any, node: Any) -> None:
    writer.body.append(writer.starttag(node, "div", CLASS="math") + _formula(node, block=True) + "</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer; ``html_math_renderer = "mathml"`` selects this renderer."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
