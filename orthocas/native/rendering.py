"""Text from templates, with numbers as they stand in C."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jinja2 import Environment
    from jinja2.runtime import Context

_INFINITIES = {np.inf: "INFINITY", -np.inf: "-INFINITY"}


def render(template: str, values: Mapping[str, Any], package: str = __package__) -> str:
    """The text of `templates/TEMPLATE.jinja` of a package. A name that the values lack is an error."""
    return _environment(package).get_template(f"{template}.jinja").render(values)


def get_source(name: str, package: str = __package__) -> str:
    """A C file of a package's `runtime/` as it is."""
    return (files(package) / "runtime" / name).read_text()


@cache
def _environment(package: str) -> Environment:
    """Blocks vanish with their lines; `x | numbers` are literals of C, `x | array` and `x | strings` initialisers."""
    from jinja2 import Environment, PackageLoader, StrictUndefined, pass_context  # charts load without it

    # Missing names are errors, and generated text is not HTML.
    environment = Environment(
        loader=PackageLoader(package, "templates"),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,
    )
    environment.filters |= {"numbers": write_numbers, "array": lambda values: f"{{{write_numbers(values)}}}"}
    environment.filters["strings"] = lambda words: f"{{{', '.join(map(_quote, words))}}}"

    # Python for NumPy as that of the template's library.
    def translate(context: Context, text: str) -> str:
        return str(context["library"].translate(text))

    environment.filters["code"] = pass_context(translate)
    return environment


def _quote(word: str) -> str:
    """A string of C; a quote in it would end it."""
    return '"' + word.replace('"', "'") + '"'


def write_numbers(values: Iterable[Any]) -> str:
    """C literals, with commas between, that convert back to exactly the same numbers; 0 and 1 for truth values."""
    return ", ".join(map(write_number, np.ravel(np.asarray(values)).tolist()))


def write_number(value: float) -> str:
    """A C literal; whole numbers stay whole."""
    return str(int(value)) if isinstance(value, int) else _INFINITIES.get(value, repr(float(value)))
