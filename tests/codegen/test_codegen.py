"""Generated C: equal to Python, and what its proof finds."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from baselines import KinematicProjector, Projector
from charts import linear_on_the_torus
from conftest import ROBOTS, arm, pinocchio_position
from programs import needs_c, nightly

import orthocas as oc
from orthocas.codegen import CompiledLibrary, GeneratedC, check_c, compile_shared, gain_numbers
from orthocas.control import Controller, ControlStatus, Impedance, Kinematic, PDPlus
from orthocas.errors import AgreementError, CompileError
from orthocas.native.kernels import share_calls, share_sines
from orthocas.tasks.samples import sample_uniform

pytestmark = needs_c


Generated = tuple[GeneratedC, Controller]
#: with joints that turn, slide, turn without end, and a tree of them
KINDS = ("panda", "tiago with its prismatic torso", "double pendulum, continuous", "talos, both arms and the torso")


def laws(chart: oc.Chart) -> list[Controller]:
    return [
        Impedance(chart, 50.0, limit=90.0),
        PDPlus(chart, np.linspace(20, 80, chart.n), 0.6, "decoupled", limit=90.0),
        PDPlus(chart, 50.0, damping="double_diagonal"),
        Kinematic(chart, 1.0, limit=2.0),
        Projector(chart.problem, 80.0, 10.0, limit=90.0),
        KinematicProjector(chart.problem, 1.0, 0.5),
    ]


@pytest.fixture(scope="module")
def impedance_c(planar_chart: oc.Chart, tmp_path_factory: pytest.TempPathFactory) -> GeneratedC:
    """The first of `laws`."""
    return oc.generate_c(planar_chart, tmp_path_factory.mktemp("impedance"), laws(planar_chart)[0], "arm")


@pytest.mark.slow
def test_every_controller_equals_its_python(planar_chart: oc.Chart, tmp_path: Path) -> None:
    """Also NaN, infinities and huge numbers: same status, same fallback."""
    for law in (*laws(planar_chart), None):
        generated = oc.generate_c(planar_chart, tmp_path / law.name if law else tmp_path / "none", law)
        proof = check_c(generated, planar_chart, law, states=300)
        assert set(proof.differences) >= {"phi", "jacobian", "mass_matrix", "bias", "gravity", "inverse"}
        assert ("control" in proof.differences) == (law is not None)
        assert proof.differences["jacobian"] < 1e-13
        assert generated.stack_bytes < 20_000


@pytest.mark.slow
@needs_c
def test_law_of_a_weak_arm_is_compared_beyond_its_limits(planar_chart: oc.Chart, tmp_path: Path) -> None:
    """At random states and default gains its limit cuts every command."""
    law = PDPlus(planar_chart, 50.0, limit=[0.1, 0.1, 0.1])
    assert (
        check_c(oc.generate_c(planar_chart, tmp_path, law), planar_chart, law, states=100).differences["control"]
        < 1e-10
    )


@pytest.mark.slow
@pytest.mark.parametrize("parametrisation", [oc.Linear(), oc.Fourier(2), oc.MLP((5, 4))], ids=lambda p: p.label)
def test_every_family_equals_its_python(planar_xy: oc.Problem, parametrisation: Any, tmp_path: Path) -> None:
    chart = oc.fit(planar_xy, parametrisation, samples=300).chart
    law = PDPlus(chart, 50.0)
    assert check_c(oc.generate_c(chart, tmp_path, law), chart, law, states=200).differences["control"] < 1e-10


@pytest.mark.slow
def test_seven_joints_with_an_idle_one(iiwa: oc.Problem, tmp_path: Path) -> None:
    chart = oc.fit(iiwa, oc.Polynomial(2)).chart
    law = PDPlus(chart, 50.0, coupling="decoupled")
    assert check_c(oc.generate_c(chart, tmp_path, law), chart, law, states=200).differences["control"] < 1e-10


@pytest.mark.slow
def test_chart_on_the_torus_has_no_outside(tmp_path: Path) -> None:
    chart = linear_on_the_torus()
    generated = oc.generate_c(chart, tmp_path, None, "free_arm")
    check_c(generated, chart, None, states=200)
    library = CompiledLibrary(compile_shared(generated, tmp_path), "free_arm", 3)
    assert library.chart(np.array([40.0, 0.3, 0.2]))[2] == 0
    assert "all joint positions" in (tmp_path / "free_arm.h").read_text()


@pytest.mark.parametrize("kind", ["orientation", "orientation:z"])
def test_no_rotation_is_more_than_half_a_turn_away(iiwa: oc.Problem, tmp_path: Path, kind: str) -> None:
    """C has no solution for components longer than 2 = 2 sin(pi / 2), and has one for a little less."""
    robot, q = iiwa.robot, iiwa.domain.centre
    away = pin.exp3(np.array([np.pi - 0.01, 0.0, 0.0]))  # turns the tip, and tilts its axis
    task = oc.Task.orientation(robot, robot.tip_rotation(q) @ away, kind[12:] or None)
    chart = oc.fit(robot, task, parametrisation=oc.Linear(), domain=iiwa.domain, samples=300).chart
    generated = oc.generate_c(chart, tmp_path, None, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 7)
    phi, k = chart.phi(q), 3 if kind == "orientation" else 2
    found, status = library.inverse(phi, q + 0.01)
    assert status == 0
    np.testing.assert_allclose(chart.phi(found), phi, atol=1e-8)
    longer = np.concatenate([phi[:k] * 2.01 / np.linalg.norm(phi[:k]), phi[k:]])
    for start in q + 0.1 * np.random.default_rng(7).uniform(-1, 1, (50, 7)):
        found, status = library.inverse(longer, start)
        assert status == 2  # SINGULAR: no solution
        np.testing.assert_array_equal(found, start)
        assert library.nearest(longer, start, 1.0)[1] in (1, 12)  # OUTSIDE_DOMAIN or STOPPED_EARLY: not reached
    assert library.inverse(longer, np.nan * q)[1] == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("gains->stiffness", "gains->damping_ratio", "control"),
        ("return inside(arm, q)", "return 7 +", "failed"),
        ("return inside(arm, q) ?", "return inside(arm, q) + 1 ?", "the status of chart"),
        (
            "if (!(x[i] >= least && x[i] <= most)) return 0;",
            "(void)x, (void)least, (void)most;",
            "the status of chart is . at",
        ),
        ("arm_domain_upper[N] = {", "arm_domain_upper[N] = {1e-3 + ", "the domain in C"),
        ("copy(q, now, n);", "", "inverse"),
        ("if (!(error <= arm->numbers.solved)) return", "if (!(error < 1e300)) return", "in inverse"),
        ("arg[7] = gains->limit;", "arg[7] = arm_default_gains.limit;", "control"),
        ("arg[5] = gains->stiffness;", "arg[5] = arm_default_gains.stiffness;", "control"),
        ("res[1] = bias;", "res[1] = gravity, (void)bias;", "in (bias|gravity)"),
    ],
)
def test_check_finds_what_is_wrong(
    impedance_c: GeneratedC, planar_chart: oc.Chart, tmp_path: Path, old: str, new: str, message: str
) -> None:
    texts = {path.name: path.read_text() for path in impedance_c.folder.glob("*.[hc]")}
    assert any(old in text for name, text in texts.items() if name.endswith(".c"))
    for name, text in texts.items():
        (tmp_path / name).write_text(text.replace(old, new) if name.endswith(".c") else text)
    with pytest.raises((AgreementError, CompileError), match=message):
        check_c(replace(impedance_c, folder=tmp_path), planar_chart, laws(planar_chart)[0], states=100)


@pytest.mark.slow
def test_check_compares_with_the_gains_of_the_controller(impedance_c: GeneratedC, planar_chart: oc.Chart) -> None:
    with pytest.raises(AgreementError, match="default gains"):
        check_c(impedance_c, planar_chart, Impedance(planar_chart, 51.0, limit=90.0), states=50)


@pytest.mark.slow
def test_coordinates_without_a_value_everywhere(planar_x: oc.Problem, tmp_path: Path) -> None:
    """NaN in Python is a status and zeros in C; branches with infinities are code like any other."""
    for k, expression in enumerate((lambda q: ca.sqrt(q[1] - 0.4), lambda q: ca.if_else(q[1] > 0.4, q[1], ca.inf))):
        given = oc.Given.from_function("partial", 3, lambda q, f=expression: ca.vertcat(f(q) + q[0], q[2] - q[0]))
        chart = oc.fit(planar_x, given).chart
        generated = oc.generate_c(chart, tmp_path / str(k), None, f"arm{k}")
        check_c(generated, chart, None, states=300)
        library = CompiledLibrary(compile_shared(generated, tmp_path), f"arm{k}", 3)
        phi, _, status = library.chart(np.array([0.6, 0.39, 0.8]))
        assert status == 2
        assert not phi.any()


@pytest.mark.slow
def test_check_is_fair_near_singularities(tmp_path: Path) -> None:
    """A good fit whose box holds postures where commands amplify rounding by a million, and its coupled laws."""
    robot = oc.Robot.planar([1, 1, 1], [1, 1, 1])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), "inertia", oc.Box([0.3] * 3, np.pi / 4))
    chart = oc.fit(problem, oc.Polynomial(3)).chart
    for law in (PDPlus(chart, 50.0), Kinematic(chart)):
        generated = oc.generate_c(chart, tmp_path / law.name, law, "arm")
        check_c(generated, chart, law)
        source = tmp_path / law.name / "arm.c"
        source.write_text(source.read_text().replace("arg[3] = reference->velocity", "arg[3] = reference->value"))
        with pytest.raises(AgreementError, match="control"):
            check_c(generated, chart, law)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*KINDS, *nightly(*sorted(ROBOTS.keys() - KINDS))])
def test_compiled_kinematics_and_dynamics_match_pinocchio(name: str, tmp_path: Path) -> None:
    """Nothing of ours between the compiled library and Pinocchio's numbers."""
    model, tip = arm(name)
    robot = oc.Robot.from_model(model, tip)
    rng, n = np.random.default_rng(7), robot.n
    lower, upper = np.maximum(robot.lower, -2), np.minimum(robot.upper, 2)
    base, box = rng.uniform(lower, upper), oc.Box((lower + upper) / 2, (upper - lower) / 2)
    task = oc.Task.position(robot, "zy" if n > 2 else "z")
    chart = oc.fit(oc.Problem(robot, task, "euclidean", box), oc.Linear(base=tuple(base))).chart
    generated = oc.generate_c(chart, tmp_path, None, "arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", n)
    data, frame, rows = model.createData(), model.getFrameId(tip), [2, 1][: task.m]
    for q, dq in rng.uniform(-2, 2, (100, 2, n)):
        p = pinocchio_position(model, q)
        M, bias, gravity, _ = library.dynamics(q, dq)
        want = pin.crba(model, data, p)
        for got, wanted in (
            (M, np.triu(want) + np.triu(want, 1).T),
            (bias, pin.nonLinearEffects(model, data, p, dq)),
            (gravity, pin.computeGeneralizedGravity(model, data, p)),
        ):
            np.testing.assert_allclose(got, wanted, atol=1e-10 * max(1.0, np.abs(wanted).max()))
        phi, J, _ = library.chart(q)
        pin.framesForwardKinematics(model, data, p)
        np.testing.assert_allclose(phi[: task.m], data.oMf[frame].translation[rows], atol=1e-10)
        jacobian = pin.computeFrameJacobian(model, data, p, frame, pin.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(J[: task.m], jacobian[rows], atol=1e-10)


def test_what_several_graphs_call_for_the_state_alone_is_computed_once() -> None:
    """Also inside others; but not for another order of the state, and nothing if there is nothing in common."""
    q, dq, x, a, b = (ca.MX.sym(name, 2) for name in ("q", "dq", "x", "a", "b"))
    place = ca.Function("place", [a], [ca.sin(a) * a[1]])
    rate = ca.Function("rate", [a, b], [ca.cos(a) * b[0]])
    outer = ca.Function("outer", [x], [2 * place(x)])
    graphs = [
        ca.Function("first", [q, dq, x], [place(q) + rate(q, dq) * x]),
        ca.Function("second", [q, x], [outer(q) - x]),
        ca.Function("third", [q, dq], [rate(q, dq) + rate(dq, q)]),
        ca.Function("alone", [q], [place(q)]),
    ]
    shared, *given = share_calls(graphs, {"first": 2, "second": 1, "third": 2})
    at, speed, other = np.array([0.3, -0.7]), np.array([0.2, 1.1]), np.array([5.0, 6.0])
    values = shared(at, speed)
    assert values.shape == (4, 1)  # place and rate
    for graph, changed, inputs in zip(
        graphs[:3], given[:3], [(at, speed, other), (at, other), (at, speed)], strict=True
    ):
        np.testing.assert_allclose(changed(*inputs, values).full(), graph(*inputs).full(), rtol=1e-15)
        assert abs(changed(*inputs, values + 1).full() - graph(*inputs).full()).min() > 0.1  # it uses them
    assert given[3].n_in() == 1
    nothing, only = share_calls(graphs[3:], {"alone": 1})
    assert nothing(at, speed).shape == (1, 1)
    np.testing.assert_array_equal(only(at, 0.0).full(), graphs[3](at).full())


def test_kernels_compute_sines_of_joints_once(planar_chart: oc.Chart, tmp_path: Path) -> None:
    """The law calls five functions with sines and cosines of three joints; its numbers stay the same, bit by bit."""
    law = PDPlus(planar_chart, 50.0, limit=90.0)
    graph, rng = law.graph, np.random.default_rng(4)
    (once,) = share_sines([graph])
    for _ in range(20):
        given = [rng.normal(size=graph.size_in(i)) for i in range(5)] + list(law.gains.values())
        for wanted, found in zip(graph(*given), once(*given), strict=True):
            np.testing.assert_array_equal(found.full(), wanted.full())

    def turns(function: ca.Function) -> int:
        every = [function, *function.find_functions()]
        codes = [f.instruction_id(k) for f in every if f.is_a("SXFunction") for k in range(f.n_instructions())]
        return codes.count(ca.OP_SIN) + codes.count(ca.OP_COS)

    assert turns(once) == 2 * 3 < turns(graph)


@pytest.mark.slow
def test_statuses_of_the_header_are_those_of_python(supervised_c: GeneratedC) -> None:
    """One name and number each, also for `STOPPED_EARLY`, which no law returns."""
    header = (supervised_c.folder / "arm.h").read_text()
    statuses = re.search(r"typedef enum \{(.*?)\} arm_status;", header, re.DOTALL)
    assert statuses is not None
    found = {name: int(number) for name, number in re.findall(r"ARM_(\w+) = (\d+)", statuses[1])}
    assert found == {status.name: status.value for status in ControlStatus}


def test_an_inverse_that_stopped_early_goes_on_where_it_stopped(
    supervised_library: CompiledLibrary, planar_for_control: oc.Chart
) -> None:
    """In calls of two evaluations each, it gets to the solution of a single long call."""
    chart, box = planar_for_control, planar_for_control.problem.domain
    q, wanted = box.centre - 0.5 * box.half_width, chart.phi(box.centre + 0.5 * box.half_width)
    whole, status = supervised_library.inverse(wanted, q)
    assert status == ControlStatus.OK
    errors, collect = [], []
    while status != ControlStatus.OK or not collect:
        errors.append(np.abs(chart.phi(q) - wanted).max())
        q, status = supervised_library.inverse(wanted, q, max_iterations=2)
        collect.append(status)
    assert collect[:-1] == [ControlStatus.STOPPED_EARLY] * (len(collect) - 1)
    assert len(collect) > 2
    assert errors == sorted(errors, reverse=True)
    np.testing.assert_allclose(q, whole, atol=1e-8)


def law_of_chain(n: int) -> PDPlus:
    """PD+ on linear coordinates of a planar arm with many joints."""
    robot = oc.Robot.planar([1.0 / n] * n, [1.0] * n)
    box = oc.Box(np.concatenate([[0.6], np.full(n - 1, 2.0 / n)]), 0.2)
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), "inertia", box)
    return PDPlus(oc.fit(problem, oc.Linear()).chart, 50.0, coupling="decoupled")


