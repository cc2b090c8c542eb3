"""Laws that learn of the robot at run time, against the paper's formulas with Pinocchio's matrices."""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from programs import needs_c, nightly
from test_controllers import State, by_hand, called, torque
from test_payload import arm_model, loaded, random_payload

import orthocas as oc
from orthocas.codegen import check_c
from orthocas.control import ControlStatus, Impedance, PDPlus, RunTimeModel, matched_stiffness
from orthocas.errors import InvalidValueError, ShapeError, UnknownNameError
from orthocas.tools.checks import Array

K, Z = np.linspace(10, 200, 7), np.linspace(0.3, 1.0, 7)
ONE_BLOCK = [slice(0, 7)]


@pytest.fixture(scope="module")
def arm_chart() -> oc.Chart:
    return oc.fit(oc.problems.get("iiwa"), oc.Polynomial(2)).chart


@pytest.mark.slow
@pytest.mark.parametrize("law", [Impedance, PDPlus])
def test_payload_acts_on_inertia_coriolis_forces_and_gravity(arm_chart: oc.Chart, law: Any) -> None:
    """The law with a payload equals the formulas of the paper with Pinocchio's model that carries the body."""
    rng = np.random.default_rng(4)
    controller = law(arm_chart, K, Z, damping="square_root", model=RunTimeModel(payload=0.0))
    for _ in range(3):
        payload = random_payload(rng)
        s = State.random(arm_chart, loaded(arm_model(), payload, "link_ee"))
        want = by_hand(arm_chart, s, K, Z, ONE_BLOCK, law is PDPlus)
        found, _ = torque(
            controller, s.q, s.dq, s.phi_d, s.dphi_d, s.ddphi_d, payload=payload, limit=np.full(7, np.inf)
        )
        np.testing.assert_allclose(found, want, rtol=2e-7, atol=1e-6 * np.abs(want).max())


@pytest.mark.slow
def test_fallback_carries_the_payload(arm_chart: oc.Chart) -> None:
    payload = random_payload(np.random.default_rng(5))
    controller = PDPlus(arm_chart, K, limit=np.inf, model=RunTimeModel(payload=payload))
    q, zero = arm_chart.problem.domain.centre + 2.0, np.zeros(7)
    model = loaded(arm_model(), payload, "link_ee")
    want = pin.rnea(model, model.createData(), q, zero, zero)
    found, status = torque(controller, q, zero, zero, zero, zero)
    assert status == ControlStatus.OUTSIDE_DOMAIN
    np.testing.assert_allclose(found, want, atol=1e-12)
    np.testing.assert_allclose(controller.fallback(q, *controller.gains.values()).full().ravel(), want, atol=1e-12)


def given(s: State) -> dict[str, Array]:
    """What a robot would report, from Pinocchio."""
    return {"mass_matrix": s.M.ravel(), "coriolis_torque": s.C @ s.dq, "gravity_torque": s.g}


def test_given_model_replaces_the_own_one(arm_chart: oc.Chart) -> None:
    """The same impedance; a model twice as heavy is followed, whatever the problem's robot weighs."""
    names = ("mass_matrix", "gravity_torque")
    controller = Impedance(arm_chart, K, Z, damping="square_root", limit=np.inf, model=RunTimeModel("given"))
    assert tuple(controller.gains)[3:] == names
    heavy = pin.Model(arm_model())
    for body in heavy.inertias:
        body.mass *= 2
        body.inertia *= 2
    for model in (arm_model(), heavy):
        s = State.random(arm_chart, model)
        inputs = {name: value for name, value in given(s).items() if name in names}
        found, _ = torque(controller, s.q, s.dq, s.phi_d, s.dphi_d, s.ddphi_d, **inputs)
        want = by_hand(arm_chart, s, K, Z, ONE_BLOCK, False)
        np.testing.assert_allclose(found, want, rtol=2e-7, atol=1e-6 * np.abs(want).max())


