"""Hostile words and numbers, shared by the campaigns."""

from collections.abc import Sequence
from typing import Any

import numpy as np

Rng = np.random.Generator

NAMES = (
    *(
        "",
        " ",
        "universe",
        "root_joint",
        "world",
        "j1",
        "l1",
        "int",
        "double",
        "main",
        "qpos0",
        "x" * 5000,
        "a/b/../../c",
    ),
    *(
        "*/ int main(){} /*",
        "// \\",
        "??/",
        'quote"s',
        "it's",
        "<&>",
        "$name",
        "${name}",
        "%s%n",
        "@VAR@",
        "{0}",
        "a=b",
    ),
    *("\u202egnp.exe", "\u2066x\u2069", "\u200b", "é", "関節", "\U0001f980", "a\tb", "a\nb", "a\x85b", "\ufeff", "-j1"),
)  #: for joints, links, bodies, frames, files
NUMBERS = (
    *(
        "nan",
        "inf",
        "-inf",
        "1e999",
        "-1e999",
        "1e300",
        "-1e300",
        "1e-320",
        "1e19",
        "1e8",
        "0",
        "-0",
        "-1",
        "0x10",
        "1,5",
    ),
    *("", " ", "one", "1 2", "1e", "+", ".", "1_000", "\u0661", "\uff19", "1d5", "true", "None", "9" * 400),
)  #: where one number stands
VECTORS = (
    *("", "0", "1 2", "0 0 0", "0 0 0 0", "nan 0 0", "0 inf 1", "1e200 1e200 1e200", "1e-200 0 0", "1 2 3 4 5 6 7"),
    *("x y z", "1,2,3", "1;2;3", "1 2 3 ", "\t1\t2\t3", "1e19 0 0", "-1 -1 -1", "1 1 1e-9", " ".join(["1"] * 10_000)),
)  #: where several numbers stand


def pick(rng: Rng, choices: Sequence[Any]) -> Any:
    """One of several things of any class."""
    return choices[int(rng.integers(len(choices)))]
