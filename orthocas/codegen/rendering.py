"""Generated files from the templates in `templates/`, with numbers and names as they stand in C."""

import re
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, pass_context
from jinja2.runtime import Context

_INFINITIES = {np.inf: "INFINITY", -np.inf: "-INFINITY"}


def render(template: str, values: Mapping[str, Any]) -> str:
    """The text of `templates/TEMPLATE.jinja`. A name that the values lack is an error."""
    return _environment().get_template(f"{template}.jinja").render(values)


@cache
def _environment() -> Environment:
    """Blocks vanish with their lines; `x | numbers` are literals of C, and `x | array` an initialiser."""
    environment = Environment(
        loader=PackageLoader("orthocas.codegen", "templates"),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,
    )
    environment.filters |= {"numbers": write_numbers, "array": lambda values: f"{{{write_numbers(values)}}}"}
    environment.filters["code"] = _translate
    return environment


@pass_context
def _translate(context: Context, text: str) -> str:
    """Python for NumPy as that of the template's library."""
    return str(context["library"].code(text))


def write_numbers(values: Iterable[Any]) -> str:
    """C literals, with commas between, that convert back to exactly the same numbers; 0 and 1 for truth values."""
    return ", ".join(map(write_number, np.ravel(np.asarray(values)).tolist()))


def write_number(value: float) -> str:
    """A C literal; whole numbers stay whole."""
    return str(int(value)) if isinstance(value, int) else _INFINITIES.get(value, repr(float(value)))


def clean_words(names: Iterable[str]) -> list[str]:
    """Names on one printable line each, safe in C comments (also with trigraphs) and in CMake templates."""
    printable = ("".join(letter if letter.isprintable() else " " for letter in name) for name in names)
    return [re.sub(r"[@\\]+|/(?=\*)|\*(?=/)|\?(?=\?)", " ", name) for name in printable]


def clean_word(name: str) -> str:
    """One such name."""
    return clean_words([name])[0]
