"""Formulas that are written as plain text, J_x A^-1 J_xi^T = 0, get indices and powers on the pages.

Docstrings are plain text for `help` and editors; on pages they also get Greek letters, and links to pages and names.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from numpy.typing import ArrayLike
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.ext.napoleon import Config, GoogleDocstring
from sphinx.transforms import SphinxTransform
from sphinx.util.typing import stringify_annotation

from orthocas.tools.checks import Array

NAMES = ["alpha", "beta", "delta", "epsilon", "theta", "lambda", "xi", "rho", "sigma", "tau", "phi", "psi", "pi"]
GREEK = dict(zip(NAMES, "αβδεθλξρστφψπ", strict=True))
LETTER = "|".join(GREEK)

CODE = re.compile(r"(`[^`]+`)")
DIRECTIVE = re.compile(r"^\.\. auto(?:class|function|module):: (orthocas(?:\.\w+)+)$", flags=re.MULTILINE)
DESCRIBED = [
    name
    for page in (Path(__file__).parents[1] / "reference").glob("*.md")
    for name in DIRECTIVE.findall(page.read_text())
]
PLACES = {  # of names in the reference; classes also go by their last word, `Report`
    **{name.split(".")[-1]: name for name in DESCRIBED if name.split(".")[-1][0].isupper()},
    **{name.removeprefix("orthocas."): name for name in DESCRIBED},
    **{name: name for name in DESCRIBED},
}
LINKED = re.compile(rf"`(?:oc\.)?({'|'.join(sorted(map(re.escape, PLACES), reverse=True))})((?:\.\w+)*)(?:\(.*\))?`")
POWER = re.compile(r"\^(-?\d+|-?T|#A?|\*|\{[^}\s]+\})")
INDEX = re.compile(rf"(?<!\w)(d?(?:[A-Za-z]|{LETTER})|grad)_({LETTER}|[A-Za-z0-9]{{1,3}}|\{{[^}}\s]+\}})(?!\w)")
WORD = re.compile(rf"(?<![\w`])(d?)({LETTER})(\d?)(?!\w|=|\.\w)")
RAISED = re.compile(  # on pages: xi_j, |v|_A, M_φ^-1
    rf"(?P<base>(?<![A-Za-z0-9_])[dD]?(?:[^\W\d_][\u0300-\u036f]?|∇|∂|{LETTER}|leak)|[|)²])"
    rf"_(?P<low>\{{[^}}\s]+\}}|(?<=[|²]_)[AM]⁻¹|(?:{LETTER}|[A-Za-z0-9ξφω]{{1,3}})(?:,[A-Za-z0-9])?)(?![A-Za-z0-9_])"
    r"|\^(?P<high>-?[\d.]*\d|-?½|-?[A-Za-z]|#A?|\([^()\s]*\)|\{[^}\s]+\})(?:(?<=½)|(?![A-Za-z0-9]))"
)
CODES = (
    nodes.literal,
    nodes.FixedTextElement,
    nodes.math,
    nodes.raw,
    addnodes.desc_signature,
    addnodes.literal_strong,
    addnodes.literal_emphasis,
)
PAGE = re.compile(r"docs/([\w/-]+)\.md(?:#[\w-]+)?")
CITED = re.compile(r"\[([A-Z]{1,5}\d{4})\]")
TYPES = {stringify_annotation(kind, "smart"): name for kind, name in ((ArrayLike, "ArrayLike"), (Array, "Array"))}
SECTIONS = Config(napoleon_use_rtype=False, napoleon_custom_sections=["Source"])
ITEM = re.compile(r"(    \*{0,2}\w+(?:, \w+)*: )(.*)")  # a line `name: text` below Args keeps its name


def markup(text: str) -> str:
    """A line of prose as reStructuredText; public names in backticks become links, other code stays code."""
    return "".join(_code(part) if part.startswith("`") else _prose(part) for part in CODE.split(text))


def _code(text: str) -> str:
    name = LINKED.fullmatch(text)
    return f":py:obj:`{text.strip('`')} <{PLACES[name[1]]}{name[2]}>`" if name else f"`{text}`"


def _prose(text: str) -> str:
    text = re.sub(r"([\\*|])", r"\\\1", text)
    text = POWER.sub(lambda found: rf"\ :sup:`{_plain(found[1])}`\ ", text.replace(r"^\*", "^*"))
    text = INDEX.sub(lambda found: rf"{_plain(found[1])}\ :sub:`{_plain(found[2])}`\ ", text)
    text = WORD.sub(lambda found: f"{found[1]}{GREEK[found[2]]}{found[3]}", text)
    text = PAGE.sub(r":doc:`/\1`", text)
    text = CITED.sub(r":doc:`[\1] </reference/references>`", text)
    return re.sub(r"(?<=\w)_(?!\w)", r"\\_", text)  # name_ would be a link


def _plain(text: str) -> str:
    """A symbol with Greek letters, without the braces around long indices."""
    return re.sub(rf"(?<![A-Za-z])(d?)({LETTER})", lambda found: found[1] + GREEK[found[2]], text.strip("{}")).replace(
        "grad", "∇"
    )


def converted(lines: list[str]) -> Iterator[str]:
    """The lines of a docstring in Google's style; headings and examples are left alone."""
    section = ""
    for line in lines:
        heading = re.fullmatch(r"[A-Z][a-z]+:", line)
        if heading or (line and not line[0].isspace()):
            section = line if heading else ""
        item = ITEM.fullmatch(line) if section else None
        if heading or section == "Example:":
            yield line
        else:
            yield item[1] + markup(item[2]) if item else markup(line)


def rewrite(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Called by autodoc for each docstring."""
    kind = "method" if what in {"property", "attribute"} else what  # there, napoleon takes `q (n,): text` for a type
    lines[:] = GoogleDocstring(list(converted(lines)), SECTIONS, app, kind, name, thing, options).lines()


def shortened(app: Sphinx, what: str, name: str, thing: Any, options: Any, words: str, result: str) -> tuple[str, str]:
    """Called by autodoc for each signature: NumPy's unions get back their names."""
    for long, short in TYPES.items():
        words, result = (part and part.replace(long, short) for part in (words, result))
    return words, result


class Raised(SphinxTransform):
    """Sets the indices and powers in the text of a page."""

    default_priority = 500

    def apply(self) -> None:
        """Called by Sphinx for each page."""
        for text in list(self.document.findall(nodes.Text)):
            if RAISED.search(text) and not any(isinstance(node, CODES) for node in ancestors(text)):
                text.parent.replace(text, list(raised(text)))


def ancestors(node: nodes.Node) -> Iterator[nodes.Node]:
    """What a node lies in."""
    while node.parent is not None:
        node = node.parent
        yield node


def raised(text: str) -> Iterator[nodes.Node]:
    """A text in pieces: "dξ_j" is "dξ" and an index."""
    end = 0
    for found in RAISED.finditer(text):
        yield nodes.Text(text[end : found.start()] + _plain(found["base"] or ""))
        part, kind = (found["low"], nodes.subscript) if found["low"] else (found["high"], nodes.superscript)
        yield kind("", _plain(part))
        end = found.end()
    yield nodes.Text(text[end:])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with autodoc and Sphinx."""
    app.add_transform(Raised)
    app.connect("autodoc-process-docstring", rewrite)
    app.connect("autodoc-process-signature", shortened)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