@pytest.mark.slow
def test_given_model_makes_the_loop_of_pd_plus_linear(arm_chart: oc.Chart) -> None:
    """M_phi dde + D de + K e = 0 on Pinocchio's dynamics; on the reference, the command is that of the own model."""
    controller = PDPlus(arm_chart, K, Z, limit=np.inf, model=RunTimeModel("given"))
    own = PDPlus(arm_chart, K, Z, limit=np.inf)
    h = 1e-6
    for _ in range(3):
        s = State.random(arm_chart, arm_model())
        tau, _ = torque(controller, s.q, s.dq, s.phi_d, s.dphi_d, s.ddphi_d, **given(s))
        ddq = np.linalg.solve(s.M, tau - s.C @ s.dq - s.g)
        J = arm_chart.jacobian(s.q)
        rate = (arm_chart.jacobian(s.q + h * s.dq) - arm_chart.jacobian(s.q - h * s.dq)) / (2 * h)
        e, de, dde = arm_chart.phi(s.q) - s.phi_d, J @ s.dq - s.dphi_d, J @ ddq + rate @ s.dq - s.ddphi_d
        M_phi = np.linalg.inv(J @ np.linalg.solve(s.M, J.T))
        D = controller.damping_matrix(s.q, K, Z).full()
        np.testing.assert_allclose(M_phi @ dde, -D @ de - K * e, atol=1e-6 * np.abs(K * e).max())
        s.dphi_d = J @ s.dq
        tau, _ = torque(controller, s.q, s.dq, s.phi_d, s.dphi_d, s.ddphi_d, **given(s))
        np.testing.assert_allclose(tau, called(own, s), atol=1e-9 * np.abs(tau).max())


@pytest.mark.slow
def test_robot_that_compensates_gravity_gets_none(arm_chart: oc.Chart) -> None:
    own = PDPlus(arm_chart, K, limit=np.inf)
    law = PDPlus(arm_chart, K, limit=np.inf, model=RunTimeModel(gravity="robot"))
    s = State.random(arm_chart, arm_model())
    np.testing.assert_allclose(called(own, s) - called(law, s), s.g, atol=1e-10)
    outside, status = torque(law, s.q + 3, s.dq, s.phi_d, s.dphi_d, s.ddphi_d)
    assert status == ControlStatus.OUTSIDE_DOMAIN
    assert not outside.any()
    assert law.settings["gravity"] == "robot"
    assert "zero torque" in law.remarks()[-1]
    assert "g(q)" in own.formula
    assert "g(q)" not in law.formula


