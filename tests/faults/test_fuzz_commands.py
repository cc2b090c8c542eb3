"""A quick part of the campaign of command lines; `make fuzz` runs the rest."""

import contextlib
import io

import pytest
from fuzz.commands import commands
from programs import Run

from orthocas.cli.output import note, print_rows, print_table


@pytest.mark.slow
def test_command_lines_end_with_a_result_or_one_line() -> None:
    assert commands(20) == []


def test_terminals_get_no_control_characters_from_names(run: Run) -> None:
    """Names in files and on command lines can hold sequences that move the cursor or turn text around."""
    code, out, err = run("info", "\x1b[2J\u202ename")
    assert (code, out) == (2, "")
    assert "\\x1b[2J\\u202ename" in err
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(shown):
        print_rows({"joints": "a\x1b]0;title\x07"})
        print_table([["name"], ["b\u2066"]])
        note("c\r")
    assert shown.getvalue().replace("\n", "").isprintable()


@pytest.mark.parametrize("task", ["position", "pose"])
def test_robot_with_too_few_joints_for_a_task_is_told_so(run: Run, task: str) -> None:
    path = "arm.urdf"
    with open(path, "w") as file:
        file.write(
            '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous"><parent link="a"/>'
            '<child link="b"/></joint></robot>'
        )
    code, _, err = run("fit", path, "--task", task)
    assert code == 2
    assert "robot n = 1 joints, expected m < n" in err
