"""Public objects print in a few lines and show themselves in notebooks, whatever they hold."""

import html
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from baselines import KinematicProjector
from conftest import arm
from public_objects import CONTROLLERS, OBJECTS, comparison, fitted, impedance, planar, trajectory

import orthocas as oc
from orthocas import control, problems
from orthocas.charts.quality import AngleStatistics, Conditioning
from orthocas.cli.output import format_report_rows
from orthocas.tools.display import Shown, as_html, as_text, listed, number_list, percent

EVIL = "<b>&'\"\n</td>"  # a text that a file of others may hold
NAME = EVIL.replace("\n", "")  # names are printable


def wicked() -> oc.Chart:
    """A chart whose names are all hostile, for seven joints."""
    known = problems.get("iiwa")
    tree = replace(known.robot.tree, joint_names=tuple(NAME * 20 + str(i) for i in range(7)), tip_name=NAME)
    robot = oc.Robot(tree)
    task = oc.Task.custom(robot, NAME, lambda q: q[0] ** 2 + q[1] * q[2], [NAME])
    problem = oc.Problem(robot, task, domain=known.domain, name=NAME * 30)
    return oc.Chart(problem, oc.fit(problem, oc.Linear()).chart.coordinates, {EVIL: EVIL, "long": "word " * 100})


def many_joints() -> oc.Robot:
    return oc.Robot.from_model(*arm("talos, both arms and the torso"))


