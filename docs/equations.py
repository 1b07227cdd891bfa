"""Equations as MathML, made when the site is built: browsers show it, screen readers read it, nothing is fetched."""

import re

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

FUNCTIONS = re.compile(r"<mi>(cos|sin|tan|ln|log|exp|arg|det)</mi>")  # set with space around, as a function's name is


def setup(app: Sphinx) -> None:
    """Make this the renderer of equations."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))


def _mathml(equation: str, display: str) -> str:
    return FUNCTIONS.sub(
        r'<mo form="prefix" lspace="0.17em" rspace="0.17em">\1</mo>', convert(equation, display=display)
    )


def _inline(page: HTML5Translator, node: nodes.math) -> None:
    page.body.append(_mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def _block(page: HTML5Translator, node: nodes.math_block) -> None:
    page.body.append(f'<div class="math">{_mathml(node.astext(), "block")}</div>')
    raise nodes.SkipNode
