"""Runs of the same law share the right-hand side that the first one built, and no other runs do."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import orthocas as oc
from orthocas.control import PDPlus, Reference
from orthocas.simulation import Friction, Push, Stops, loops


@pytest.fixture
def law(planar_chart: oc.Chart) -> PDPlus:
    return PDPlus(planar_chart, stiffness=50.0)


def run(law: PDPlus, natural_frequency: float = 6.0, **settings: Any) -> np.ndarray:
    q = law.problem.domain.centre
    start = law.chart.phi(q)
    reference = Reference.steps(law.labels, start, [(0.05, {"x": start[0] + 0.04})], 0.3, natural_frequency)
    return oc.simulate(law, reference, q, dq_start=[0.1, -0.1, 0.2], **settings).q[-1]


@pytest.mark.slow
def test_ends_are_those_of_a_process_that_remembers_nothing(law: PDPlus) -> None:
    robot = law.problem.robot
    variants: list[tuple[PDPlus, dict[str, Any]]] = [
        (law, {}),
        (replace(law, stiffness=80.0), {}),
        (replace(law, damping_ratio=1.0), {}),
        (law, {"natural_frequency": 9.0}),
        (law, {"plant": robot.with_scaled_masses(1.2)}),
        (law, {"friction": Friction(viscous=0.5)}),
        (law, {"friction": Friction(viscous=0.9)}),
        (law, {"pushes": [Push(0.1, 0.2, (5.0, 0.0, 0.0))]}),
        (law, {"stops": Stops()}),
    ]
    remembered = [run(some, **settings) for some, settings in variants]
    for end, (some, settings) in zip(remembered, variants, strict=True):
        loops.build_once.cache_clear()
        assert np.array_equal(end, run(some, **settings))
    ends = [end for end, (_, settings) in zip(remembered, variants, strict=True) if "stops" not in settings]
    assert len(np.unique(np.round(ends, 9), axis=0)) == len(ends)


@pytest.mark.slow
def test_a_second_run_builds_nothing(law: PDPlus) -> None:
    run(law)
    before = loops.build_once.cache_info()
    run(law)
    after = loops.build_once.cache_info()
    assert (after.misses, after.hits) == (before.misses, before.hits + 1)