LARGE = {
    "hostile names": wicked,
    "law of hostile names": lambda: KinematicProjector(wicked().problem),
    "many joints": many_joints,
    "iiwa": lambda: problems.get("iiwa"),
    "box of the iiwa": lambda: problems.get("iiwa").domain,
    "coordinates": lambda: fitted().chart.coordinates,
    "stage": lambda: fitted().stages[-1],
    "leaf": lambda: OBJECTS["disk chart"]().coordinates.leaf,
    "grown coordinates": lambda: OBJECTS["circle chart"]().coordinates,
    "report with every fault": lambda: replace(
        OBJECTS["report"](),
        conditioning=Conditioning(0.0, 0.0, 0.1),
        worst_point=tuple(np.linspace(0, 1, 30)),
        folded_samples=100,
        singular_samples=3,
    ),
    "comparison of many": lambda: replace(
        comparison(),
        results=tuple(replace(comparison().results[0], solver=f"{k}" * 50, error=EVIL * 30) for k in range(30)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*OBJECTS, *LARGE])
def test_objects_print_in_a_few_lines(name: str) -> None:
    text = repr((OBJECTS | LARGE)[name]())
    assert 0 < len(text) < 1000
    assert text.count("\n") < 9
    assert " object at 0x" not in text


@pytest.mark.parametrize("name", [*OBJECTS, *LARGE])
def test_tables_of_notebooks_hold_text_only(name: str) -> None:
    thing = (OBJECTS | LARGE)[name]()
    if not isinstance(thing, Shown):
        return
    table = thing._repr_html_()
    assert set(re.findall(r"</?(\w+)", table)) == {"table", "caption", "tr", "th", "td"}
    cells = re.findall(r"<td[^>]*>(.*?)</td>", table, re.DOTALL)
    assert [html.unescape(cell) for cell in cells] == list(thing.facts().values())
    assert not re.search(r"&(?!(amp|lt|gt|quot|#x27);)", table)


SHOWN = ["robot", "task", "problem", "polynomial chart", "circle chart", "fit", "report", "trajectory", "comparison"]


@pytest.mark.parametrize("name", [*SHOWN, "distilled", "involutivity", "steps", "coupling", *CONTROLLERS])
def test_the_main_objects_have_tables(name: str) -> None:
    assert isinstance(OBJECTS[name](), Shown)


@pytest.mark.parametrize(
    ("name", "facts"),
    [
        ("robot", ["3 joints", "tip tip", "9 kg", "q1, q2, q3"]),
        ("problem", ["planar_3r_x", "m = 1", "inertia", "half-width 0.3927"]),
        ("polynomial chart", ["polynomial:3", "x, xi1, xi2", "seed 0"]),
        ("fit", ["polynomial:3", "converged"]),
        ("impedance", ["torque", "60", "coupled", "double_diagonal"]),
        ("steps", ["0.5 s", "2 segments"]),
        ("comparison", ["2 fits", "polynomial:1", "task std"]),
    ],
)
def test_what_people_look_for_is_there(name: str, facts: list[str]) -> None:
    text = repr(OBJECTS[name]())
    for fact in facts:
        assert fact in text


def test_numbers_shown_are_those_of_the_object() -> None:
    run = trajectory()
    assert f"largest torque  {number_list(np.abs(run.command).max(axis=0))}" in repr(run)
    assert f"x {run.tracking_error[0]:.3g}, xi1" in repr(run)
    report = oc.evaluate(fitted().chart, 500)
    assert f"std {report.task_angle.std:.2f}" in repr(report)
    assert f"{fitted().stages[-1].result.value:.4g}" in repr(fitted())


def test_the_command_line_shows_the_facts_of_a_report() -> None:
    report = oc.evaluate(fitted().chart, 500)
    assert report.length_ratio > 30
    advised = format_report_rows(report, fitted().chart)
    assert advised.pop("lengths").startswith(report.facts()["lengths"])
    assert advised == {name: text for name, text in report.facts().items() if name != "lengths"}


def test_text_and_table_of_facts() -> None:
    facts = {"what": "a thing", "size": "3", "a longer name": "1 < 2"}
    assert as_text("Thing", facts) == "Thing: a thing\n  size           3\n  a longer name  1 < 2"
    assert "<td style='text-align:left'>1 &lt; 2</td>" in as_html("Thing", facts)
    assert listed(["a", "b", "c"], 2) == "a, b, and 1 more"
    assert number_list([1.0, 1.0]) == "1"
    assert number_list([1.0, 2.5, np.pi]) == "1, 2.5, 3.142"


def test_histograms_and_parameters_are_not_printed() -> None:
    angles = AngleStatistics.of_cosines(np.zeros(10))
    assert repr(angles) == "AngleStatistics(mean=90.0, std=0.0, max=0.0)"
    things: list[Any] = [fitted().chart.coordinates, fitted().stages[-1].result]
    assert not any("array" in repr(thing) for thing in things)


def test_objects_show_while_a_law_is_not_built() -> None:
    """Printing is quick: it builds no function."""
    law = control.PDPlus(impedance().chart, 60.0)
    repr(law)
    assert "_built" not in vars(law)
    assert planar().name in repr(law)


@pytest.mark.parametrize(
    ("share", "digits", "text"),
    [
        (1.0, 3, "100.000%"),
        (1 - 2**-53, 3, "99.999%"),
        (0.999999, 0, "99%"),
        (0.29, 1, "29.0%"),  # 100 * 0.29 is 28.999999999999996
        (0.1064, 1, "10.6%"),
        (1e-9, 2, "0.00%"),
        (0.0, 2, "0.00%"),
    ],
)
def test_shares_are_rounded_down(share: float, digits: int, text: str) -> None:
    assert percent(share, digits) == percent(np.float64(share), digits) == text


def test_shares_of_faults_are_rounded_up() -> None:
    assert percent(1e-9, 2, fault=True) == "0.01%"
    assert percent(0.0, 2, fault=True) == "0.00%"
    assert percent(float("nan")) == "unknown"


def test_no_text_of_the_library_rounds_a_share_to_the_nearest() -> None:
    """All percentages come from `percent`, except those of pictures."""
    found = [
        f"{path.name}: {line.strip()}"
        for path in sorted(Path(oc.__file__).parent.rglob("*.py"))
        for line in path.read_text("utf-8").splitlines()
        if re.search(r":\.\d%\}", line) and "least_fraction" not in line
    ]
    assert not found
