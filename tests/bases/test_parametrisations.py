"""Parametrisations: Jacobians against finite differences, bases against closed forms, names."""

import itertools

import casadi as ca
import numpy as np
import pytest
from conftest import robot_data

import orthocas as oc
from orthocas.bases import JointSpace, ProductFamily, component_gradients, parse_parametrisation
from orthocas.charts.coordinates import point_functions
from orthocas.errors import InvalidValueError, ShapeError, SingularTaskError, UnknownNameError
from orthocas.fitting.basis_objective import BasisGradients, ProductGradients, SparseGradients
from orthocas.tools.columns import COLUMNS, split_by_sample

SPACE = JointSpace(np.array([0.1, -0.3, 0.2]), np.array([0.5, 0.7, 0.4]), (False, False, False), ("a", "b", "c"))
SLIDING = JointSpace(SPACE.centre, SPACE.half_width, (False, True, False), SPACE.joint_names)
GIVEN = oc.Given.from_function("by hand", 3, lambda q: ca.vertcat(ca.sin(q[0]) * q[1], q[2] + 2))
REDUCED = [oc.Polynomial(3, cyclic=["b"]), oc.Fourier(2, cyclic=("a", "c"))]
SPARSE = [oc.Polynomial(4, joints=2), oc.Fourier(3, ("b",), joints=1)]
PARTLY = oc.MLP((5, 4), raw=True, cyclic=["b"], without=["c"], activation="isru")
ALL = [oc.Linear(), oc.Polynomial(3), oc.Fourier(2), *REDUCED, *SPARSE, oc.MLP((5, 4)), PARTLY, GIVEN]


def values(parametrisation: object, space: JointSpace, points: np.ndarray, theta: np.ndarray, r: int = 2) -> np.ndarray:
    family = parametrisation.family(space, r)
    q, p = ca.MX.sym("q", space.n, len(points)), ca.MX.sym("theta", family.size)
    return np.array(ca.Function("xi", [q, p], [family.expression(q, p)])(points.T, theta)).T


@pytest.mark.parametrize("parametrisation", ALL, ids=lambda p: p.label)
def test_jacobian_by_ad_matches_central_differences(parametrisation: object) -> None:
    family = parametrisation.family(SPACE, 2)
    theta = family.initial(seed=4)
    points = np.random.default_rng(5).uniform(-0.5, 0.5, (6, 3))
    q, p = ca.MX.sym("q", 3, 6), ca.MX(ca.DM(theta))
    J = np.array(ca.Function("J", [q], family.jacobian(q, p))(points.T))  # (r, n, N)
    step = 1e-6
    for k, e in enumerate(np.eye(3)):
        ahead = values(parametrisation, SPACE, points + step * e, theta)
        behind = values(parametrisation, SPACE, points - step * e, theta)
        np.testing.assert_allclose(J[:, k], ((ahead - behind) / (2 * step)).T, atol=1e-8)


def test_chain_rule_of_the_network_is_that_of_automatic_differentiation() -> None:
    family = oc.MLP((5, 4, 3)).family(SLIDING, 2)
    q, theta = ca.MX.sym("q", 3, 6), ca.MX(ca.DM(family.initial(seed=4)))
    points = np.random.default_rng(5).uniform(-0.5, 0.5, (6, 3))
    by_hand, by_ad = family.jacobian(q, theta), component_gradients(family.expression(q, theta), q)
    ours, theirs = (np.array(ca.Function("J", [q], J)(points.T)) for J in (by_hand, by_ad))
    np.testing.assert_allclose(ours, theirs, atol=1e-14)


@pytest.mark.parametrize("parametrisation", [*ALL, oc.Polynomial(6), oc.Fourier(3)], ids=lambda p: p.label)
def test_functions_of_a_point_are_the_derivatives_of_the_expression(parametrisation: object) -> None:
    """Those that C is made of, against automatic differentiation of the expression."""
    family = parametrisation.family(SPACE, 2)
    theta = family.initial(seed=4)
    functions = point_functions(family, theta, 3)
    q, v, w = (ca.MX.sym(name, 3) for name in "qvw")
    xi = family.expression(q, ca.MX(ca.DM(theta)))
    J = ca.jacobian(xi, q)
    second = ca.jtimes(J @ w, q, v)
    wanted = ca.Function("wanted", [q, v, w], [xi, J, second])
    for point in np.random.default_rng(8).uniform(-0.5, 0.5, (5, 3, 3)):
        found = functions["xi"](point[0]), functions["jacobian"](point[0]), functions["second_derivative"](*point)
        for got, want in zip(found, wanted(*point), strict=True):
            scale = max(1, np.abs(want.full()).max())
            np.testing.assert_allclose(got.full(), want.full(), atol=1e-12 * scale)


