"""Facts about an object by name, as lines of text and as an HTML table."""

import html
import math
import textwrap
from collections.abc import Iterable, Mapping
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from typing import TYPE_CHECKING, Any

from orthocas.tools.guesses import GUESSES, explain_missing

_WIDTH = 100  # characters per line
_LINES = 9  # at most, including the heading


class Shown:
    """An object that displays its facts when printed, and in notebooks. The first fact is the heading.

    Dataclasses that derive from it need `repr=False`.
    """

    def facts(self) -> dict[str, str]:
        """Facts about the object by name, the most important first."""
        raise NotImplementedError

    @property
    def heading(self) -> str:
        """One line that describes the object."""
        return next(iter(self.facts().values()))

    if not TYPE_CHECKING:  # type checkers would take every name for known

        def __getattr__(self, name: str) -> Any:
            """Say what to use where a name is one that people try first."""
            owners = [kind.__name__ for kind in type(self).__mro__ if name in GUESSES.get(kind.__name__, ())]
            raise AttributeError(explain_missing((owners or [type(self).__name__])[0], name), name=name, obj=self)

    def __repr__(self) -> str:
        return as_text(type(self).__name__, self.facts())

    def _repr_html_(self) -> str:
        return as_html(type(self).__name__, self.facts())


def as_text(title: str, facts: Mapping[str, str]) -> str:
    """Title and heading in the first line, then one fact per line: at most 9 lines of 100 characters."""
    (_, heading), *others = facts.items()
    width = max((len(name) for name, _ in others), default=0) + 2
    lines = [f"{title}: {heading}", *(f"  {name:<{width}}{value}" for name, value in others[: _LINES - 1])]
    # Without control characters, and cut to the width between two words, where there are any.
    for k, line in enumerate(lines):
        indent = line[: len(line) - len(line.lstrip())]
        words = "".join(letter if letter.isprintable() else " " for letter in line.strip())
        if len(words) > _WIDTH:
            words = f"{textwrap.shorten(words, _WIDTH - 4, placeholder='') or words[: _WIDTH - 4]} ..."
        lines[k] = indent + words
    return "\n".join(lines)


def as_html(title: str, facts: Mapping[str, str]) -> str:
    """A table with a caption. Names and values are escaped, so they are shown as text."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
        f"<td style='text-align:left'>{html.escape(value)}</td></tr>"
        for name, value in facts.items()
    )
    return f"<table><caption>{html.escape(title)}</caption>{rows}</table>"


def percent(share: float, digits: int = 1, *, fault: bool = False) -> str:
    """A share in percent, rounded down: 0.99999 is '99.9%', and only 1 is '100.0%'.

    Shares of faults, such as folded samples, are rounded up, so that neither reads better than it is. NaN is 'unknown'.

    Args:
        share: a number, 1 for all.
        digits: after the decimal point.
        fault: whether a smaller share would be better.
    """
    if math.isnan(share):
        return "unknown"
    step = Decimal(1).scaleb(-digits)
    return f"{(100 * Decimal(repr(float(share)))).quantize(step, ROUND_CEILING if fault else ROUND_FLOOR)}%"


def listed(words: Iterable[str], most: int = 10) -> str:
    """Join words with commas, and say how many more there are."""
    known = list(words)
    more = f", and {len(known) - most} more" if len(known) > most else ""
    return ", ".join(known[:most]) + more


def number_list(values: Iterable[float]) -> str:
    """Join numbers of four digits like `listed`. Equal numbers are shown once."""
    known = [f"{value:.4g}" for value in values]
    return known[0] if len(set(known)) == 1 else listed(known)
