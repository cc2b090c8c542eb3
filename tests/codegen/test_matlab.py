"""The MEX function of examples/matlab, compiled and called by Octave, gives what Python gives."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from programs import output_of

import orthocas as oc

SOURCE = Path(__file__).parents[2] / "examples" / "matlab" / "arm_mex.c"
SCRIPT = """
q = [{q}]';
[phi, J, s1] = arm_mex('chart', q);
[found, s2] = arm_mex('inverse', phi, q + 0.01);
[M, bias, gravity, s3] = arm_mex('dynamics', q, 0.1 + 0 * q);
printf('%.17g\\n', phi, J, found, M, bias, gravity, s1, s2, s3);
try, arm_mex('chart', [1 2]); catch problem, printf('%s\\n', problem.message); end
"""


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("mkoctfile") is None, reason="no Octave with mkoctfile")
def test_octave_calls_the_library(tmp_path: Path) -> None:
    chart = oc.load("panda-position")
    oc.generate_c(chart, tmp_path, name="arm")
    shutil.copy(SOURCE, tmp_path)
    output_of("mkoctfile", "--mex", "arm_mex.c", "arm.c", folder=tmp_path)
    q, n = chart.problem.domain.centre + 0.05, chart.n
    (tmp_path / "script.m").write_text(SCRIPT.format(q=" ".join(map(repr, q.tolist()))))
    *numbers, refusal = output_of("octave-cli", "--no-gui", "script.m", folder=tmp_path).splitlines()
    found = np.split(np.array(numbers, float), np.cumsum([n, n * n, n, n * n, n, n]))
    robot, columns = chart.problem.robot, {"order": "F"}
    expected = [
        *(chart.phi(q), chart.jacobian(q).ravel(**columns), q, robot.mass_matrix(q).ravel(**columns)),
        *(robot.bias(q, np.full(n, 0.1)), robot.gravity(q), np.zeros(3)),
    ]
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)
    assert refusal == "arm_mex: argument 2: expected a real vector of 7 numbers"