@pytest.mark.slow
@needs_c
def test_c_of_robots_with_many_joints_is_short_and_right(tmp_path: Path) -> None:
    """Inverses of large matrices have code of their own."""
    laws = [law_of_chain(n) for n in (9, 18)]
    folders = [oc.generate_c(law.chart, tmp_path / str(law.chart.n), law, "arm") for law in laws]
    # settings without integral action are within it, also where rounding put a decay below zero
    assert min(law.integral_bound for law in laws) >= 0.0
    lengths = [(generated.folder / "arm.c").stat().st_size for generated in folders]
    assert lengths[1] < 3.5 * lengths[0]
    small = laws[0]
    library = CompiledLibrary(compile_shared(folders[0], tmp_path), "arm", 9)
    assert library.check() < 1e-12
    q = sample_uniform(small.problem.domain, 5, 3)
    for k, (point, dq) in enumerate(zip(q, np.random.default_rng(1).normal(size=q.shape), strict=True)):
        reference = [small.chart.phi(q[k - 1]), 0.1 * dq, dq]
        want = small.function(point, dq, *reference, *small.gains.values())[0].full().ravel()
        found, status = library.control(point, dq, np.concatenate(reference), gain_numbers(small))
        assert status == 0
        np.testing.assert_allclose(found, want, atol=1e-11 * np.abs(want).max())
