"""`orthocas solve`: finds joint positions from a task value and xi."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from orthocas.arms.arm import ANY, Arm, list_arms
from orthocas.arms.arm_file import is_arm
from orthocas.charts.inverse import InverseStatus
from orthocas.charts.ready import load
from orthocas.cli.options import AsJson, parse_number, parse_numbers
from orthocas.cli.output import print_json, print_rows
from orthocas.errors import InvalidValueError, OptionError
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array
from orthocas.tools.json import clean

# Numbers of a position with a quaternion, and of a 4 x 4 matrix.
_QUATERNION, _MATRIX = 7, 16


def solve(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="CHART|ARM", help="A chart or an arm: a file, or a ready one, such as panda-wide or panda."
        ),
    ],
    x: Annotated[
        str,
        typer.Option(
            "--x", help='Task value "0.5,0,0.4,..."; of a pose also x,y,z,qw,qx,qy,qz, or a 4 x 4 matrix row by row.'
        ),
    ],
    xi: Annotated[str | None, typer.Option("--xi", help="Extra coordinates; default: near --start.")] = None,
    start: Annotated[
        str | None, typer.Option("--start", help='Joint positions to be near to, "0,0.5,..."; default: none.')
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Of an arm: every posture with x and --xi.")] = False,
    json: AsJson = False,
) -> None:
    """Find joint positions with a given task value and, optionally, xi. Exit code 1 if there are none."""
    near = None if start is None else parse_numbers("--start", start)
    if is_arm(file) or (str(file) in list_arms() and not file.exists()):
        arm = Arm.load(file)
        value = None if xi is None else parse_number(xi)
        target = _read_target(arm.task, x)
        if every:
            if value is None:
                raise OptionError("--all requires --xi")
            postures: Any = arm.solve(target, value, near, ANY, all=True)
        else:
            postures = arm.solve(target, value, near, ANY)
        single = postures.q.ndim == 1
        statuses = [postures.status] if single else postures.status
        branches = [postures.branch] if single else postures.branch
        rows = list(
            zip(np.atleast_2d(postures.q), np.atleast_1d(postures.xi)[:, None], statuses, branches, strict=True)
        )
    else:
        if every:
            raise OptionError("--all requires an arm file, such as orthocas fit --domain all writes")
        chart = load(file)
        target = _read_target(chart.task, x)
        q_start = chart.domain.home if near is None else near
        if xi is None:
            found = chart.nearest_xi(q_start, target)
        else:
            found = chart.solve(x=target, xi=parse_numbers("--xi", xi, chart.r), q_start=near)
        # A row with bad input has no posture.
        q, name = found.q[0], str(chart.notes.get("branch", ""))
        values = np.ravel(chart.xi(q)) if np.isfinite(q).all() else np.full(chart.r, np.nan)
        rows = [(q, values, found.status[0], name)]
    _print(rows, json)


def _read_target(task: Task, text: str) -> Array:
    """The task's vector from the numbers of --x."""
    # The count of numbers distinguishes a matrix, a position with a quaternion, and the task's own numbers.
    numbers = parse_numbers("--x", text)
    if len(numbers) == _MATRIX:
        return task.target(numbers.reshape(4, 4))
    if len(numbers) == _QUATERNION != task.m:
        return task.target((numbers[:3], numbers[3:]))
    if len(numbers) != task.m:
        raise InvalidValueError("--x", repr(text)[:80], f"{task.m} numbers: {', '.join(task.labels)}, or a pose")
    return numbers


def _print(rows: list[tuple[Array, Array, Any, str]], json: bool) -> None:
    """Print one or several postures; exit code 1 if there is none."""
    # Print the same postures as data or as text, with numbers that options accept.
    found = [
        {"q": clean(q), "xi": clean(xi), "status": InverseStatus(int(status)).name, "branch": branch}
        for q, xi, status, branch in rows
    ]
    if json:
        print_json({"postures": found})
    elif not found:
        typer.echo("no posture")
    for k, (q, xi, status, branch) in enumerate(() if json else rows):
        label = f" {k + 1}" if len(rows) > 1 else ""
        # What misses x is no posture that anybody asked for.
        missed = status in (InverseStatus.NOT_FOUND, InverseStatus.BAD_INPUT, InverseStatus.OUT_OF_REACH)
        xi_text = _write(xi) if np.isfinite(xi).all() and not missed else "none"
        named = {f"branch{label}": branch} if branch and not missed else {}
        texts = {f"q{label}": "none" if missed else _write(q), f"xi{label}": xi_text, **named}
        print_rows({f"status{label}": InverseStatus(int(status)).name, **texts})
    # The exit code is 1 if no posture has the task value x.
    if not any(np.isfinite(q).all() and status <= InverseStatus.OUTSIDE_DOMAIN for q, _, status, _ in rows):
        raise typer.Exit(1)


def _write(values: Array) -> str:
    """Numbers in the form that options accept."""
    return ",".join(f"{value:.9g}" for value in values)
