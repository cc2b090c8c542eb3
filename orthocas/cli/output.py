"""What commands print: aligned text for people, or one JSON object."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from orthocas.files.json import to_json
from orthocas.quality import Report


def whole_number(text: str) -> int:
    """Read a whole number option."""
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} came, expected a whole number") from None


def number(text: str) -> float:
    """Read a number option."""
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} came, expected a number") from None


_UNEVEN = 30.0  # gains in a coordinate mean something else where its gradient is that much longer

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object."""
    typer.echo(to_json(data))


def print_rows(rows: Mapping[str, str]) -> None:
    """Print names and values in two columns."""
    width = max(len(name) for name in rows) + 2
    for name, value in rows.items():
        typer.echo(f"{name:<{width}}{value}")


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows in aligned columns; the last cell of a short row may be long."""
    head = rows[0]
    aligned = [row if len(row) == len(head) else row[:-1] for row in rows]
    widths = [max(len(row[k]) for row in aligned if k < len(row)) for k in range(len(head))]
    for row in rows:
        typer.echo("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=False)).rstrip())


def note(text: str) -> None:
    """A remark on standard error."""
    typer.echo(f"note: {text}", err=True)


def report_rows(report: Report) -> dict[str, str]:
    """A quality report as rows."""
    task, mutual, conditioning = report.task_angle, report.mutual_angle, report.conditioning
    quality = f"mean {conditioning.mean:.3f}, 1 % quantile {conditioning.p01:.3f}, min {conditioning.min:.3g}"
    rows = {
        "problem": f"n = {report.n} joints, m = {report.m} task, r = {report.r} extra, metric {report.metric}",
        "task angle": f"mean {task.mean:.2f}, std {task.std:.2f}, largest deviation {task.max:.1f} deg",
        "mutual angle": f"mean {mutual.mean:.2f}, std {mutual.std:.2f}, largest deviation {mutual.max:.1f} deg",
        "conditioning": quality,
        "lengths": f"of gradients differ by a factor of {report.length_ratio:.3g} (99 % to 1 % quantile)",
        "samples": f"{report.samples} held out, seed {report.seed}",
    }
    if report.r == 1:
        rows["mutual angle"] = "none, r = 1"
    if report.folded_samples:
        at = ", ".join(f"{value:.2f}" for value in report.worst_point)
        share = report.folded_samples / report.samples
        rows["folded"] = f"{share:.3%} of the domain, where det J changes sign; conditioning worst at q = ({at})"
    if report.singular_samples:
        rows["left out"] = f"{report.singular_samples / report.samples:.3%} of the domain: singular, or without a value"
    if report.length_ratio > _UNEVEN:
        rows["lengths"] += "; for controllers fit with --weights 1000,30,150,1"
    if report.degenerate:
        advice = "another domain, a larger lambda2 of the fit, or another leaf of a grown chart may help"
        rows["DEGENERATE"] = f"coordinates are nearly parallel or lean into the task: {advice}"
    return rows
