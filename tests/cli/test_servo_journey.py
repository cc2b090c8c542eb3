"""The journey of Fig. 28 with servos in MuJoCo (examples/servo_journey.py)."""

from pathlib import Path

import pytest
import servo_journey

pytestmark = pytest.mark.slow


def test_servos_couple_slightly_and_friction_keeps_joints_from_arriving(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While only xi1 steps, ideal joints leave y, z and xi3 alone; servos move them by fractions of a millimetre."""
    pytest.importorskip("mujoco")
    monkeypatch.setattr(servo_journey, "SECONDS", 2.5)
    found = servo_journey.main(tmp_path, quick=True)
    ideal, servos, friction, elastic = (found[name] for name in ("ideal", "servos", "with friction", "elastic gears"))
    for label in ("y", "z", "xi3"):
        assert ideal[f"largest_error_{label}"] < 1e-6
        assert 1e-5 < servos[f"largest_error_{label}"] < 5e-3
        assert 1e-5 < elastic[f"largest_error_{label}"] < 2e-2
    assert friction["largest_error_xi1"] > 2 * servos["largest_error_xi1"]
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".csv"] * 5 + [".png"] * 5