def test_wrench_and_extra_torque_are_added_to_the_law_but_not_to_its_fallback(arm_chart: oc.Chart) -> None:
    """Virtual work of the wrench with Pinocchio's Jacobian in world axes."""
    s, model = State.random(arm_chart, arm_model()), arm_model()
    rng = np.random.default_rng(6)
    wrench, extra = rng.normal(size=6), rng.normal(size=7)
    law = Impedance(arm_chart, K, limit=np.inf, model=RunTimeModel(wrench=wrench, extra_torque=extra))
    frame = model.getFrameId("link_ee")
    J = pin.computeFrameJacobian(model, model.createData(), s.q, frame, pin.LOCAL_WORLD_ALIGNED)
    plain = Impedance(arm_chart, K, limit=np.inf)
    np.testing.assert_allclose(called(law, s) - called(plain, s), J.T @ wrench + extra, atol=1e-10)
    outside, _ = torque(law, s.q + 3, s.dq, s.phi_d, s.dphi_d, s.ddphi_d)
    np.testing.assert_allclose(outside, arm_chart.problem.robot.gravity(s.q + 3), atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("damping", ["square_root", "double_diagonal"])
def test_a_coordinate_without_a_spring_is_damped(arm_chart: oc.Chart, damping: Any) -> None:
    """With K_xi = 0, D is that of the damping stiffness, and the free coordinate comes to rest without swinging."""
    stiffness = matched_stiffness(arm_chart)
    free = np.where(np.arange(7) == 4, 0.0, stiffness)
    law = Impedance(arm_chart, free, 0.7, damping=damping, damping_stiffness=stiffness)
    q, ratios = arm_chart.problem.domain.centre, np.full(7, 0.7)
    want = Impedance(arm_chart, stiffness, 0.7, damping=damping).damping_matrix(q, stiffness, ratios).full()
    np.testing.assert_array_equal(law.damping_matrix(q, free, ratios, stiffness).full(), want)
    start = arm_chart.phi(q)
    reference = oc.control.Reference.steps(arm_chart.labels, start, [], 3.0)
    dq = np.linalg.solve(arm_chart.jacobian(q), np.eye(7)[4] * 0.5)
    run = oc.simulate(law, reference, q, dq_start=dq)
    moved = run.value[:, 4] - start[4]
    assert abs(moved[-1]) > 0.01
    assert np.abs(run.dq[-1]).max() < 1e-3
    assert np.diff(moved).min() > -0.02 * moved[-1]
    modes = law.modes(q)
    assert modes.frequencies[0] < 1e-6
    assert np.all(modes.frequencies[1:] > 0.5)


@pytest.mark.parametrize("damping", ["square_root", "double_diagonal"])
def test_a_spring_that_is_switched_off_at_run_time_leaves_the_law_valid(arm_chart: oc.Chart, damping: Any) -> None:
    law, q, zero = Impedance(arm_chart, 50.0, damping=damping), arm_chart.problem.domain.centre, np.zeros(7)
    for off in ([4], [0, 1, 2], range(7)):
        stiffness = law.stiffness.copy()
        stiffness[list(off)] = 0
        found, status = torque(law, q, zero + 0.1, arm_chart.phi(q), zero, zero, stiffness=stiffness)
        assert status == ControlStatus.OK
        assert np.isfinite(found).all()
    assert torque(law, q, zero, zero, zero, zero, stiffness=-law.stiffness)[1] == ControlStatus.SINGULAR


def test_law_without_options_has_no_further_inputs(arm_chart: oc.Chart) -> None:
    law = PDPlus(arm_chart, K)
    assert tuple(law.gains) == ("stiffness", "damping_ratio", "limit")
    every = RunTimeModel(payload=1.0, wrench=np.zeros(6), extra_torque=0.1)
    assert tuple(PDPlus(arm_chart, K, model=every).gains)[3:] == ("payload", "wrench", "extra_torque")
    bare = RunTimeModel("given", "robot")
    assert tuple(PDPlus(arm_chart, K, model=bare).gains)[3:] == ("mass_matrix", "coriolis_torque")


def test_bad_options_are_named(arm_chart: oc.Chart) -> None:
    with pytest.raises(UnknownNameError, match="source"):
        RunTimeModel("mine")  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="gravity"):
        RunTimeModel(gravity="moon")  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="payload"):
        RunTimeModel("given", payload=1.0)
    with pytest.raises(ShapeError, match="wrench"):
        RunTimeModel(wrench=np.zeros(3))
    with pytest.raises(ShapeError, match="extra_torque"):
        PDPlus(arm_chart, K, model=RunTimeModel(extra_torque=np.zeros(3)))
    with pytest.raises(InvalidValueError, match="model"):
        PDPlus(arm_chart, K, model="given")  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="stiffness"):
        PDPlus(arm_chart, 0.0)
    with pytest.raises(InvalidValueError, match="damping_stiffness"):
        PDPlus(arm_chart, 0.0, damping_stiffness=0.0)
    with pytest.raises(UnknownNameError, match="input"):
        PDPlus.on_chart(arm_chart, inputs="payload,weight")


VARIANTS: dict[str, dict[str, Any]] = {
    "all inputs": {"model": RunTimeModel(payload=1.0, wrench=np.ones(6), extra_torque=0.1)},
    "given": {"model": RunTimeModel("given", extra_torque=0.0)},
    "given, robot's gravity": {"model": RunTimeModel("given", "robot"), "coupling": "decoupled"},
    "free coordinate": {"stiffness": [50.0, 50.0, 0.0], "damping_stiffness": 50.0},
}


@pytest.mark.slow
@needs_c
@pytest.mark.parametrize(
    ("variant", "law"),
    [
        *((variant, PDPlus) for variant in VARIANTS),
        ("all inputs", Impedance),
        *nightly(*((variant, Impedance) for variant in VARIANTS if variant != "all inputs")),
    ],
)
def test_generated_c_equals_python_for_every_variant(
    planar_chart: oc.Chart, tmp_path: Path, variant: str, law: Any
) -> None:
    controller = law(planar_chart, **{"stiffness": 50.0, **VARIANTS[variant]})
    generated = oc.generate_c(planar_chart, tmp_path, controller, "arm")
    assert check_c(generated, planar_chart, controller, states=200).differences["control"] < 1e-10
    header = (tmp_path / "arm.h").read_text()
    for name in controller.gains:
        assert f"  double {name}[{len(controller.gains[name])}]; /* " in header
