"""Tables: terms of the glossary appear in the index, and short cells are not broken into lines."""

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

SHORT = 20  #: characters


class TermsInIndex(SphinxTransform):
    """Puts a mark for the index before each term: the first cell of each row of the glossary's tables."""

    default_priority = 500  # before Sphinx collects the marks

    def apply(self) -> None:
        """Called by Sphinx for each page."""
        if self.env.docname != "reference/glossary":
            return
        for count, row in enumerate(self.document.findall(nodes.row)):
            if isinstance(row.parent, nodes.tbody):
                place = f"term-{count}"
                terms = row[0].astext().split(", ")
                mark = addnodes.index(entries=[("single", term, place, "", None) for term in terms])
                row[0].insert(0, [mark, nodes.target("", "", ids=[place])])


class ShortCells(SphinxTransform):
    """Gives cells such as "14 of 16" and "iiwa7-position" a class that keeps them on one line."""

    default_priority = 500

    def apply(self) -> None:
        """Called by Sphinx for each page."""
        for cell in self.document.findall(nodes.entry):
            if len(cell.astext()) <= SHORT and not isinstance(cell.parent.parent, nodes.thead):
                cell["classes"].append("short")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the transforms."""
    app.add_transform(TermsInIndex)
    app.add_transform(ShortCells)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
