"""Formulas as MathML, which browsers draw themselves: no script, no font, no TeX, no network."""

from docutils.nodes import SkipNode, math, math_block
from docutils.utils.math import MathError, latex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

_LOGGER = logging.getLogger(__name__)


def _mathml(source: str, node: math | math_block, *, block: bool) -> str:
    try:
        return str(latex2mathml.tex2mathml(source, as_block=block))
    except MathError as error:
        _LOGGER.warning("formula %r: %s", source, error, location=node)
        return ""


def _visit_inline(translator: HTML5Translator, node: math) -> None:
    translator.body.append(_mathml(node.astext(), node, block=False))
    raise SkipNode  # of what is between, the formula has told


def _visit_block(translator: HTML5Translator, node: math_block) -> None:
    translator.body.append(f'<div class="formula">{_mathml(node.astext(), node, block=True)}</div>')
    raise SkipNode


def _depart(_translator: HTML5Translator, _node: math | math_block) -> None:
    """Close nothing; the visit wrote all."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the renderer `mathml`."""
    app.add_html_math_renderer("mathml", (_visit_inline, _depart), (_visit_block, _depart))
    return {"parallel_read_safe": True}
