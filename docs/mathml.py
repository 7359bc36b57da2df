"""Formulas as MathML, which browsers draw themselves: the site needs neither scripts nor a network."""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

_log = logging.getLogger(__name__)


def formula(text: str, block: bool) -> str:
    """MathML of a formula in TeX.

    Raises:
        MathError: for what docutils does not know, and for what it reads otherwise than TeX does.
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
    """Register the renderer; ``html_math_renderer = "mathml"`` chooses it."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
