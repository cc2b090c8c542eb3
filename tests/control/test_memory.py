"""Laws that remember: momentum and regressors against Pinocchio, wrong models, C against Python, users' memories."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from programs import Run, needs_c, nightly
from supervised import TICK, Arm
from test_payload import arm_model

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared, gain_numbers
from orthocas.control import (
    Adaptation,
    ControlStatus,
    FrictionObserver,
    Memory,
    MomentumObserver,
    PDPlus,
    Remembering,
    RunTimeModel,
    Safety,
)
from orthocas.control.memory import _build_momentum, _build_regressor
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.tools.checks import Array

BOTH = [MomentumObserver(), Adaptation()]
ALL = [*BOTH, FrictionObserver()]


@pytest.fixture(scope="module")
def chart() -> oc.Chart:
    known = oc.problems.get("planar_3r_xy")
    problem = oc.Problem(known.robot, known.task, metric="inertia", domain=known.domain)
    return oc.fit(problem, oc.Polynomial(2), samples=300).chart


def law_of(chart: oc.Chart, remembers: Any, **settings: Any) -> PDPlus:
    return PDPlus(chart, 200.0, limit=400.0, remembers=remembers, **settings)


def at_rest(chart: oc.Chart, q: Array) -> Array:
    return np.array([chart.phi(q), 0 * q, 0 * q])


def held(ticks: Remembering, robot: oc.Robot, q: Array, count: int, push: float = 0.0) -> tuple[Array, Array]:
    """Joint positions after ticks at rest, and what the memory corrects."""
    chart: Any = ticks._controller.chart
    wanted, arm = at_rest(chart, q), Arm(robot, q)
    for _ in range(count):
        command, status = ticks.tick(arm.q, arm.dq, wanted, TICK)
        assert status == ControlStatus.OK
        arm.move(command + push, steps=1)
    return arm.q, ticks.fields["correction"]


@pytest.mark.slow
def test_momentum_and_its_rate_are_pinocchios() -> None:
    """C^T dq = dM/dt dq - C dq; Pinocchio's C has the same skew symmetry."""
    model, rng = arm_model(), np.random.default_rng(1)
    data, tree = model.createData(), oc.problems.get("iiwa").robot.tree
    for _ in range(5):
        q, dq = rng.uniform(-1, 1, (2, 7))
        M, C = pin.crba(model, data, q).copy(), pin.computeCoriolisMatrix(model, data, q, dq).copy()
        M = np.triu(M) + np.triu(M, 1).T
        p, rate = (out.full().ravel() for out in _build_momentum(tree, False, True)(q, dq))
        np.testing.assert_allclose(p, M @ dq, atol=1e-12)
        np.testing.assert_allclose(rate, C.T @ dq - pin.computeGeneralizedGravity(model, data, q), atol=1e-11)
        np.testing.assert_allclose(_build_momentum(tree, False, False)(q, dq)[1].full().ravel(), C.T @ dq, atol=1e-11)


def test_regressor_of_first_moments_is_pinocchios() -> None:
    """But for the axes of bodies: ours have z along the joint."""
    model, rng = arm_model(), np.random.default_rng(2)
    data = model.createData()
    regressor, joints = _build_regressor(oc.problems.get("iiwa").robot.tree)
    assert joints == tuple(np.repeat(range(7), 2))
    states = rng.uniform(-1, 1, (6, 3, 7))
    theirs = np.vstack([pin.computeJointTorqueRegressor(model, data, *state).reshape(7, 7, 10) for state in states])
    ours = np.vstack([regressor(q, dq, dq, a).full() for q, dq, a in states])
    for joint in range(7):
        moments = theirs[:, joint, 1:4]  # after the mass, before the inertia about the frame
        turn, *_ = np.linalg.lstsq(moments, ours[:, 2 * joint : 2 * joint + 2], rcond=1e-9)
        np.testing.assert_allclose(moments @ turn, ours[:, 2 * joint : 2 * joint + 2], atol=1e-9)
        if joint > 0:  # gravity does not act on the first moment of a body that turns about a vertical axis
            np.testing.assert_allclose(turn.T @ turn, np.eye(2), atol=1e-9)


