"""The benchmark of redundancy resolution: its arms, its judges, and a method from a file outside."""

import json
from pathlib import Path

import numpy as np
import pytest
import redundancy_page
from redundancy import runner
from redundancy.arms import Arm
from redundancy.protocol import Run, Stream, Target

DUMMY = """
class HoldStill:
    name, packages, grid = "hold still", ("numpy",), ({},)

    def __init__(self, arm):
        pass

    def start(self, q, path):
        self.q = q

    def step(self, target):
        return self.q


METHODS = (HoldStill,)
"""


def test_the_urdf_of_an_arm_says_the_same_to_pinocchio_and_orthocas() -> None:
    arm = Arm("panda")
    q = arm.home + 0.1 * np.sin(np.arange(7))
    assert np.abs(arm.error(q, arm.placement(q))).max() < 1e-12
    np.testing.assert_allclose(arm.placement(q).translation, arm.robot.tip_position(q), atol=1e-12)
    np.testing.assert_allclose(arm.jacobian(q)[:3], arm.robot.tip_jacobian(q)[:3], atol=1e-12)


def test_postures_of_the_self_motion_have_the_elbow_that_was_asked_for() -> None:
    arm = Arm("panda")
    q = arm.with_elbow(0.2)
    assert abs(arm.elbow(q) - 0.2) < 1e-4
    assert np.abs(arm.error(q, arm.placement(arm.home))).max() < 1e-4


@pytest.mark.slow
def test_all_scenarios_have_a_thread_and_streams_that_begin_at_home() -> None:
    known = runner.scenarios()
    assert len(known) == 15
    for name, scenario in known.items():
        assert scenario.threads, name
        assert all(address.startswith("https://") for address in scenario.threads)
        arm = Arm("iiwa", scenario.mobile)
        for stream in scenario.streams(arm, np.random.default_rng(0), True):
            first = arm.error(stream.start, stream.targets[0].placement)
            assert np.abs(first).max() < 2e-2, name


def test_what_is_stored_is_of_the_same_methods_in_all_scenarios() -> None:
    """Rows of trials do not stay among those that were measured."""
    stored = {name: json.loads((runner.RESULTS / f"{name}.json").read_text()) for name in runner.scenarios()}
    assert len({frozenset(result["methods"]) for result in stored.values()}) == 1
    assert {"arm", "chart, wide", "SEW angle"} < set(stored["drift"]["methods"])


def test_a_package_that_is_missing_has_a_row_that_says_so(tmp_path: Path) -> None:
    path = tmp_path / "absent.py"
    path.write_text("import no_such_package_here\n")
    (method,) = [method for method in runner.methods([path]) if method.name == "absent"]
    found = runner.case(runner.scenarios()["drift"], Arm("iiwa"), runner.built(method, Arm("iiwa"), {}), 0, True)
    assert found["why"] == "not installed (no_such_package_here)"


def test_a_tip_that_is_off_at_two_per_cent_of_the_ticks_did_not_follow() -> None:
    arm = Arm("iiwa")
    stream = Stream(arm.home, [Target(arm.placement(arm.home), arm.home)] * 100)
    errors = np.zeros((100, 2))
    errors[:2, 0] = 3e-3
    assert not Run(stream, np.tile(arm.home, (100, 1)), errors, True, True).followed
    errors[0, 0] = 0
    assert Run(stream, np.tile(arm.home, (100, 1)), errors, True, True).followed


def row(method: str, *values: float) -> redundancy_page.Row:
    """A method on eight arms."""
    return redundancy_page.Row(method, {(f"arm {k}", 0): value for k, value in enumerate(values)}, [], [], "")


