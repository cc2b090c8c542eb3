"""Strong pushes on the 7-DoF arm in MuJoCo, against the compiled supervised law."""

from pathlib import Path

import numpy as np
import pytest
from charts import with_metric
from programs import needs_c

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import PDPlus, Safety
from orthocas.simulation import MuJoCoPlant

pytest.importorskip("mujoco", reason="the extra sim is not installed")

import default_gains
import faults
import safety

pytestmark = [needs_c, pytest.mark.slow]


def test_pushed_arms_slow_down_come_to_rest_and_come_back(iiwa: oc.Problem) -> None:
    chart = oc.fit(with_metric(iiwa, "inertia"), oc.Polynomial(2), weights=(1000, 30, 150, 1)).chart
    found = safety.pushes(chart, 3)
    assert any(push.caught for push in found)
    for push in found:
        assert push.slow_after <= 0.5
        assert push.rest_after <= 2.0
        assert push.change <= 1.0 + 1e-9  # N m in a millisecond
        assert push.back_after < 60.0


def test_a_start_with_a_wrong_mass_is_not_caught_and_integral_action_takes_the_sag_away() -> None:
    """With A = M the light wrist makes up for the sag of the tip: a law that faded in over 0.2 s made it too fast."""
    chart = default_gains.chart_of("iiwa", "position", "inertia")
    law, plant = PDPlus.on_chart(chart), MuJoCoPlant(chart.problem.robot.with_scaled_masses(1.2))
    worst = default_gains.starts_of(chart.problem, 3)[2]
    with default_gains.compiled(law) as library:
        default = Supervisor(library, law, Safety.of(law, integral_rate=3.0))
        slow = Supervisor(library, law, Safety.of(law, integral_rate=3.0, fade_in=0.2))
        assert default_gains.held(law, default, plant, worst) < 1e-3  # [m] after 2 s
        assert np.isinf(default_gains.held(law, slow, plant, worst))  # caught


def test_faults_do_not_make_an_arm_run_away(tmp_path: Path) -> None:
    """Late torques, dead sensors, wild references and brakes, on an arm that nothing was tuned for."""
    chart = oc.charts.load("tiago-pro-left-position")
    law = PDPlus.on_chart(chart)
    generated = oc.generate_c(chart, tmp_path, law, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path, ("-O1",)), "arm", chart.n)
    arm = faults.Arm(chart, law, library, Safety.of(law), np.random.default_rng(1))
    for delay in (0, 5):
        for rest_after, goes_back in (faults.caught(arm, delay) for _ in range(3)):
            assert rest_after < 2.0
            assert goes_back
    assert max(faults.stands_still(arm, case) for case in faults.STANDING) < 3.0
    assert max(faults.led(arm, ask) for ask in faults.ASKED) < 1.2
    assert faults.brakes(arm) < 0.1
    assert faults.blow(arm)[1] < 0.5