def test_regressor_is_bilinear_in_its_two_velocities() -> None:
    """C(q, u + v)(u + v) = C(q, u) u + C(q, v) v + 2 C(q, u) v."""
    regressor, _ = _build_regressor(oc.problems.get("iiwa").robot.tree)
    q, u, v = np.random.default_rng(3).uniform(-1, 1, (3, 7))

    def turned(a: Array, b: Array) -> Array:
        return np.asarray(regressor(q, a, b, 0 * q).full() - regressor(q, 0 * q, 0 * q, 0 * q).full())

    np.testing.assert_allclose(turned(u + v, u + v), turned(u, u) + turned(v, v) + 2 * turned(u, v), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("remembers", BOTH, ids=lambda kind: kind.name)
def test_the_sag_of_a_wrong_model_goes(chart: oc.Chart, remembers: Any) -> None:
    q, heavy = chart.problem.domain.centre, chart.problem.robot.with_scaled_masses(1.4)
    still = PDPlus(chart, 200.0, limit=400.0)
    stiff = chart.jacobian(q).T @ np.diag(still.stiffness) @ chart.jacobian(q)
    sag = np.linalg.solve(stiff, heavy.gravity(q) - chart.problem.robot.gravity(q))
    assert np.abs(sag).max() > 0.02  # rad
    x, correction = held(Remembering(law_of(chart, remembers)), heavy, q, 4000)
    assert np.abs(x - q).max() < 1e-3
    np.testing.assert_allclose(correction, heavy.gravity(x) - chart.problem.robot.gravity(x), atol=0.5)


@pytest.mark.slow
def test_an_observer_finds_an_unknown_torque_with_its_time_constant(chart: oc.Chart) -> None:
    q, robot = chart.problem.domain.centre, chart.problem.robot
    ticks = Remembering(law_of(chart, MomentumObserver(rate=10.0)))
    _, correction = held(ticks, robot, q, 101, push=5.0)
    np.testing.assert_allclose(-correction, 5.0 * (1 - np.exp(-1.0)), rtol=0.01)
    _, correction = held(Remembering(law_of(chart, MomentumObserver(rate=10.0))), robot, q, 2000, push=5.0)
    np.testing.assert_allclose(-correction, 5.0, rtol=1e-3)


@pytest.mark.slow
def test_torque_that_was_asked_for_is_not_taken_for_a_disturbance(chart: oc.Chart) -> None:
    """Friction compensation of the user's own: the joints feel -3 N m, and the law adds 3."""
    law = law_of(chart, MomentumObserver(), model=RunTimeModel(extra_torque=3.0))
    _, correction = held(Remembering(law), chart.problem.robot, chart.problem.domain.centre, 1000, push=-3.0)
    np.testing.assert_allclose(correction, 0.0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("remembers", ALL, ids=lambda kind: kind.name)
def test_a_start_knows_the_torque_that_held_the_arm(chart: oc.Chart, remembers: Any) -> None:
    q, heavy = chart.problem.domain.centre, chart.problem.robot.with_scaled_masses(1.4)
    ticks = Remembering(law_of(chart, remembers))
    ticks.start(q, heavy.gravity(q))
    x, _ = held(ticks, heavy, q, 500)
    np.testing.assert_allclose(x, q, atol=1e-4)


@needs_c
@pytest.mark.slow
@pytest.mark.parametrize("blind", [0, 15], ids=["at once", "after ticks without measurements"])
def test_a_payload_and_torques_of_the_gains_do_not_count_twice_at_a_start(
    chart: oc.Chart, tmp_path: Path, blind: int
) -> None:
    """They are part of the command that held the arm, and the law adds them itself."""
    q, robot, extra = chart.problem.domain.centre, chart.problem.robot.with_payload(1.0), np.array([3.0, -2.0, 1.0])
    plain, known = (
        law_of(chart, MomentumObserver(), model=RunTimeModel(payload=mass, extra_torque=share * extra))
        for mass, share in ((0.0, 0.0), (1.0, 1.0))
    )
    ticks = Remembering(known)
    ticks.start(q, robot.gravity(q) + extra)
    np.testing.assert_allclose(ticks.fields["correction"], 0, atol=1e-9)
    generated = oc.generate_c(chart, tmp_path, plain, "arm")
    supervisor = Supervisor(CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3), plain)
    supervisor.gains = gain_numbers(known)
    unknown = np.array([0.5, 0.4, -0.3])
    supervisor.start(q, robot.gravity(q) + extra + unknown)
    for _ in range(blind):
        supervisor.step(q + np.nan, 0 * q, at_rest(chart, q).ravel(), TICK)
    supervisor.step(q, 0 * q, at_rest(chart, q).ravel(), TICK)
    np.testing.assert_allclose(supervisor.memory["correction"], unknown, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("remembers", ALL, ids=lambda kind: kind.name)
def test_corrections_keep_their_bound_and_forget_nonsense(chart: oc.Chart, remembers: Any) -> None:
    law = law_of(chart, replace(remembers, bound=2.0))
    ticks, q = Remembering(law), chart.problem.domain.centre
    arm, wanted = Arm(chart.problem.robot.with_scaled_masses(1.4), q), at_rest(chart, q)
    for _ in range(1500):
        command, _ = ticks.tick(arm.q, arm.dq, wanted, TICK)
        arm.move(command, steps=1)
    x = arm.q
    assert np.abs(ticks.fields["correction"]).max() == 2.0
    ticks.tick(x, np.full(3, 1e200), wanted, TICK)
    ticks.tick(x, np.zeros(3), 1e200 * wanted, TICK)
    ticks.tick(x, np.zeros(3), wanted, TICK)
    assert all(np.isfinite(value).all() for value in ticks.fields.values())
    assert np.abs(ticks.fields["correction"]).max() <= 2.0


@needs_c
@pytest.mark.slow
@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
@pytest.mark.parametrize("remembers", ALL, ids=lambda kind: kind.name)
def test_c_remembers_what_python_remembers(chart: oc.Chart, tmp_path: Path, remembers: Any, single: bool) -> None:
    law = law_of(chart, remembers)
    generated = oc.generate_c(chart, tmp_path, law, "arm", single_precision=single)
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3, single)
    supervisor = Supervisor(library, law, Safety.of(law, command_rate=np.inf))
    q, robot = chart.problem.domain.centre, chart.problem.robot.with_scaled_masses(1.4)
    ticks, wanted, arm = Remembering(law), at_rest(chart, q), Arm(robot, q)
    supervisor.take_over(q, chart.problem.robot.gravity(q))
    for k in range(1000):
        if k == 500:  # a measurement is missing: the arm is held, and Python's observer begins again where it was
            supervisor.step(np.full(3, np.nan), arm.dq, wanted.ravel(), TICK)
            ticks._fresh = True
        command, status = supervisor.step(arm.q, arm.dq, wanted.ravel(), TICK)
        there, _ = ticks.tick(arm.q, arm.dq, wanted, TICK)
        assert status in (ControlStatus.OK, ControlStatus.SATURATED)
        np.testing.assert_allclose(command, there, atol=2e-2 if single else 1e-9)
        np.testing.assert_allclose(
            supervisor.memory["correction"], ticks.fields["correction"], atol=2e-2 if single else 1e-9
        )
        arm.move(command, steps=1)
    x = arm.q
    assert np.abs(supervisor.memory["correction"]).max() > 1.0
    supervisor.hold(x)
    assert not supervisor.memory["correction"].any()  # a load may have gone when brakes open again
    supervisor.start(x, robot.gravity(x))
    supervisor.step(x, 0 * x, at_rest(chart, x).ravel(), TICK)
    lacks = robot.gravity(x) - chart.problem.robot.gravity(x)
    np.testing.assert_allclose(supervisor.memory["correction"], lacks, atol=1e-4)


@needs_c
@pytest.mark.slow
def test_the_catcher_holds_a_heavier_arm_with_what_is_known_of_it(chart: oc.Chart, tmp_path: Path) -> None:
    """Also if it takes over at once. Without a memory, it learns the load from the start on, and sags meanwhile."""
    q, heavy = chart.problem.domain.centre, chart.problem.robot.with_scaled_masses(1.2)
    lacks, away = heavy.gravity(q) - chart.problem.robot.gravity(q), {}
    for name, remembers in (("none", None), ("momentum", MomentumObserver())):
        law = law_of(chart, remembers)
        library = compile_shared(oc.generate_c(chart, tmp_path / name, law, "arm"), tmp_path / name)
        supervisor = Supervisor(CompiledLibrary(library, "arm", 3), law)
        arm, wanted = Arm(heavy, q), at_rest(chart, q).ravel()
        supervisor.start(q, heavy.gravity(q))
        supervisor.step(q, 0 * q, wanted, TICK)
        supervisor.step(q, 0 * q, wanted, 1.0)  # late: caught
        places = []
        for _ in range(3000):
            command, status = supervisor.step(arm.q, arm.dq, wanted, TICK)
            assert status == ControlStatus.CAUGHT
            arm.move(command, steps=1)
            places.append(np.abs(arm.q - q).max())
        np.testing.assert_allclose(supervisor.load, lacks, rtol=0.02)
        assert places[-1] < 1e-3
        away[name] = max(places)
    assert away["momentum"] < 1e-3 < away["none"] / 5, away


@pytest.mark.slow
@pytest.mark.parametrize("plant", ["cvodes", "mujoco"])
def test_simulations_in_ticks_remember(chart: oc.Chart, plant: str) -> None:
    q, heavy = chart.problem.domain.centre, chart.problem.robot.with_scaled_masses(1.2)
    if plant == "mujoco":
        pytest.importorskip("mujoco")
    body: Any = heavy if plant == "cvodes" else oc.simulation.MuJoCo(heavy)
    reference = oc.control.Reference.steps(chart.labels, chart.phi(q), [], 2.0)
    errors = {}
    for name, remembers in (("none", None), ("momentum", MomentumObserver())):
        run = oc.simulate(law_of(chart, remembers), reference, q, control_rate=500.0, plant=body)
        errors[name] = np.abs(run.value[-1] - run.reference[-1]).max()
    assert errors["momentum"] < 1e-3 < errors["none"]


@dataclass(frozen=True)
class Leaky:
    """A memory of a user's own: the torque of a leaky integral of xi's error."""

    name: ClassVar[str] = "leaky"

    def of(self, law: Any) -> Memory:
        sizes = {"q": 3, "dq": 3, "reference": 3, "reference_velocity": 3, "reference_acceleration": 3}
        sizes |= {name: len(value) for name, value in law.gains.items()} | {"command": 3, "active": 1, "period": 1}
        inputs = {name: ca.MX.sym(name, size) for name, size in sizes.items()} | {"sum": ca.MX.sym("sum", 3)}
        e = inputs["reference"] - law.measured(inputs["q"])
        found = 0.999 * inputs["sum"] + inputs["active"] * inputs["period"] * 100 * e
        step = ca.Function("step", list(inputs.values()), [found], list(inputs), ["next_sum"])
        return Memory({"sum": np.zeros(3)}, {"extra_torque": "sum"}, step)


@needs_c
@pytest.mark.slow
def test_a_memory_of_a_users_own_runs_in_python_and_c(chart: oc.Chart, tmp_path: Path) -> None:
    law = law_of(chart, Leaky())
    library = compile_shared(oc.generate_c(chart, tmp_path, law, "arm"), tmp_path)
    supervisor, ticks = Supervisor(CompiledLibrary(library, "arm", 3), law), Remembering(law)
    q = chart.problem.domain.centre
    supervisor.take_over(q, chart.problem.robot.gravity(q))
    for k in range(200):
        x = q + 0.01 * np.sin(0.02 * k)
        supervisor.step(x, np.full(3, 1e-3 * (k % 2)), at_rest(chart, q).ravel(), TICK)
        ticks.tick(x, np.full(3, 1e-3 * (k % 2)), at_rest(chart, q), TICK)
    assert np.abs(ticks.fields["sum"]).max() > 1e-3
    np.testing.assert_allclose(supervisor.memory["sum"], ticks.fields["sum"], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("stiffness", "ratio"), [(8.0, 0.7), *nightly((20.0, 0.7), (50.0, 0.3))])
def test_adaptation_does_not_make_soft_laws_swing(chart: oc.Chart, stiffness: float, ratio: float) -> None:
    """With an exact model; a weight of the error of 5 1/s did, for such springs."""
    law = PDPlus(chart, stiffness, ratio, limit=400.0, remembers=Adaptation())
    ticks, q, period = Remembering(law), chart.problem.domain.centre, 2e-3
    wanted, arm = at_rest(chart, q), Arm(chart.problem.robot, q + 0.05)
    away = []
    for _ in range(5000):
        command, _ = ticks.tick(arm.q, arm.dq, wanted, period)
        arm.move(command, period, steps=1)
        away.append(np.abs(arm.q - q).max())
    assert max(away[4000:]) < 0.5 * max(away[:1000])


def test_memories_that_do_not_fit_are_refused(chart: oc.Chart) -> None:
    @dataclass(frozen=True)
    class Odd(Leaky):
        gain: str = "stiffness"
        size: int = 1
        field: str = "sum"

        def of(self, law: Any) -> Memory:
            sizes = {"q": 3, "dq": 3, "reference": 3, "reference_velocity": 3, "reference_acceleration": 3}
            sizes |= {name: len(value) for name, value in law.gains.items()} | {"command": 3, "active": 1, "period": 1}
            inputs = {name: ca.MX.sym(name, size) for name, size in sizes.items()}
            inputs[self.field] = ca.MX.sym(self.field, self.size)
            step = ca.Function("step", [*inputs.values()], [inputs[self.field]], [*inputs], [f"next_{self.field}"])
            return Memory({self.field: np.zeros(self.size)}, {self.gain: self.field}, step)

    law_of(chart, Odd(size=3))
    for odd, words in ((Odd(), "size of its gain"), (Odd("limit", 3), "not the limit"), (Odd(field="Sum"), "for C")):
        with pytest.raises(InvalidValueError, match=words):
            law_of(chart, odd)
    step = law_of(chart, MomentumObserver()).memory.step  # type: ignore[union-attr]
    start = {name: np.full(3, np.nan) for name in ("expected", "drive", "correction")}
    with pytest.raises(InvalidValueError, match="finite"):
        Memory(start, {}, step)


def test_what_cannot_be_remembered_is_refused(chart: oc.Chart) -> None:
    law, q = law_of(chart, MomentumObserver()), chart.problem.domain.centre
    reference = oc.control.Reference.steps(chart.labels, chart.phi(q), [], 0.1)
    with pytest.raises(InvalidValueError, match="control_rate is None, expected a rate"):
        oc.simulate(law, reference, q)
    with pytest.raises(InvalidValueError, match="compiled is True, expected False"):
        oc.simulate(law, reference, q, control_rate=500.0, compiled=True)
    with pytest.raises(InvalidValueError, match="model of the law is extra_torque"):
        oc.export(law, "torch", "law.py")
    with pytest.raises(InvalidValueError, match="given, expected own"):
        law_of(chart, Adaptation(), model=RunTimeModel("given"))
    with pytest.raises(InvalidValueError, match="a finite limit"):
        PDPlus(chart, 200.0, limit=np.inf, remembers=MomentumObserver())
    with pytest.raises(ShapeError, match="bound"):
        law_of(chart, MomentumObserver(bound=[1.0, 2.0]))
    with pytest.raises(InvalidValueError, match="rate is 0"):
        MomentumObserver(rate=0.0)
    with pytest.raises(InvalidValueError, match="remembers is 3"):
        law_of(chart, 3)
    with pytest.raises(InvalidValueError, match="controller is a str"):
        Remembering("momentum")  # type: ignore[arg-type]
    memory = law.memory
    assert memory is not None
    with pytest.raises(InvalidValueError, match="outputs and last inputs"):
        Memory({"sum": np.zeros(3)}, {}, memory.step)
    with pytest.raises(InvalidValueError, match="adds is other to extra_torque"):
        Memory(memory.start, {"extra_torque": "other"}, memory.step)


@pytest.mark.slow
def test_python_of_the_page_runs(capsys: pytest.CaptureFixture[str]) -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "wrong_model.md").read_text()
    exec(re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)[0], {})
    assert float(capsys.readouterr().out) < 1e-3


@needs_c
@pytest.mark.slow
def test_commands_give_laws_a_memory(chart: oc.Chart, run: Run) -> None:
    chart.save("arm.orthocas")
    words = ("--controller", "pd_plus", "--memory", "momentum")
    code, _, err = run("codegen", "arm.orthocas", *words, "--limit", "400", "--out", "c", "--check")
    assert code == 0, err
    assert "double correction[3];" in next(Path("c").glob("*.h")).read_text()
    code, _, err = run("codegen", "arm.orthocas", *words[:3], "elephant", "--limit", "400", "--out", "d")
    assert (code, "elephant" in err, "adaptive" in err) == (2, True, True)
