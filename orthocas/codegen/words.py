"""Names and titles as text that is safe in C comments and CMake templates."""

import re
from collections.abc import Iterable


def words(names: Iterable[str]) -> list[str]:
    """Names on one printable line each, safe in C comments (also with trigraphs) and in CMake templates."""
    return [re.sub(r"[@\\]+|/(?=\*)|\*(?=/)|\?(?=\?)", " ", _printable(name)) for name in names]


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() else " " for letter in text)
