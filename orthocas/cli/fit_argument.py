"""Command-line options of fits, for single ones and for comparisons."""

from dataclasses import replace
from typing import Annotated

import typer

from orthocas.cli.output import whole_number
from orthocas.cli.problem_argument import parse_numbers
from orthocas.errors import InvalidValueError
from orthocas.fitting.loss import DEFAULT_WEIGHTS, Weights

SampleCount = Annotated[
    int | None,
    typer.Option("--samples", parser=whole_number, help="Number of training samples; default: from the problem size."),
]
WeightsText = Annotated[
    str, typer.Option("--weights", help='"lambda1,lambda2", optionally followed by lambda3, lambda4 and lambda5.')
]
AnglesName = Annotated[
    str | None,
    typer.Option(
        "--angles",
        help="Angles in the loss: paper (Euclidean norms) or metric; default: metric with --metric inertia.",
    ),
]
PrecisionName = Annotated[
    str,
    typer.Option(
        "--precision", help="Of the large products of a fit: double, or single, which is faster and takes less memory."
    ),
]
_NUMBERS = ("task", "mutual", "regularity", "length", "folds")
WEIGHTS_TEXT = ",".join(f"{getattr(DEFAULT_WEIGHTS, name):g}" for name in _NUMBERS)


def parse_weights(text: str, angles: str | None) -> Weights:
    """Read two to five numbers, such as "1000,30" or "1000,30,150,0.01,1000", with the kind of angles."""
    numbers = parse_numbers("--weights", text).tolist()
    if not 2 <= len(numbers) <= 5:
        raise InvalidValueError("--weights", repr(text), "two to five numbers")
    return replace(Weights.of(numbers), angles=angles)