def test_given_coordinates_of_other_joints_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"q of coordinates 'by hand' has shape \(3,\), expected \(2,\)"):
        GIVEN.family(SPACE.restricted_to([0, 1]), 2)
    with pytest.raises(ShapeError, match="coordinates 'by hand'"):
        GIVEN.family(SPACE, 1)


@pytest.mark.parametrize("parametrisation", ALL, ids=lambda p: p.label)
def test_columns_are_independent_samples_and_sx_agrees_with_mx(parametrisation: object) -> None:
    family = parametrisation.family(SPACE, 2)
    theta = family.initial(seed=4)
    points = np.random.default_rng(6).uniform(-0.5, 0.5, (5, 3))
    together = values(parametrisation, SPACE, points, theta)
    q = ca.SX.sym("q", 3)
    single = ca.Function("xi", [q], [family.expression(q, ca.SX(ca.DM(theta)))])
    np.testing.assert_allclose(together, [np.array(single(p)).ravel() for p in points], atol=1e-13)


@pytest.mark.parametrize("parametrisation", [oc.Polynomial(4), oc.Fourier(3)], ids=lambda p: p.label)
def test_basis_has_the_counted_terms_and_is_orthonormal(parametrisation: object) -> None:
    whole = JointSpace(np.zeros(2), np.full(2, np.pi), (False, False), ("a", "b"))
    family = parametrisation.family(whole, 1)
    assert len(family.terms) == len(set(family.terms)) == parametrisation.term_count(2)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    grid = np.pi * np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
    mass = np.outer(weights, weights).ravel() / 4
    q = ca.SX.sym("q", 2)
    basis = ca.Function("psi", [q], [family.basis(q)])
    psi = np.array([np.array(basis(p)).ravel() for p in grid])
    np.testing.assert_allclose((psi * mass[:, None]).T @ psi, np.eye(len(family.terms)), atol=1e-10)
    np.testing.assert_allclose(mass @ psi, 0, atol=1e-10)  # no constant among them


@pytest.mark.parametrize("joints", [1, 2, 3])
def test_products_of_few_joints_are_those_of_all_that_have_no_more_joints(joints: int) -> None:
    whole, sparse = (oc.Polynomial(4, joints=most).family(SPACE, 1).terms for most in (None, joints))
    assert sparse == tuple(term for term in whole if sum(k > 0 for k in term) <= joints)
    for n in range(1, 6):
        terms = [term for term in itertools.product(range(4), repeat=n) if 0 < sum(term) <= 3]
        few = sum(np.count_nonzero(term) <= joints for term in terms)
        assert oc.Polynomial(3, joints=joints).term_count(n) == few
        assert oc.Fourier(3, joints=joints).term_count(n) == sum(
            2 ** np.count_nonzero(term) for term in terms if np.count_nonzero(term) <= joints
        )


def test_fourier_is_periodic() -> None:
    theta = oc.Fourier(3).family(SPACE, 2).initial(0)
    points = np.random.default_rng(1).uniform(-3, 3, (4, 3))
    turned = points + 2 * np.pi * np.array([1, -1, 2])
    np.testing.assert_allclose(values(oc.Fourier(3), SPACE, points, theta), values(oc.Fourier(3), SPACE, turned, theta))


def test_mlp_is_the_formula_of_the_paper_and_takes_sliding_joints_raw() -> None:
    family = oc.MLP((4, 3)).family(SLIDING, 2)
    theta = np.random.default_rng(2).normal(size=family.size)
    q = np.array([0.3, 1.7, -0.4])
    inputs = np.array([np.sin(q[0]), np.sin(q[2]), np.cos(q[0]), np.cos(q[2]), q[1]])
    W1, rest = theta[:20].reshape(4, 5, order="F"), theta[20:]
    b1, W2, b2 = rest[:4], rest[4:16].reshape(3, 4, order="F"), rest[16:19]
    Wout, bout = rest[19:25].reshape(2, 3, order="F"), rest[25:]
    want = Wout @ np.tanh(W2 @ np.tanh(W1 @ inputs + b1) + b2) + bout
    np.testing.assert_allclose(values(oc.MLP((4, 3)), SLIDING, q[None], theta)[0], want, atol=1e-13)


