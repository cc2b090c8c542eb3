"""Robots that float: against Pinocchio's free flyer, a closed form in the plane, and a simulation."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import satellite as satellite_example
from baselines import Projector
from conftest import robot_data
from programs import needs_c
from scipy.integrate import solve_ivp

import orthocas as oc
from orthocas.codegen import check_c, generate_c
from orthocas.errors import InvalidValueError, MetricError, NotRedundantError, OrthocasError, RobotError
from orthocas.tools.checks import Array

PANDA = robot_data("panda_description/urdf/panda.urdf")
HOME = np.array([0.1, -0.2, 0.3, 0.2, -0.1, 0.15, 0, -0.6, 0, -2.1, 0, 1.5, 0.78])
# satellite, two links and a reaction wheel in the plane; the arm is hinged at the satellite's centre of mass
MASSES = {"satellite": 20.0, "link1": 3.0, "link2": 2.0, "wheel": 2.0}  # [kg]
INERTIAS = {"satellite": 1.5, "link1": 0.25, "link2": 0.15, "wheel": 0.2}  # [kg m^2]
CENTRES = {"satellite": (0.0, 0.0), "link1": (0.5, 0.0), "link2": (1.0, 0.4), "wheel": (0.0, 0.0)}  # along u_1, u_2 [m]
TIP = np.array([1.0, 0.8])
AFLOAT = np.array([0, 0, 0, 0.4, 0.9, 0.2])


def joint(name: str, parent: str, child: str, x: float, kind: str = "continuous") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 0"/><axis xyz="0 0 1"/>'
    return f'<joint name="{name}" type="{kind}">{ends}</joint>'


@pytest.fixture(scope="module")
def satellite(tmp_path_factory: pytest.TempPathFactory) -> oc.Robot:
    links = []
    for name, mass in MASSES.items():
        lever, about = CENTRES[name][1] if name == "link2" else CENTRES[name][0], INERTIAS[name]
        inertia = f'<inertia ixx="{about}" iyy="{about}" izz="{about}" ixy="0" ixz="0" iyz="0"/>'
        body = f'<inertial><origin xyz="{lever} 0 0"/><mass value="{mass}"/>{inertia}</inertial>'
        links.append(f'<link name="{name}">{body}</link>')
    joints = [joint("a1", "satellite", "link1", 0), joint("a2", "link1", "link2", 1)]
    joints += [joint("w", "satellite", "wheel", 0), joint("t", "link2", "tip", 0.8, "fixed")]
    path = tmp_path_factory.mktemp("urdf") / "satellite.urdf"
    path.write_text(f'<robot name="s">{"".join(links)}<link name="tip"/>{"".join(joints)}</robot>', encoding="utf-8")
    return oc.Robot.from_urdf(path, tips=["tip", "wheel"], base="floating:xy")


@pytest.fixture(scope="module")
def arm() -> oc.Robot:
    return oc.Robot.from_urdf(PANDA, tip="panda_hand", base="floating")


@pytest.fixture(scope="module")
def chart(arm: oc.Robot) -> oc.Chart:
    problem = oc.Problem(arm, oc.Task.position(arm), "inertia", oc.Box(HOME, 0.3, unbounded=range(6)))
    return oc.fit(problem, oc.Polynomial(2)).chart


@pytest.fixture(scope="module")
def linear(arm: oc.Robot) -> oc.Chart:
    problem = oc.Problem(arm, oc.Task.position(arm), "inertia", oc.Box(HOME, 0.2))
    return oc.fit(problem, oc.Polynomial(1), samples=200, weights=oc.Weights(folds=0)).chart


class FreeFlyer:
    """Pinocchio's Panda on a free flyer, whose velocities are in axes of the base."""

    def __init__(self) -> None:
        model = pin.buildModelFromUrdf(str(PANDA), pin.JointModelFreeFlyer())
        fingers = [model.getJointId(f"panda_finger_joint{k}") for k in (1, 2)]
        self.model = pin.buildReducedModel(model, fingers, pin.neutral(model))
        self.data = self.model.createData()

    def at(self, q: Array) -> tuple[Array, Array]:
        """Configuration, and the velocities of the flyer per velocities of our joints, (13, 13)."""
        turned = [pin.utils.rotate(axis, angle) for axis, angle in zip("zyx", q[3:6], strict=True)]
        R = turned[0] @ turned[1] @ turned[2]
        across = np.eye(13)
        across[:3, :3] = R.T
        axes = [np.array([0, 0, 1.0]), turned[0][:, 1], (turned[0] @ turned[1])[:, 0]]  # in the world
        across[3:6, 3:6] = R.T @ np.transpose(axes)
        return np.concatenate([q[:3], pin.Quaternion(R).coeffs(), q[6:]]), across

    def mass_matrix(self, q: Array) -> Array:
        M = pin.crba(self.model, self.data, self.at(q)[0])
        return np.asarray(np.triu(M) + np.triu(M, 1).T)

    def generalised(self, q: Array) -> tuple[Array, Array]:
        """Generalised Jacobian of the hand (6, 7) in axes of the world, and inertia (7, 7)."""
        M, frame = self.mass_matrix(q), self.model.getFrameId("panda_hand")
        whole = self.at(q)[0]
        J = pin.computeFrameJacobian(self.model, self.data, whole, frame, pin.LOCAL_WORLD_ALIGNED)
        follows = np.linalg.solve(M[:6, :6], M[:6, 6:])
        return J[:, 6:] - J[:, :6] @ follows, M[6:, 6:] - M[6:, :6] @ follows


