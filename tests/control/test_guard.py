"""What control laws do in bad states, and with bad gains."""

from typing import Any

import numpy as np
import pytest
from baselines import KinematicProjector, Projector
from charts import linear_on_the_torus
from laws import torque

import orthocas as oc
from orthocas.control import ControlStatus, Impedance, Kinematic, PDPlus
from orthocas.control.controller import FROM_THE_LAW, Controller
from orthocas.errors import (
    InvalidValueError,
    ShapeError,
    UnknownNameError,
)
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array


@pytest.fixture(scope="module")
def laws(planar_chart: oc.Chart) -> list[Controller]:
    problem = planar_chart.problem
    limit = 30.0
    return [
        Impedance(planar_chart, 50.0, limit=limit),
        PDPlus(planar_chart, 50.0, coupling="decoupled", limit=limit),
        Kinematic(planar_chart, 1.0, limit=limit),
        Projector(problem, 50.0, 10.0, limit=limit),
        KinematicProjector(problem, 1.0, 1.0, limit=limit),
    ]


class TestGuard:
    """Bad states give a status and a finite, bounded command."""

    @staticmethod
    def run(law: Controller, q: Any, dq: Any = 0.0, reference: Any = 0.0) -> tuple[Array, int]:
        n, k = law.problem.n, len(law.labels)
        value = np.broadcast_to(reference, (k,))
        return torque(law, np.broadcast_to(q, (n,)), np.broadcast_to(dq, (n,)), value, np.zeros(k), np.zeros(k))

    def test_outside_the_domain_is_gravity_or_rest(self, laws: list[Controller], planar_x: oc.Problem) -> None:
        q = planar_x.domain.centre + 1.01 * planar_x.domain.half_width
        gravity = np.clip(planar_x.robot.gravity(q), -30, 30)
        for law in laws[:3]:
            command, status = self.run(law, q, 1.0)
            assert status == ControlStatus.OUTSIDE_DOMAIN
            np.testing.assert_allclose(command, gravity if law.command == "torque" else 0.0, atol=1e-12)
        for law in laws[3:]:
            assert self.run(law, q, 1.0)[1] in FROM_THE_LAW  # projectors have no domain

    def test_singular_task_is_told(self, laws: list[Controller]) -> None:
        for law in laws[3:]:
            command, status = self.run(law, [0.0, 0.0, 0.0], 1.0)  # stretched along x: dx/dq = 0
            assert status == ControlStatus.SINGULAR
            assert np.isfinite(command).all()

    def test_singular_chart_is_told(self) -> None:
        chart = linear_on_the_torus()
        for law in (Impedance(chart, 50.0), PDPlus(chart, 50.0), Kinematic(chart)):
            command, status = self.run(law, [0.0, 0.0, 0.0], 1.0)
            assert status == ControlStatus.SINGULAR
            want = chart.problem.robot.gravity(np.zeros(3)) if law.command == "torque" else np.zeros(3)
            np.testing.assert_allclose(command, want, atol=1e-12)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e200])
    def test_not_finite_input_is_told_wherever_it_comes(self, laws: list[Controller], bad: float) -> None:
        for law in laws:
            centre, n = law.problem.domain.centre, law.problem.n
            for q, dq, reference in (([0, bad, 0], 0.0, 0.0), (centre, [bad, 0, 0], 0.0), (centre, 0.0, bad)):
                command, status = self.run(law, q, dq, reference)
                assert status == ControlStatus.NOT_FINITE
                assert np.isfinite(command).all()
                assert np.abs(command).max() <= 30
            gains = {name: np.full(len(value), bad) for name, value in law.gains.items() if name != "limit"}
            k = len(law.labels)
            command, status = torque(law, centre, np.zeros(n), *np.zeros((3, k)), **gains)
            assert status == ControlStatus.NOT_FINITE

    def test_random_states_of_any_size_give_finite_bounded_commands(self, laws: list[Controller]) -> None:
        count = 2000
        for law in laws:
            n, k = law.problem.n, len(law.labels)
            rng = np.random.default_rng(21)
            scale = 10.0 ** rng.uniform(-3, 120, (count, 1))
            arrays = [rng.normal(size=(count, size)) * scale for size in (n, n, k, k, k)]
            arrays[0][::2] = sample_uniform(law.problem.domain, count // 2, 4)
            command, status = Batched(law.function)(*arrays, *(np.tile(g, (count, 1)) for g in law.gains.values()))
            assert np.isfinite(command).all()
            assert np.abs(command).max() <= 30
            assert set(np.unique(status)) <= {s.value for s in ControlStatus}
            assert len(np.unique(status)) >= 2

    @pytest.mark.parametrize("bad", [np.nan, -5.0, 0.0])
    def test_limit_that_is_none_stops_the_robot(self, laws: list[Controller], bad: float) -> None:
        for law in laws:
            n, k = law.problem.n, len(law.labels)
            command, status = torque(
                law,
                law.problem.domain.centre,
                *np.zeros((1, n)),
                np.full(k, 5.0),
                *np.zeros((2, k)),
                limit=np.full(n, bad),
            )
            assert status == ControlStatus.NOT_FINITE
            np.testing.assert_array_equal(command, 0.0)

    def test_limit_cuts_the_command(self, planar_chart: oc.Chart) -> None:
        q, far = planar_chart.problem.domain.centre, np.full(3, 10.0)
        free, ok = torque(Impedance(planar_chart, 50.0), q, *np.zeros((1, 3)), far, *np.zeros((2, 3)))
        law = Impedance(planar_chart, 50.0, limit=[5, 6, 7])
        cut, status = torque(law, q, *np.zeros((1, 3)), far, *np.zeros((2, 3)))
        np.testing.assert_allclose(cut, np.clip(free, [-5, -6, -7], [5, 6, 7]))
        assert np.abs(free).max() > 7
        assert (ok, status) == (ControlStatus.OK, ControlStatus.SATURATED)

    @pytest.mark.parametrize("limit", [0.3, [0.2, 1.0, 0.4]])
    def test_limit_of_velocities_keeps_their_direction(self, planar_chart: oc.Chart, limit: Any) -> None:
        problem, wanted = planar_chart.problem, np.array([0.5, -0.3, 0.2])
        q = problem.domain.centre
        for law, of in ((Kinematic, planar_chart), (KinematicProjector, problem)):
            k = len(law(of).labels)
            rate = np.resize(wanted, k)
            free, _ = torque(law(of), q, np.zeros(3), np.zeros(k), rate, np.zeros(k))
            cut, status = torque(law(of, limit=limit), q, np.zeros(3), np.zeros(k), rate, np.zeros(k))
            share = (np.broadcast_to(limit, 3) / np.abs(free)).min()
            assert share < 1
            np.testing.assert_allclose(cut, share * free, rtol=1e-12)
            assert status == ControlStatus.SATURATED

    def test_fallback_is_gravity_or_rest(self, laws: list[Controller]) -> None:
        for law in laws:
            q = law.problem.domain.centre
            command = law.fallback(q, *law.gains.values()).full().ravel()
            want = law.problem.robot.gravity(q) if law.command == "torque" else 0 * q
            np.testing.assert_allclose(command, want, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda c: Impedance(c, 0.0), InvalidValueError, r"stiffness\[0\] is 0.0, expected positive"),
        (lambda c: Impedance(c, [1, 2]), ShapeError, r"stiffness has shape \(2,\), expected \(3,\)"),
        (lambda c: PDPlus(c, [1, np.nan, 1]), InvalidValueError, r"stiffness\[1\] is nan"),
        (lambda c: PDPlus(c, 1.0, -0.1), InvalidValueError, r"damping_ratio\[0\] is -0.1"),
        (lambda c: PDPlus(c, 1.0, coupling="loose"), UnknownNameError, "unknown coupling 'loose'"),
        (lambda c: PDPlus(c, 1.0, damping="none"), UnknownNameError, "unknown damping 'none'"),
        (lambda c: PDPlus(c, 1.0, limit=-1.0), InvalidValueError, r"limit\[0\] is -1.0"),
        (lambda c: PDPlus(c, "stiff"), InvalidValueError, "stiffness is 'stiff'"),
        (lambda c: Kinematic(c, -1.0), InvalidValueError, r"feedback\[0\] is -1.0"),
        (lambda c: Projector(c.problem, 1.0, 0.0), InvalidValueError, r"posture_stiffness\[0\] is 0.0"),
        (lambda c: Projector(c.problem, [1, 1], 1.0), ShapeError, r"stiffness has shape \(2,\)"),
        (lambda c: KinematicProjector(c.problem, 0.0, [1, 1]), ShapeError, "posture_feedback"),
    ],
)
def test_bad_gains_are_refused(planar_chart: oc.Chart, make: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        make(planar_chart)
