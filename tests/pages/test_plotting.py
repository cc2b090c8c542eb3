"""Figures hold what they say."""

from pathlib import Path

import numpy as np
import pytest

import orthocas as oc
from orthocas.charts.figures import quality_figure, self_motion_figure
from orthocas.fitting.fit import Fit


@pytest.mark.slow
def test_quality_figure_shows_both_deviations_and_the_leak(planar_fit: Fit) -> None:
    report = oc.evaluate(planar_fit.chart, 1000)
    left, middle, right = quality_figure(report).axes
    assert f"std {report.task_angle.std:.2f}" in left.get_title()
    assert f"std {report.mutual_angle.std:.2f}" in middle.get_title()
    assert f"rms {report.leak.rms:.2f}" in right.get_title()
    assert "[deg]" in left.get_xlabel()


@pytest.mark.slow
def test_quality_figure_without_mutual_angles(planar_xy: oc.Problem, tmp_path: Path) -> None:
    report = oc.evaluate(oc.fit(planar_xy, oc.Linear()).chart, 100)
    quality_figure(report).savefig(tmp_path / "q.png")
    assert (tmp_path / "q.png").stat().st_size > 5000


@pytest.mark.slow
def test_self_motion_figure_has_a_panel_per_coordinate_and_a_line_per_posture(iiwa_fit: Fit) -> None:
    figure = self_motion_figure(iiwa_fit.chart, postures=3)
    assert len(figure.axes) == 4
    assert all(len(panel.lines) == 3 for panel in figure.axes)
    tips = [line.get_data_3d()[0][-1] for line in figure.axes[0].lines]  # type: ignore[attr-defined]
    np.testing.assert_allclose(tips, tips[0], atol=1e-8)  # the flange stays
