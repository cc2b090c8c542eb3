"""Terms of the glossary appear in the index: the first cell of each row of its tables."""

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx


def index_terms(app: Sphinx, doctree: nodes.document) -> None:
    """Put a mark for the index before each term."""
    if app.env.docname != "glossary":
        return
    for row in doctree.findall(nodes.row):
        if isinstance(row.parent, nodes.tbody):
            name, first = row[0].astext(), f"term-{app.env.new_serialno('term')}"
            target = nodes.target("", "", ids=[first])
            marks = addnodes.index(entries=[("single", term, first, "", None) for term in name.split(", ")])
            row[0].insert(0, [marks, target])


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect to the reading of pages."""
    app.connect("doctree-read", index_terms)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
