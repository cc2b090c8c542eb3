"""What is proved on a full turn holds at all positions, or the proof is refused; and no file is believed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import ROBOTS, robot_data

import orthocas as oc
from orthocas import problems
from orthocas.bases import JointSpace, Parametrisation
from orthocas.bases.cyclic import keeps_self_motions
from orthocas.certificates import check_certificate
from orthocas.certificates.certify import cover_domain
from orthocas.charts.certificate import ELIMINATION, PROVED, Certificate, Subdivision
from orthocas.charts.chart_file import fingerprint
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import CertifyError, ChartFileError
from orthocas.tasks.corridor import Corridor


def two_joints() -> oc.Robot:
    return oc.Robot.planar([1.0, 1.0], [1.0, 1.0])


def on_torus(task: Callable[[ca.SX], ca.SX], xi: Parametrisation | Callable[[ca.SX], ca.SX]) -> oc.Chart:
    robot = two_joints()
    problem = oc.Problem(robot, oc.Task.custom(robot, "task", task), domain=oc.Torus(2))
    made = xi if isinstance(xi, Parametrisation) else oc.Given.from_function("xi", 2, xi)
    return oc.fit(problem, made, samples=200).chart


def forged(chart: oc.Chart, **changes: object) -> Certificate:
    """A proof in one part, as if all were proved."""
    base = cover_domain(chart.problem.domain)
    whole = Subdivision(base.low, base.high, np.array([PROVED], dtype=np.uint8))
    made = Certificate(fingerprint(chart.problem, chart.coordinates), ELIMINATION, 0.0, whole, 0.0)
    return replace(made, **changes).seal()  # type: ignore[arg-type]


WAVE = lambda q: q[0] + 0.3 * ca.sin(q[1])  # noqa: E731


def test_a_chart_that_is_regular_on_one_turn_only_is_refused() -> None:
    """Its slope 1 - 0.06 q2^2 is positive on [-pi, pi] and negative at 4.5, which the torus contains."""
    folding = on_torus(WAVE, lambda q: q[1] - 0.02 * q[1] ** 3)
    points = np.array([[0.0, 0.0], [0.0, 4.5]])
    assert folding.problem.domain.contains(points).all()
    assert np.prod(np.linalg.det(folding.jacobian(points))) < 0
    complaint = "joint 'q2' is unbounded and J is not periodic in it"
    with pytest.raises(CertifyError, match=complaint):
        oc.certify(folding)
    with pytest.raises(CertifyError, match=complaint):
        check_certificate(folding, forged(folding))


@pytest.mark.parametrize("kind", [oc.Polynomial(2), oc.MLP((4,), raw=True)], ids=lambda kind: kind.label)
def test_families_that_are_not_periodic_are_refused_on_a_torus(kind: Parametrisation) -> None:
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Torus(3))
    with pytest.raises(CertifyError, match="J is not periodic"):
        oc.certify(oc.fit(problem, kind, samples=60, seed=0).chart, time_limit=1)


@pytest.mark.parametrize(
    "xi",
    [lambda q: q[1] + 0.3 * ca.sin(q[0] - q[1]), lambda q: ca.atan2(ca.sin(q[1]), ca.cos(q[1]))],
    ids=["wave", "angle"],
)
def test_periodic_charts_are_proved_on_the_torus(xi: Callable[[ca.SX], ca.SX]) -> None:
    chart = on_torus(WAVE, xi)
    certificate = oc.certify(chart)
    assert certificate.proved
    assert check_certificate(chart, certificate)
    q = np.random.default_rng(5).uniform(-50, 50, (20_000, 2))
    assert (np.linalg.det(chart.jacobian(q)) * np.linalg.det(chart.jacobian(np.zeros(2))) > 0).all()


@pytest.mark.parametrize("centre", [0.0, 3.0, -10.0])
def test_the_box_of_a_full_turn_holds_every_angle(centre: float) -> None:
    """pi is rounded down, and so may be the boundaries."""
    box = cover_domain(oc.Box([centre], np.pi, [0]))
    assert (box.high[0] - centre) - np.pi > 1e-15
    assert (centre - box.low[0]) - np.pi > 1e-15


def flipping(q: ca.SX) -> ca.SX:
    """50 s - s^3 / 3 with s = q1 + q2: the gradient (50 - s^2) (1, 1) flips at s = 7.07."""
    s = q[0] + q[1]
    return 50 * s - s**3 / 3


def believed_cyclic() -> oc.Chart:
    """xi = q1 - q2 with a q1 that turns without end, named cyclic."""
    robot = two_joints()
    domain = oc.Box([0.0, 0.0], [np.pi, 0.1], [0])
    problem = oc.Problem(robot, oc.Task.custom(robot, "flipping", flipping), domain=domain)
    theta, ones = np.array([0.1, -np.pi]), np.ones(1)
    return oc.Chart(problem, Coordinates(oc.Polynomial(1, ["q1"]), JointSpace.of(problem), (), theta, 0 * ones, ones))


def test_a_joint_that_a_chart_names_cyclic_is_not_believed(tmp_path: Path) -> None:
    chart = believed_cyclic()
    points = np.array([[0.0, 0.0], [7.2, 0.0]])
    assert chart.problem.domain.contains(points).all()
    assert np.prod(np.linalg.det(chart.jacobian(points))) < 0
    with pytest.raises(CertifyError, match="joint 'q1' is unbounded and J is not periodic"):
        oc.certify(chart)
    with pytest.raises(CertifyError, match="joint 'q1' is unbounded and J is not periodic"):
        check_certificate(chart, forged(chart))
    chart.save(tmp_path / "a.chart")
    with pytest.raises(ChartFileError, match="cyclic is 'q1', expected a joint that is proved"):
        oc.load(tmp_path / "a.chart")


def test_half_a_turn_of_an_unbounded_joint_is_not_enough() -> None:
    robot = two_joints()
    domain = oc.Box([0.0, 0.0], [1.0, 0.1], [0])
    task = oc.Task.custom(robot, "wave", lambda q: ca.sin(q[0]) + 3 * q[1])
    problem = oc.Problem(robot, task, domain=domain)
    with pytest.raises(CertifyError, match="expected bounds, or a half-width of pi"):
        oc.certify(oc.fit(problem, oc.Given.from_function("xi", 2, lambda q: q[0])).chart)


def test_a_corridor_beyond_the_first_turn_is_not_proved_by_the_box() -> None:
    """Its path is at q1 = 7; in the box, q1 ends at pi, and all of it is far from the path."""
    known = problems.get("planar_3r_xy")
    box = oc.Box([0.0, 0.8, 0.8], [np.pi, 0.3, 0.3], [0])
    corridor = Corridor(box, [[7.0, 0.8, 0.8], [7.2, 0.8, 0.8]], [0.2, 0.2, 0.2])
    assert corridor.contains([7.1, 0.8, 0.8])
    free = oc.fit(oc.Problem(known.robot, known.task, domain=box), oc.Linear()).chart
    chart = oc.Chart(oc.Problem(known.robot, known.task, domain=corridor), free.coordinates)
    with pytest.raises(CertifyError, match="joint 'q1' is unbounded, expected an infinite radius"):
        oc.certify(chart, time_limit=1)


@pytest.mark.parametrize(
    ("kind", "wanted"),
    [
        ("position", ("torso_lift_joint", "arm_1_joint")),
        ("position:xy", ("torso_lift_joint", "arm_1_joint")),
        ("position:xz", ("torso_lift_joint",)),
        ("pose", ("torso_lift_joint", "arm_1_joint", "arm_7_joint")),
        ("pose:z", ("torso_lift_joint", "arm_1_joint", "arm_7_joint")),
        ("position+axis:z", ("torso_lift_joint", "arm_1_joint")),
    ],
)
def test_leaves_are_proved_to_stay_where_finite_motions_say_so(kind: str, wanted: tuple[str, ...]) -> None:
    """Reference: the projector on the task gradients at other positions of each joint, by samples."""
    file, tip = ROBOTS["tiago with its prismatic torso"]
    robot = oc.Robot.from_urdf(robot_data(file), tip)
    centre = robot.tree.centre_posture + 0.1
    problem = oc.Problem(robot, oc.Task.named(robot, kind, centre), domain=oc.Box(centre, 0.01))
    rng = np.random.default_rng(5)
    q = centre + 0.1 * rng.uniform(-1, 1, (20, robot.n))

    def projectors(points: np.ndarray) -> np.ndarray:
        J = problem.task.batched_jacobian(points)[0].reshape(len(points), problem.m, robot.n)
        return np.asarray(np.linalg.pinv(J) @ J)

    for k, name in enumerate(robot.joint_names):
        moved = q + 0.5 * np.eye(robot.n)[k]
        stays = np.abs(projectors(moved) - projectors(q)).max() < 1e-7
        if name in wanted:
            assert keeps_self_motions(problem, k)
        if keeps_self_motions(problem, k):
            assert stays, name


def test_metrics_that_feel_a_joint_refute_a_proof() -> None:
    known = problems.get("planar_3r_xy")
    heavy = oc.Problem(known.robot, known.task, lambda q: ca.diag(2 + ca.cos(q)), known.domain)
    moving = oc.Problem(known.robot, known.task, "inertia", known.domain)
    assert [keeps_self_motions(heavy, 0), keeps_self_motions(moving, 0), keeps_self_motions(known, 0)] == [
        False,
        True,
        True,
    ]
    assert not any(keeps_self_motions(problem, 1) for problem in (heavy, moving, known))