def test_ranks_count_who_is_ahead_on_more_arms_than_a_coin_would_be() -> None:
    scenario, inf = runner.scenarios()["drift"], np.inf
    rows = [
        row("exact", *[1e-15] * 8),
        row("exact too", *[1e-9] * 8),  # as good to a user
        row("drifts", *[0.1] * 8),
        row("drifts on most", *[1e-15] * 3, *[0.2] * 5),  # 5 of 5 decide: chance one of sixteen
        row("serves half", *[1e-15] * 2, *[inf] * 6),
        row("none", *[inf] * 8),
    ]
    found = redundancy_page.ranks(rows, scenario)
    assert found == {"exact": 1, "exact too": 1, "drifts on most": 1, "drifts": 3, "serves half": 4}


def test_pairs_that_change_places_are_those_of_which_each_is_ahead_once() -> None:
    cases = [{"arm": f"arm {k}", "served": True} for k in range(8)]
    kept = {
        "one": [case | {"seed": seed, "value": [0.1, 0.3][seed]} for case in cases for seed in (0, 1)],
        "other": [case | {"seed": seed, "value": [0.2, 0.2][seed]} for case in cases for seed in (0, 1)],
        "third": [case | {"seed": seed, "value": 0.4} for case in cases for seed in (0, 1)],
    }
    result = {"seeds": [0, 1], "methods": {name: {"cases": rows} for name, rows in kept.items()}}
    assert redundancy_page.changes({"drift": result}) == [("drift", "one", "other")]


@pytest.mark.slow
def test_a_quick_run_with_a_method_from_a_file_outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A chart closes circles and holds the elbow; the pseudo-inverse drifts; who holds still serves nobody."""
    path = tmp_path / "hold_still.py"
    path.write_text(DUMMY)
    wanted = {"pseudo-inverse", "chart, tight", "hold still"}
    every = runner.methods
    monkeypatch.setattr(runner, "methods", lambda more=(), only=(): [one for one in every(more) if one.name in wanted])
    found = runner.measured(["drift", "elbow"], ["panda"], [0], [path], quick=True, processes=1)
    value = {
        name: {method: row["cases"][0] for method, row in result["methods"].items()} for name, result in found.items()
    }
    assert value["drift"]["chart, tight"]["value"] < 1e-9
    assert value["drift"]["pseudo-inverse"]["value"] > 1e-3
    assert value["elbow"]["chart, tight"]["value"] < 0.1
    assert not any(cases["hold still"]["served"] for cases in value.values())
    lines = redundancy_page.table(runner.scenarios()["drift"], found["drift"])
    assert [line.split("|")[1].strip() for line in lines[1:]] == ["chart, tight", "pseudo-inverse", "hold still"]
    redundancy_page.picture(runner.scenarios()["drift"], found["drift"]).savefig(tmp_path / "drift.png")


def test_a_part_of_a_run_keeps_what_others_have_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of other methods stay, and cases of other arms and seeds if the settings are the same."""
    monkeypatch.setattr(runner, "RESULTS", tmp_path)

    def content(arm: str, seed: int, value: float, **settings: float) -> dict[str, object]:
        row = {"settings": settings, "cases": [{"arm": arm, "seed": seed, "value": value}]}
        return {"schema": runner.SCHEMA, "arms": [arm], "seeds": [seed], "methods": {"one": row}}

    def kept() -> dict[str, list[tuple[str, int, float]]]:
        rows = json.loads((tmp_path / "drift.json").read_text())["methods"]
        return {name: [tuple(case.values()) for case in row["cases"]] for name, row in rows.items()}

    other = content("panda", 0, 5.0)
    other["methods"] = {"other": {"settings": {}, "cases": [{"arm": "panda", "seed": 0, "value": 5.0}]}}
    for results in (other, content("panda", 0, 1.0), content("iiwa", 1, 2.0), content("panda", 0, 3.0)):
        runner.save({"drift": results})
    assert kept() == {"other": [("panda", 0, 5.0)], "one": [("iiwa", 1, 2.0), ("panda", 0, 3.0)]}
    runner.save({"drift": content("iiwa", 0, 4.0, clearance=0.2)})
    assert kept()["one"] == [("iiwa", 0, 4.0)]
