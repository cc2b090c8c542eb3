"""The paper in docs/joss as PDF: `make joss`. A draft to read; the journal sets its own. Needs the extra `joss`."""

import re
from pathlib import Path

import pypandoc
import typst

ROOT = Path(__file__).resolve().parent.parent
PAPER, PDF = ROOT / "docs" / "joss" / "paper.md", ROOT / "build" / "joss" / "paper.pdf"
LOOKS = """
#set table(stroke: none, inset: 3pt)
#show table: set text(size: 7.5pt)
#show table: set par(justify: false)
#show figure: set block(breakable: true)
#show link: set text(fill: rgb("#1f4e9c"))
"""


def main() -> None:
    """Markdown to Typst by pandoc, with the references set; Typst to PDF."""
    front = PAPER.read_text().split("\n---\n")[0]
    words = ["--standalone", "--citeproc", "--metadata=link-citations", f"--bibliography={PAPER.parent / 'paper.bib'}"]
    authors = re.findall(r"^  - name: (.+)\n    affiliation", front, re.MULTILINE)
    words += [f"--metadata=author={name}" for name in authors]
    words += ["--variable=papersize=a4", "--variable=fontsize=10pt"]
    text = pypandoc.convert_file(str(PAPER), "typst", format="markdown", extra_args=words)
    PDF.parent.mkdir(parents=True, exist_ok=True)
    source = PDF.with_suffix(".typ")
    source.write_text(LOOKS + text)
    typst.compile(str(source), output=str(PDF))
    print(PDF.relative_to(ROOT))


if __name__ == "__main__":
    main()
