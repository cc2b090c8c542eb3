"""Examples and benchmarks run in their quick modes and return sensible numbers."""

from pathlib import Path

import c_timing
import casadi as ca
import fits
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