def test_floating_base_is_the_free_flyer_of_pinocchio(arm: oc.Robot) -> None:
    """Pose of the hand, inertia with the links of the base, no gravity, and no momentum in motions of H."""
    flyer = FreeFlyer()
    assert arm.tree.floating == tuple(range(6))
    for q in np.random.default_rng(0).uniform(-1, 1, (5, arm.n)):
        whole, across = flyer.at(q)
        pin.framesForwardKinematics(flyer.model, flyer.data, whole)
        pose = flyer.data.oMf[flyer.model.getFrameId("panda_hand")]
        np.testing.assert_allclose(arm.tip_position(q), pose.translation, atol=1e-12)
        np.testing.assert_allclose(arm.tip_rotation(q), pose.rotation, atol=1e-12)
        np.testing.assert_allclose(arm.mass_matrix(q), across.T @ flyer.mass_matrix(q) @ across, atol=1e-11)
        np.testing.assert_array_equal(arm.gravity(q), 0)
        H = arm.zero_momentum(q)
        map_ = pin.computeCentroidalMap(flyer.model, flyer.data, whole)
        np.testing.assert_allclose(map_ @ across @ H, 0, atol=1e-11)
        J, inertia = flyer.generalised(q)
        np.testing.assert_allclose(arm.tip_jacobian(q) @ H, J, atol=1e-11)
        np.testing.assert_allclose(H.T @ arm.mass_matrix(q) @ H, inertia, atol=1e-11)


def in_the_plane(q: Array) -> tuple[Array, Array]:
    """Generalised Jacobian of the tip (2, 3) and inertia (3, 3), by hand.

    With absolute angles alpha, unit vectors u_1, u_2 along the links, and centres of mass c_i = a_i1 u_1 + a_i2 u_2
    from the satellite's, the energy without that of the common centre of mass is that of
    E = diag(I_i) + sum m_i (a_i - a)(a_i - a)^T cos(alpha_k - alpha_l), and the angular momentum is 1^T E dalpha.
    """
    m, a = np.array([*MASSES.values()]), np.array([*CENTRES.values()])
    middle = m @ a / m.sum()
    W = (a - middle).T @ np.diag(m) @ (a - middle)
    first, second = q[2] + q[3], q[2] + q[3] + q[4]
    E = np.diag([*INERTIAS.values()])
    E[1:3, 1:3] += W * [[1, np.cos(first - second)], [np.cos(first - second), 1]]
    relative = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 1]])  # dalpha of satellite, links, wheel, per joint
    whole = relative - np.ones((4, 1)) @ (np.ones((1, 4)) @ E @ relative) / E.sum()  # 1^T E dalpha = 0
    across = np.array([[-np.sin(first), -np.sin(second)], [np.cos(first), np.cos(second)]])
    return (across * (TIP - middle)) @ whole[1:3], whole.T @ E @ whole


