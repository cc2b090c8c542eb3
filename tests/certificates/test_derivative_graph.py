"""Derivatives in Taylor arithmetic hold CasADi's, and hold the truth where CasADi's constants are rounded."""

import casadi as ca
import numpy as np
import pytest
from test_taylor_models import values_at

import orthocas as oc
from orthocas import problems
from orthocas.certificates.graph import TaylorGraph
from orthocas.certificates.outside import find_periodic_joints
from orthocas.certificates.rows import build_joint_models, build_true_gradients
from orthocas.errors import CertifyError
from orthocas.tools.batch import dense_function
from orthocas.tools.expressions import find_gradient_dependences, write_tape

C = 2.0**55  #: spacing of numbers there: 8


def rounded(q: ca.SX) -> ca.SX:
    """1.5 q1^2 for real numbers, with the derivative 3 q1. CasADi's is 3 q1 - 3, since it rounds 3 + C to C."""
    x = q[0]
    return ((3 * x + C * (x + 1)) - C * x) - 3 * x + 1.5 * x * x


def chart_of(task: object, xi: object) -> oc.Chart:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    made = oc.Task.custom(robot, "task", task)
    problem = oc.Problem(robot, made, domain=oc.Box([0.1, 0.0], [0.5, 0.3]))
    return oc.fit(problem, oc.Given.from_function("xi", 2, xi)).chart


@pytest.mark.slow
@pytest.mark.parametrize("first", [True, False], ids=["task", "coordinates"])
def test_a_derivative_that_casadi_rounds_to_one_without_a_zero_is_not_certified(first: bool) -> None:
    """The exact determinant is +-3 q1, which vanishes at q1 = 0, inside the domain."""
    parts = (rounded, lambda q: q[1])
    folding = chart_of(*(parts if first else parts[::-1]))
    q = ca.SX.sym("q", 2)
    slope = float(ca.Function("slope", [q], [ca.jacobian(rounded(q), q)])([0.0, 0.0])[0])
    assert slope == -3.0  # what CasADi says; the truth is 0
    certificate = oc.certify(folding, time_limit=0.5)
    assert certificate.share == 0
    assert not certificate.fold


def functions(q: ca.SX) -> ca.SX:
    x, y = q[0], q[1]
    return ca.vertcat(
        ca.atan2(x * y, 1 + x),
        ca.atan2(3.0, y) / 2 + ca.tan(x),
        ca.log(x) - 2 * ca.atan(y),
        ca.asin(x / 3) * 4 - ca.acos(y / 4),
        ca.sqrt(x) ** 3 / (y - 3) + 1 / y,
        ca.exp(-x) * ca.tanh(y) + x**-2,
        (ca.cos(2 * x) - y) / ca.sin(y),
    )


def test_gradients_contain_those_of_casadi() -> None:
    q = ca.SX.sym("q", 2)
    h = dense_function("h", [q], [functions(q)])
    true = ca.Function("J", [q], [ca.densify(ca.jacobian(h(q), q))])
    rng = np.random.default_rng(5)
    low = rng.uniform(0.5, 1.0, (100, 2))
    half = rng.uniform(0, 0.1, (100, 2))
    joints, _ = build_joint_models(low, low + 2 * half, (0, 1))
    t = rng.uniform(-1, 1, (100, 2))
    points = low + half + half * t
    J = np.array([np.array(true(point)).ravel("F") for point in points])
    entries = TaylorGraph.build(h, "it", (0, 1))(joints)
    assert len(entries) == J.shape[1] == 14
    for entry, wanted in zip(entries, J.T, strict=True):
        there = np.broadcast_to(values_at(entry, t), wanted.shape)
        assert (np.abs(there - wanted) <= entry.remainder + 1e-13 * (1 + np.abs(wanted))).all()
        assert np.isfinite(entry.remainder).all()


@pytest.mark.parametrize("kind", ["pose", "pose:z", "orientation", "position+axis", "position:xy", "polar"])
def test_gradients_of_tasks_contain_finite_differences(kind: str) -> None:
    known = problems.get("iiwa")
    task = oc.Task.named(known.robot, kind, known.domain.centre)
    rng, n = np.random.default_rng(5), known.robot.n
    q = known.domain.centre + 0.3 * rng.uniform(-1, 1, (30, n))
    rows, depends = build_true_gradients(task, range(n))
    J = rows(build_joint_models(q - 0.01, q + 0.01, tuple(sorted(depends)))[0])
    t = rng.uniform(-1, 1, (30, n))
    h, step = task.batched, 1e-5
    for k in range(n):
        ends = [h(q + 0.01 * t + sign * step * np.eye(n)[k])[0].reshape(30, -1) for sign in (1, -1)]
        wanted = (ends[0] - ends[1]).T / (2 * step)  # exact to step^2 and to 1e-16 / step
        found = values_at(J, t[:, list(J.variables)])[:, k]
        assert (np.abs(found - wanted) <= J.remainder[:, k] + 1e-9).all()


def test_joints_that_gradients_depend_on_are_read_from_the_steps() -> None:
    q = ca.SX.sym("q", 4)
    h = dense_function("h", [q], [ca.vertcat(0.3 * q[0] + q[1] * q[2] - q[3] / 2, ca.sin(q[1]) + 2 / q[3])])
    linear, bent = find_gradient_dependences(write_tape(h))
    assert linear == {0: set(), 1: {2}, 2: {1}, 3: set()}
    assert bent == {1: {1}, 3: {3}}
    hidden = dense_function("h", [q], [rounded(q)])  # CasADi's derivative of C (x + 1) - C x has no x
    assert find_gradient_dependences(write_tape(hidden))[0] == {0: {0}}


def test_periods_are_read_from_the_steps() -> None:
    q = ca.SX.sym("q", 6)
    turning = ca.sin(q[0]) + ca.cos(3 * q[1] - 2 * q[2])
    whole = ca.vertcat(turning, q[3] + ca.atan2(ca.sin(q[3]), 2 + ca.cos(q[3])), ca.sin(q[4] / 2), q[5] ** 2)
    h = dense_function("h", [q], [whole])
    assert find_periodic_joints(write_tape(h), 6) == {0, 1, 2, 3}
    assert find_periodic_joints(write_tape(dense_function("h", [q], [ca.sin(1.5 * q[0]) + ca.tan(q[1])])), 6) == {
        1,
        2,
        3,
        4,
        5,
    }


@pytest.mark.parametrize(
    ("made", "complaint"),
    [
        (lambda q: ca.sin(ca.atan(q[0])), "the value of log, atan"),
        (lambda q: ca.fabs(q[0]), "operation fabs"),
        (lambda q: q[0] ** 1.5, "exponent that is not a small integer constant"),
        (lambda q: q[0] ** np.inf, "exponent that is not a small integer constant"),
        (lambda q: q[0] * ca.log(q[1]), "the value of log, atan"),
    ],
)
def test_what_has_no_bounds_is_refused_by_name(made: object, complaint: str) -> None:
    q = ca.SX.sym("q", 2)
    with pytest.raises(CertifyError, match=complaint):
        TaylorGraph.build(dense_function("h", [q], [made(q)]), "it", (0, 1))  # type: ignore[operator]
