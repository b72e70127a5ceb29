"""Formulas as MathML, which browsers draw themselves: no script, no font, no network."""

import html
import re

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
"""What pymdownx.arithmatex makes of $…$ and $$…$$ (generic: true)."""


def on_page_content(content, page, **_):
    """Each formula of a page, LaTeX, as MathML."""
    return FORMULA.sub(lambda found: mathml(found[2], found[1] == "div", page.file.src_uri), content)


def mathml(latex: str, block: bool, where: str) -> str:
    """``latex`` as a MathML element. Raises PluginError if a command in it is not known."""
    made = convert(html.unescape(latex).strip(), display="block" if block else "inline")
    unknown = re.search(r"\\[a-zA-Z]+", made)
    if unknown:
        raise PluginError(f"{where}: the formula {latex.strip()} has {unknown[0]}, which latex2mathml does not know")
    return made