def test_inverse_square_root_units_are_their_formula() -> None:
    parametrisation = oc.MLP((3,), raw=True, activation="isru")
    theta, q = np.random.default_rng(2).normal(size=20), np.array([0.3, 1.7, -0.4])
    z = theta[:9].reshape(3, 3, order="F") @ q + theta[9:12]
    want = theta[12:18].reshape(2, 3, order="F") @ (z / np.sqrt(1 + z**2)) + theta[18:]
    np.testing.assert_allclose(values(parametrisation, SPACE, q[None], theta)[0], want, atol=1e-13)
    with pytest.raises(UnknownNameError, match="known: tanh, isru"):
        oc.MLP((3,), activation="relu")


def test_embedding_keeps_the_function() -> None:
    coarse, fine = oc.Polynomial(2).family(SPACE, 2), oc.Polynomial(4).family(SPACE, 2)
    theta = coarse.initial(3)
    wide = fine.embed(theta, coarse)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (4, 3))
    got = values(oc.Polynomial(4), SPACE, points, wide)
    np.testing.assert_allclose(got, values(oc.Polynomial(2), SPACE, points, theta), atol=1e-12)


FORMS = [SparseGradients, ProductGradients]
BASES = [oc.Polynomial(3), oc.Polynomial(3, cyclic=["b"]), oc.Fourier(2, cyclic=["a"]), oc.Linear()]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("parametrisation", BASES, ids=lambda p: p.label)
def test_basis_gradients_match_differences_of_the_basis(form: type[BasisGradients], parametrisation: object) -> None:
    family: ProductFamily = parametrisation.family(SPACE, 1)
    gradients = form(family, 3)
    point = np.array([0.2, 0.1, -0.1])
    q = ca.SX.sym("q", 3)
    psi = ca.Function("psi", [q], [family.basis(q)])
    G = gradients.expand(gradients.at(point[None]), 1)[0]  # (n, K)
    step = 1e-6
    want = [np.array(psi(point + step * e) - psi(point - step * e)).ravel() / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(G, want, atol=1e-7)
    elsewhere = np.array(family.terms).T == 0  # (n, K): functions that do not depend on the joint
    assert not G[elsewhere].any()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("parametrisation", BASES, ids=lambda p: p.label)
def test_products_with_basis_gradients_are_those_with_all_entries(
    form: type[BasisGradients], parametrisation: object
) -> None:
    family, rng = parametrisation.family(SPACE, 2), np.random.default_rng(5)
    points = rng.uniform(-0.5, 0.5, (300, 3))
    gradients = form(family, 3)
    X, C = gradients.at(points), rng.normal(size=(2, family.width))
    G = gradients.expand(X, 300)  # (N, n, K)
    J = split_by_sample((gradients.build_table(C) @ X).reshape(len(X), 3, 2, -1), 300)
    np.testing.assert_allclose(J, C @ G.transpose(0, 2, 1), atol=1e-12)
    slopes = np.zeros((len(X) * COLUMNS, 6))  # dL/dJ_xi, joint by joint
    slopes[:300] = rng.normal(size=(300, 6))
    by_block = slopes.reshape(len(X), COLUMNS, *gradients.build_table(C).shape[:2]).transpose(0, 2, 3, 1)
    found = gradients.collect((by_block @ X.transpose(0, 1, 3, 2)).sum(axis=0))
    np.testing.assert_allclose(found, np.einsum("snr,snk->rk", slopes[:300].reshape(300, 3, 2), G), atol=1e-11)
    kept = rng.uniform(size=family.width) < 0.6
    some = gradients.expand(X, 300, kept, 4, np.float32)
    assert some.dtype == np.float32
    np.testing.assert_allclose(some, G[::4][:, :, kept], rtol=1e-6, atol=1e-6)
    assert gradients.expand(X[:1, :, :, :0], 0).shape == (0, 3, family.width)  # no hinge of a fold acts


def test_linear_normals_of_the_paper() -> None:
    v = np.array([[0.5, -1.2, 0.7]])
    n1, n2 = oc.Linear(normals="paper").normal_vectors(v)
    np.testing.assert_allclose(n1, np.array([-1.2, -0.5, 0]) / np.hypot(1.2, 0.5))  # (37a)
    np.testing.assert_allclose(n2, np.cross(n1, v[0]) / np.linalg.norm(np.cross(n1, v[0])))  # (37b)
    np.testing.assert_allclose(np.array([n1, n2]) @ v[0], 0, atol=1e-14)
    gradients = np.array([[0.5, -1.2, 0.7], [1.0, 0.3, 0.2]])
    (normal,) = oc.Linear(normals="paper").normal_vectors(gradients)  # (39)
    np.testing.assert_allclose(gradients @ normal, 0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(normal), 1)


def test_linear_normals_at_bad_bases_are_refused() -> None:
    with pytest.raises(SingularTaskError, match="singular at the base"):
        oc.Linear().normal_vectors(np.array([[1.0, 2, 3], [2.0, 4, 6]]))
    with pytest.raises(SingularTaskError, match="along joint 1 or 2"):
        oc.Linear(normals="paper").normal_vectors(np.array([[0.0, 0, 1]]))
    with pytest.raises(InvalidValueError, match="n is 4"):
        oc.Linear(normals="paper").normal_vectors(np.ones((1, 4)))
    with pytest.raises(UnknownNameError):
        oc.Linear(normals="best")


@pytest.mark.parametrize(
    "label",
    [
        "linear",
        "polynomial:4",
        "polynomial:4:joints=2",
        "fourier:2:joints=1:cyclic=a,b",
        "mlp:64x64",
        "mlp:24x24:raw",
        "mlp:24x24:isru",
        "mlp:24x24:raw:isru:cyclic=a:without=b,c",
        "mlp:8:without=c",
        "polynomial:4:cyclic=a:without=b,c",
        "fourier:2:without=c",
    ],
)
def test_labels_are_read_back(label: str) -> None:
    assert parse_parametrisation(label).label == label


@pytest.mark.parametrize(
    ("label", "error", "message"),
    [
        ("spline:3", UnknownNameError, "known: linear, polynomial, fourier, mlp, sew"),
        ("polynomial", InvalidValueError, "whole numbers"),
        ("polynomial:x", InvalidValueError, "whole numbers"),
        ("polynomial:0", InvalidValueError, "degree is 0"),
        ("fourier:-1", InvalidValueError, "degree is -1"),
        ("polynomial:3:joints=0", InvalidValueError, "joints is 0"),
        ("polynomial:3:joints=two", InvalidValueError, "whole numbers"),
        ("polynomial:3:cyclic:joints=2", InvalidValueError, "after the degree 'joints=2', then 'cyclic'"),
        ("mlp:64x", InvalidValueError, "whole numbers"),
        ("mlp:64:smooth", InvalidValueError, "after the widths 'raw', then 'isru', then 'cyclic'"),
        ("mlp:0", InvalidValueError, "hidden is 0"),
        ("sew:left", UnknownNameError, "known: conventional, stereographic"),
        ("linear:2", InvalidValueError, "'linear' without a number"),
    ],
)
def test_bad_labels_are_refused(label: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        parse_parametrisation(label)


def test_fourier_refuses_a_prismatic_joint_by_name() -> None:
    with pytest.raises(InvalidValueError, match="joint 'b' of a Fourier basis is prismatic"):
        oc.Fourier(2).family(SLIDING, 1)
    robot = oc.Robot.from_urdf(robot_data("tiago_description/robots/tiago.urdf"), "arm_tool_link")
    with pytest.raises(InvalidValueError, match="torso_lift_joint"):
        oc.fit(oc.Problem(robot, oc.Task.position(robot)), oc.Fourier(1))


def test_empty_mlp_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="at least one hidden layer"):
        oc.MLP(())
    with pytest.raises(InvalidValueError, match="at least one joint neither in cyclic nor in without"):
        oc.MLP((3,), cyclic=["a", "b"], without=["c"]).family(SPACE, 1)


@pytest.mark.parametrize("parametrisation", [oc.Polynomial(3, ["a"], without=["c"]), oc.Fourier(2, without=["c"])])
def test_joints_that_are_left_out_do_not_enter(parametrisation: oc.Polynomial | oc.Fourier) -> None:
    space = JointSpace(np.zeros(3), np.ones(3), (False,) * 3, ("a", "b", "c"))
    family = parametrisation.family(space, 1)
    assert family.width == parametrisation.term_count(3)
    q = ca.SX.sym("q", 3)
    assert ca.which_depends(family.basis(q), q, 1, False) == [True, True, False]
    with pytest.raises(InvalidValueError, match="none of them cyclic"):
        oc.Polynomial(2, ["a"], without=["a"])