def test_generalised_jacobian_in_the_plane_is_that_by_hand(satellite: oc.Robot) -> None:
    for q in np.random.default_rng(1).uniform(-2, 2, (8, 6)):
        H, (J, inertia) = satellite.zero_momentum(q), in_the_plane(q)
        np.testing.assert_allclose(satellite.tip_jacobian(q)[:2] @ H, J, atol=1e-12)
        np.testing.assert_allclose(H.T @ satellite.mass_matrix(q) @ H, inertia, atol=1e-12)


@pytest.mark.slow
def test_coordinate_of_the_satellite_in_the_plane_is_its_wheel(satellite: oc.Robot) -> None:
    """E couples neither satellite nor wheel to the links, so the wheel's angle to the satellite is orthogonal to both.

    Though the wheel moves the tip if the joints of the arm stand still.
    """
    problem = oc.Problem(satellite, oc.Task.position(satellite, "xy"), "inertia", oc.Box(AFLOAT, 0.4))
    fit = oc.fit(problem, oc.Polynomial(2))
    assert fit.idle_joints == ()
    assert np.abs((satellite.tip_jacobian(AFLOAT) @ satellite.zero_momentum(AFLOAT))[:2, 2]).min() > 0.01
    for q in problem.domain.centre + 0.4 * np.random.default_rng(2).uniform(-1, 1, (5, 6)):
        J, inertia = in_the_plane(q)
        xi = fit.chart.jacobian(q)[2]
        np.testing.assert_allclose(J @ np.linalg.solve(inertia, xi[3:]), 0, atol=1e-6)
        np.testing.assert_allclose(xi, [0, 0, 0, 0, 0, 1], atol=1e-6)
    assert oc.evaluate(fit.chart, samples=500).conditioning.min > 0.999


def test_torque_of_the_wheel_leaves_the_tip_and_the_momentum(satellite: oc.Robot) -> None:
    """The forward dynamics of all joints, with no torque at base and arm."""
    torque = np.array([0, 0, 0, 0, 0, 0.5])

    def motion(_: float, state: Array) -> Array:
        q, dq = state[:6], state[6:]
        return np.concatenate([dq, satellite.forward_dynamics(q, dq, torque)])

    found = solve_ivp(motion, (0, 2), [*AFLOAT, *np.zeros(6)], rtol=1e-10, atol=1e-12, t_eval=np.linspace(0, 2, 20))
    q, dq = found.y[:6].T, found.y[6:].T
    assert q[-1, 2] < -0.5  # the satellite turns the other way
    np.testing.assert_allclose(
        satellite.tip_position(q)[:, :2], np.tile(satellite.tip_position(AFLOAT)[:2], (20, 1)), atol=1e-8
    )
    np.testing.assert_allclose((satellite.mass_matrix(q) @ dq[:, :, None])[:, :3], 0, atol=1e-8)


@pytest.mark.slow
def test_leaks_are_those_of_pinocchio_wherever_the_base_is(chart: oc.Chart) -> None:
    """sin(leak) = |Pi grad xi| / |grad xi|, by Pinocchio's generalised Jacobian and inertia and finite differences."""
    flyer, rng, step = FreeFlyer(), np.random.default_rng(3), 1e-6
    for _ in range(5):
        q = HOME + 0.3 * rng.uniform(-1, 1, 13)
        moved = np.concatenate([rng.uniform(-3, 3, 4), rng.uniform(-1, 1, 2), q[6:]])
        np.testing.assert_array_equal(chart.xi(moved)[:4], chart.xi(q)[:4])
        slopes = [(chart.xi(moved + step * e) - chart.xi(moved - step * e)) / (2 * step) for e in np.eye(13)[6:]]
        gradients = np.transpose(slopes)[:4]
        J, inertia = flyer.generalised(moved)
        J = J[:3]
        raised = np.linalg.solve(inertia, gradients.T)
        along = np.linalg.solve(np.linalg.cholesky(J @ np.linalg.solve(inertia, J.T)), J @ raised)
        sines = np.linalg.norm(along, axis=0) / np.sqrt(np.einsum("ki,ik->k", gradients, raised))
        np.testing.assert_allclose(chart.quality(moved).leak_deg[:4], np.degrees(np.arcsin(sines)), atol=1e-4)


