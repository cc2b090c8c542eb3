"""Examples and benchmarks run in their quick modes and return sensible numbers."""

from pathlib import Path

import c_timing
import casadi as ca
import fits
import front
import iiwa_demo
import numpy as np
import pytest
import scaling


def test_demo_saves_chart_and_pictures(tmp_path: Path) -> None:
    found = iiwa_demo.main(tmp_path, quick=True)
    assert found["task_std_deg"] < 2.4
    assert found["mutual_std_deg"] < 3.44
    for name in ("iiwa.orthocas", "iiwa_quality.png", "iiwa_self_motion.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_fit_benchmark_prints_rows() -> None:
    rows = fits.main(quick=True)
    assert len(rows) == 2
    assert rows[0].startswith("| iiwa | polynomial:2 |")


def test_scaling_benchmark_prints_rows() -> None:
    assert len(scaling.main(quick=True)) == 2


def test_compiled_timing_harness_times_calls() -> None:
    x = ca.SX.sym("x", 3)
    try:
        times = c_timing.nanoseconds_per_call({"f": ca.Function("f", [x], [ca.sin(x)])}, rounds=1, calls=1000)
    except RuntimeError as error:
        pytest.skip(str(error))
    assert np.isfinite(times["f"])
    assert times["f"] > 1


def test_front_shows_the_trade_and_the_trap(tmp_path: Path) -> None:
    found = front.main(tmp_path, quick=True)
    assert found["task_std_small_lambda2"] < found["task_std_large_lambda2"]
    assert found["p01_small_lambda2"] < 0.2  # nearly parallel coordinates at the paper's weights
    assert found["p01_with_regularity"] > found["p01_without_regularity"]
    assert found["folded_with_regularity"] == 0
    assert (tmp_path / "front.png").stat().st_size > 10_000
