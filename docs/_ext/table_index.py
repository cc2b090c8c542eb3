"""Terms of the glossary appear in the index: the first cell of each row of its tables."""

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform


class TermsInIndex(SphinxTransform):
    """Puts a mark for the index before each term."""

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


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the transform."""
    app.add_transform(TermsInIndex)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