@pytest.mark.slow
def test_inverse_finds_the_arm_for_any_place_of_the_base(chart: oc.Chart, tmp_path: Path) -> None:
    """And so does the chart of a file, whose robot floats as well."""
    chart.save(tmp_path / "c.orthocas")
    loaded = oc.load(tmp_path / "c.orthocas")
    assert loaded.problem.robot.tree.floating == tuple(range(6))
    far = HOME + np.array([5.0, 3, -2, 1, 0.2, -0.3, *np.full(7, 0.05)])
    start = np.concatenate([far[:6], HOME[6:]])
    np.testing.assert_allclose(loaded.inverse(chart.phi(far), start), far, atol=1e-8)


@needs_c
@pytest.mark.slow
def test_c_of_a_chart_that_floats_equals_python(satellite: oc.Robot, tmp_path: Path) -> None:
    problem = oc.Problem(satellite, oc.Task.position(satellite, "xy"), "inertia", oc.Box(AFLOAT, 0.4))
    chart = oc.fit(problem, oc.Polynomial(1), samples=200).chart
    proof = check_c(generate_c(chart, tmp_path, None, "afloat"), chart)
    assert {"phi", "jacobian", "inverse"} <= {*proof.differences}
    assert max(proof.differences.values()) < 1e-11


@pytest.mark.parametrize(
    ("call", "error", "reason"),
    [
        (lambda chart: oc.control.PDPlus(chart, stiffness=10.0), RobotError, "pd_plus needs driven joints"),
        (oc.control.Kinematic, RobotError, "no motor drives a floating base"),
        (lambda chart: Projector(chart.problem, 10.0, 1.0), RobotError, "Robot.zero_momentum"),
        (lambda chart: oc.follow(chart, np.zeros((2, 3))), RobotError, "following a path needs"),
        (oc.certify, RobotError, "a certificate needs"),
        (lambda chart: oc.involutivity(chart.problem), RobotError, "involutivity needs"),
        (lambda chart: oc.grow(chart.problem), RobotError, "growing needs"),
        (lambda chart: oc.suggest_domain(chart.problem.robot, chart.problem.task), RobotError, "suggesting a domain"),
        (lambda chart: oc.fit(chart.problem, oc.Linear()), InvalidValueError, "such as Polynomial"),
        (lambda chart: oc.fit(chart.problem, split_idle=False), InvalidValueError, "the base floats"),
        (lambda chart: oc.fit(chart.problem, like="float_x"), InvalidValueError, "a floating base moves"),
        (
            lambda chart: oc.fit(chart.problem, oc.Mobile(oc.Polynomial(2))),
            InvalidValueError,
            "one of the joints float_x",
        ),
        (lambda chart: oc.Problem(chart.problem.robot, chart.problem.task), MetricError, "expected 'inertia'"),
    ],
)
def test_what_needs_a_driven_base_is_refused(
    linear: oc.Chart, call: Callable[[oc.Chart], object], error: type[OrthocasError], reason: str
) -> None:
    with pytest.raises(error, match=reason):
        call(linear)


@pytest.mark.slow
def test_hand_stays_while_the_satellite_turns(tmp_path: Path) -> None:
    found = satellite_example.main(tmp_path, quick=True)
    assert found["hand_off_mm"] < 1
    assert found["hand_off_at_the_end_mm"] < 1e-3
    assert found["xi_left"] < 1e-4
    assert found["satellite_turned_deg"] > 0.3
    assert found["momentum"] < 1e-6
    assert (tmp_path / "satellite.png").stat().st_size > 10_000


def test_arm_without_redundancy_and_fixed_base_are_refused(satellite: oc.Robot) -> None:
    task = oc.Task.stack(oc.Task.position(satellite, "xy"), oc.Task.axis(satellite, "x"))
    with pytest.raises(NotRedundantError, match="3"):
        oc.Problem(satellite, task, "inertia", oc.Box(AFLOAT, 0.2))
    with pytest.raises(RobotError, match="does not float"):
        oc.Robot.from_urdf(PANDA).zero_momentum(np.zeros(7))
