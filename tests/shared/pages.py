"""Blocks of code of the pages."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language: str, page: str = "") -> list[str]:
    """The blocks of code of a page of docs, or of README."""
    text = (ROOT / "docs" / page).read_text() if page else README
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)
