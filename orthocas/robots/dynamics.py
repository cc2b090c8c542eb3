"""Mass matrix (composite rigid bodies), inverse dynamics (recursive Newton-Euler), and payloads."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, units_hint
from orthocas.robots.spatial import constant, skew, turn
from orthocas.robots.tree import KinematicTree
from orthocas.tools.checks import Array, as_float_array, require_finite

_Z = ca.SX([0, 0, 1])
#: indices of the inertial parameters (mass, mass times centre, inertia xx, xy, xz, yy, yz, zz) that `_regroup` leaves
_OF_BODY = {"revolute": [1, 2, 4, 5, 6, 8, 9], "prismatic": list(range(10))}
PAYLOAD = 10  #: number of parameters of a payload
_FORMS = "a mass, (4,) mass and centre, or (10,) mass, centre and inertia Ixx, Ixy, Ixz, Iyy, Iyz, Izz"
_MATRIX = [0, 1, 2, 1, 3, 4, 2, 4, 5]  #: index of each entry of the 3 x 3 matrix in (Ixx, Ixy, Ixz, Iyy, Iyz, Izz)
_INDEFINITE = 1e-6  #: allowed negative moment of a payload, relative to its largest one: data sheets round


@dataclass
class _Body:
    """Inertial parameters about the body frame's origin, as numbers or SX expressions."""

    mass: Any
    moment: Any  #: m c, (3,) or (3, 1)
    inertia: Any  #: (3, 3)


def build_mass_matrix(
    tree: KinematicTree, q: ca.SX, payload: ca.SX | None = None, inertials: ca.SX | None = None
) -> ca.SX:
    """M(q), (n, n), symmetric positive definite, [kg m^2] for revolute joints. The diagonal includes rotor inertias.

    A payload (10, 1) holds mass, centre in the tip frame, and inertia about the centre: Ixx, Ixy, Ixz, Iyy, Iyz, Izz.
    `inertials` replaces the tree's parameters; see `collect_inertials`.
    """
    joints = _build_transforms(tree, q)
    bodies = _build_bodies(tree, payload, inertials)
    kinds, N = tree.body_kinds, tree.bodies
    mass, moment, inertia = ([getattr(body, name) for body in bodies] for name in ("mass", "moment", "inertia"))
    M = ca.SX.zeros(N, N)
    for i in reversed(tree.order):
        # Force, and torque about the origin, that give the body unit acceleration along its joint.
        if kinds[i] == "prismatic":
            force, torque = mass[i] * _Z, ca.cross(moment[i], _Z)
        else:
            force, torque = ca.cross(_Z, moment[i]), inertia[i][:, 2]
        M[i, i] = _project_on_joint(tree, i, force, torque) + tree.armatures[i]
        j = i
        while tree.parents[j] >= 0:
            force, torque = joints[j].move_wrench(force, torque)
            j = tree.parents[j]
            M[i, j] = M[j, i] = _project_on_joint(tree, j, force, torque)
        parent = tree.parents[i]
        if parent >= 0:
            m, mc, inert = joints[i].move_inertia(mass[i], moment[i], inertia[i])
            mass[parent], moment[parent], inertia[parent] = (
                mass[parent] + m,
                moment[parent] + mc,
                inertia[parent] + inert,
            )
    # S^T M S of all joints, with the velocities S dq of mimic joints.
    S = ca.sparsify(ca.DM(tree.coupling))
    return S.T @ M @ S if tree.mimic_names else M


def build_inverse_dynamics(
    tree: KinematicTree,
    q: ca.SX,
    dq: ca.SX,
    ddq: ca.SX,
    payload: ca.SX | None = None,
    inertials: ca.SX | None = None,
    gravity: Array | None = None,
) -> ca.SX:
    """tau = M ddq + C dq + g, (n, 1) [N m] or [N]; `gravity` (3,), if given, replaces that of the tree."""
    joints = _build_transforms(tree, q)
    bodies = _build_bodies(tree, payload, inertials)
    # With mimic joints, all joints have velocities S dq, and the torques on q are S^T times those of all joints.
    S = ca.sparsify(ca.DM(tree.coupling))
    dq, ddq = (S @ dq, S @ ddq) if tree.mimic_names else (dq, ddq)
    #: angular velocity, U (below), and linear acceleration of each body
    states: dict[int, tuple[ca.SX, ca.SX, ca.SX]] = {}
    accelerations: dict[int, ca.SX] = {}
    at_rest = (ca.SX(3, 1), ca.SX(3, 3), constant(-(tree.gravity if gravity is None else gravity)))
    for i in tree.order:
        # Express the parent's motion in the axes of the body, then add the joint's motion.
        omega_p, U_p, a_p = states.get(tree.parents[i], at_rest)
        alpha_p = accelerations.get(tree.parents[i], ca.SX(3, 1))
        to_child = joints[i].to_child
        omega, alpha, a = to_child(omega_p), to_child(alpha_p), to_child(a_p + U_p @ joints[i].offset)
        if tree.body_kinds[i] == "prismatic":
            a += 2 * ca.cross(omega, _Z) * dq[i] + _Z * ddq[i]
        else:
            alpha += ca.cross(omega, _Z) * dq[i] + _Z * ddq[i]
            omega += _Z * dq[i]
        # U v = alpha x v + omega x (omega x v): one matrix for all vectors fixed in the body.
        U = skew(alpha) + omega @ omega.T - ca.SX.eye(3) * ca.dot(omega, omega)
        states[i], accelerations[i] = (omega, U, a), alpha
    tau = _sum_wrenches(tree, joints, bodies, states, accelerations) + ca.SX(ca.DM(tree.armatures)) * ddq
    return S.T @ tau if tree.mimic_names else tau


def build_forward_dynamics(
    tree: KinematicTree, q: ca.SX, dq: ca.SX, tau: ca.SX, inertials: ca.SX | None = None
) -> ca.SX:
    """ddq = M^-1 (tau - C dq - g), (n, 1), with M = L^T D L factored from the tips to the base.

    In this order L keeps the zeros of M between joints of different branches ([F2008] Sec. 6.5).
    """
    tips_first = list(reversed(range(tree.n)))
    M = build_mass_matrix(tree, q, inertials=inertials)[tips_first, tips_first]
    D, LT, order = ca.ldl(M, False)
    force = (tau - build_bias(tree, q, dq, inertials=inertials))[tips_first]
    return ca.ldl_solve(force, D, LT, order)[tips_first]


def build_bias(
    tree: KinematicTree,
    q: ca.SX,
    dq: ca.SX,
    payload: ca.SX | None = None,
    inertials: ca.SX | None = None,
    gravity: Array | None = None,
) -> ca.SX:
    """C(q, dq) dq + g(q), (n, 1)."""
    return build_inverse_dynamics(tree, q, dq, ca.SX(tree.n, 1), payload, inertials, gravity)


def build_gravity(tree: KinematicTree, q: ca.SX, payload: ca.SX | None = None) -> ca.SX:
    """g(q), (n, 1): the bias at rest."""
    return build_bias(tree, q, ca.SX(tree.n, 1), payload)


def build_zero_momentum(tree: KinematicTree, q: ca.SX) -> ca.SX:
    """H(q) = [-M_bb^-1 M_ba; I], (n, a), for the joints b of a floating base and the a joints of the arms."""
    k = len(tree.floating)
    M = build_mass_matrix(tree, q)
    # Reversed, L^T D L has the order of `build_forward_dynamics`.
    base_first = list(reversed(range(k)))
    D, LT, order = ca.ldl(M[base_first, base_first], False)
    follows = ca.ldl_solve(M[base_first, k:], D, LT, order)[base_first, :]
    return ca.vertcat(-follows, ca.SX.eye(tree.n - k))


def build_coriolis_product(tree: KinematicTree, q: ca.SX, v: ca.SX, w: ca.SX, payload: ca.SX | None = None) -> ca.SX:
    """C(q, v) w with the Christoffel form of C, (n, 1), by polarisation of the quadratic form C(q, v) v.

    C(q, v) w = (c(v + w) - c(v - w)) / 4 with c(v) = C(q, v) v. It is bilinear and symmetric in (v, w).
    """
    weightless = np.zeros(3)
    plus, minus = (build_bias(tree, q, dq, payload, gravity=weightless) for dq in (v + w, v - w))
    return (plus - minus) / 4


@dataclass
class _JointTransform:
    """Pose of body i in its parent's frame; a constant rotation and Rz(q) are kept apart, which saves operations."""

    rotation: ca.SX  #: constant, (3, 3)
    turn: ca.SX  #: Rz(q) or the identity
    offset: ca.SX  #: origin of the body in the parent's frame

    def to_child(self, v: ca.SX) -> ca.SX:
        return self.turn.T @ (self.rotation.T @ v)

    def to_parent(self, v: ca.SX) -> ca.SX:
        return self.rotation @ (self.turn @ v)

    def move_wrench(self, force: ca.SX, torque: ca.SX) -> tuple[ca.SX, ca.SX]:
        f = self.to_parent(force)
        return f, self.to_parent(torque) + ca.cross(self.offset, f)

    def move_inertia(self, mass: ca.SX, moment: ca.SX, inertia: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        turned = self.rotation @ (self.turn @ inertia @ self.turn.T) @ self.rotation.T
        mc, r = self.to_parent(moment), self.offset
        shift = 2 * ca.dot(r, mc) * ca.SX.eye(3) - r @ mc.T - mc @ r.T
        steiner = mass * (ca.dot(r, r) * ca.SX.eye(3) - r @ r.T)
        return mass, mc + mass * r, ca.triu2symm(ca.triu(turned + shift + steiner))


def _build_transforms(tree: KinematicTree, q: ca.SX) -> list[_JointTransform]:
    transforms, positions = [], tree.expand(q)
    for i, kind in enumerate(tree.body_kinds):
        rotation, offset = constant(tree.rotations[i]), constant(tree.translations[i])
        if kind == "prismatic":
            transforms.append(_JointTransform(rotation, ca.SX.eye(3), offset + rotation[:, 2] * positions[i]))
        else:
            transforms.append(_JointTransform(rotation, turn(positions[i]), offset))
    return transforms


def _sum_wrenches(
    tree: KinematicTree,
    joints: list[_JointTransform],
    bodies: list[_Body],
    states: dict[int, tuple[ca.SX, ca.SX, ca.SX]],
    accelerations: dict[int, ca.SX],
) -> ca.SX:
    """Backward pass: sum body wrenches towards the base, and project them on the joint axes."""
    forces = [ca.SX(3, 1)] * tree.bodies
    torques = [ca.SX(3, 1)] * tree.bodies
    tau = ca.SX.zeros(tree.bodies)
    for i in reversed(tree.order):
        # Sum the wrench of the body itself and those of the bodies that it carries.
        omega, U, a = states[i]
        moment, inertia = bodies[i].moment, bodies[i].inertia
        force = forces[i] + bodies[i].mass * a + U @ moment
        torque = torques[i] + inertia @ accelerations[i] + ca.cross(omega, inertia @ omega) + ca.cross(moment, a)
        tau[i] = _project_on_joint(tree, i, force, torque)
        parent = tree.parents[i]
        if parent >= 0:
            f, n = joints[i].move_wrench(force, torque)
            forces[parent], torques[parent] = forces[parent] + f, torques[parent] + n
    return tau


def _project_on_joint(tree: KinematicTree, i: int, force: ca.SX, torque: ca.SX) -> ca.SX:
    return force[2] if tree.body_kinds[i] == "prismatic" else torque[2]


def collect_inertials(tree: KinematicTree) -> Array:
    """The inertial parameters that affect the dynamics, (k,): 7 per body of a revolute joint, 10 per other body."""
    numbers = []
    for kind, body in zip(tree.body_kinds, _regroup(tree), strict=True):
        all_ten = np.concatenate([[body.mass], body.moment, body.inertia[np.triu_indices(3)]])
        numbers.append(all_ten[_OF_BODY[kind]])
    return np.concatenate(numbers)


def find_first_moments(tree: KinematicTree) -> tuple[list[int], tuple[int, ...]]:
    """The parameters of `collect_inertials` that gravity acts on: their indices, and the joint of each.

    These are mass times centre across the axis for revolute joints, and the mass for prismatic ones.
    """
    places: list[int] = []
    joints: list[int] = []
    start = 0
    for joint, kind in zip(tree.leaders, tree.body_kinds, strict=True):
        moments = (0,) if kind == "prismatic" else (1, 2)
        new = [start + i for i, place in enumerate(_OF_BODY[kind]) if place in moments]
        places, joints, start = places + new, joints + [joint] * len(new), start + len(_OF_BODY[kind])
    return places, tuple(joints)


def _build_bodies(tree: KinematicTree, payload: ca.SX | None, inertials: ca.SX | None) -> list[_Body]:
    """The regrouped bodies, from the tree or from given parameters; a payload is added to the body of the tip."""
    if inertials is None:
        bodies = [_Body(ca.SX(b.mass), constant(b.moment), constant(b.inertia)) for b in _regroup(tree)]
    else:
        bodies, start = [], 0
        for kind in tree.body_kinds:
            ten = ca.SX(10, 1)
            for place in _OF_BODY[kind]:
                ten[place], start = inertials[start], start + 1
            bodies.append(_Body(ten[0], ten[1:4], ca.reshape(ten[[4, 5, 6, 5, 7, 8, 6, 8, 9]], 3, 3)))
    if payload is not None and tree.tip_parent >= 0:
        # Payload as mass, mass times centre, and inertia about the body's origin, in the frame of the tip's body.
        body, R, p, mass = (
            bodies[tree.tip_parent],
            constant(tree.tip_rotation),
            constant(tree.tip_translation),
            payload[0],
        )
        centre = p + R @ payload[1:4]
        turned = R @ ca.reshape(payload[4:][_MATRIX], 3, 3) @ R.T
        inertia = turned + mass * (ca.dot(centre, centre) * ca.SX.eye(3) - centre @ centre.T)
        bodies[tree.tip_parent] = _Body(body.mass + mass, body.moment + mass * centre, body.inertia + inertia)
    return bodies


def _regroup(tree: KinematicTree) -> list[_Body]:
    """Move inertial parameters from each body to its parent where this leaves the motion unchanged, to save operations.

    Turning a body about an axis changes neither its mass, nor its first moment along the axis, nor the inertia of a rod
    along the axis. So these parameters can belong to the parent.
    """
    # Move the reference point from the centre of mass to the joint's frame.
    bodies = [
        _Body(mass, mass * centre, inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre)))
        for mass, centre, inertia in zip(tree.masses, tree.centres, tree.inertias, strict=True)
    ]
    for i in reversed(tree.order):
        if tree.body_kinds[i] == "prismatic":
            continue
        body = bodies[i]
        rod = _Body(body.mass, np.array([0, 0, body.moment[2]]), np.diag([body.inertia[1, 1]] * 2 + [0.0]))
        bodies[i] = _Body(0.0, body.moment - rod.moment, body.inertia - rod.inertia)
        if tree.parents[i] < 0:
            continue
        # The parent takes the rod, which is fixed at rotation R and position p in its frame.
        parent, R, p = bodies[tree.parents[i]], tree.rotations[i], tree.translations[i]
        moment = R @ rod.moment
        shift = 2 * (p @ moment) * np.eye(3) - np.outer(p, moment) - np.outer(moment, p)
        steiner = rod.mass * (p @ p * np.eye(3) - np.outer(p, p))
        parent.inertia = parent.inertia + R @ rod.inertia @ R.T + shift + steiner
        parent.moment = parent.moment + moment + rod.mass * p
        parent.mass += rod.mass
    return bodies


def check_payload(value: ArrayLike) -> Array:
    """The ten numbers of a payload, read-only.

    Args:
        value: mass [kg] of a point at the tip, (4,) with its centre in the tip frame [m], or (10,) with the inertia
            about that centre, in axes of the tip frame: Ixx, Ixy, Ixz, Iyy, Iyz, Izz [kg m^2].

    Raises:
        InvalidValueError: for another shape, a negative mass, a centre that looks like millimetres, or an inertia that
            is not positive semidefinite.
    """
    values = np.atleast_1d(as_float_array("payload", value))
    if values.shape not in ((1,), (4,), (PAYLOAD,)):
        raise InvalidValueError("shape of payload", values.shape, _FORMS)
    require_finite("payload", values)
    # Missing numbers are 0: a point mass, by default at the tip.
    numbers = np.zeros(PAYLOAD)
    numbers[: len(values)] = values
    if numbers[0] < 0:
        raise InvalidValueError("mass of payload", numbers[0], "a mass >= 0")
    if hint := units_hint(("m", "m", "m"), numbers[1:4].tolist()):
        raise InvalidValueError("centre of payload", numbers[1:4].tolist(), f"a position in the tip frame{hint}")
    inertia = numbers[4:][_MATRIX].reshape(3, 3)
    smallest = float(np.linalg.eigvalsh(inertia)[0])
    if smallest < -_INDEFINITE * np.abs(inertia).max():
        raise InvalidValueError("smallest principal inertia of payload", smallest, "a number >= 0")
    numbers.setflags(write=False)
    return numbers


def add_payload(tree: KinematicTree, payload: ArrayLike) -> KinematicTree:
    """The tree with a payload merged into the body that carries the tip; unchanged if that is the base."""
    numbers, i = check_payload(payload), tree.tip_parent
    mass, centre, inertia = tree.masses[i], tree.centres[i], tree.inertias[i]
    total = mass + numbers[0]
    if i < 0 or total == 0:
        return tree
    R = tree.tip_rotation
    added = tree.tip_translation + R @ numbers[1:4]
    # Combined centre of mass, and both inertias about it (Steiner).
    together = (mass * centre + numbers[0] * added) / total
    turned = R @ numbers[4:][_MATRIX].reshape(3, 3) @ R.T
    inertia = inertia + turned + _steiner(mass, centre - together) + _steiner(numbers[0], added - together)
    return replace(
        tree,
        masses=_replace(tree.masses, i, total),
        centres=_replace(tree.centres, i, together),
        inertias=_replace(tree.inertias, i, inertia),
    )


def _steiner(mass: float, offset: Array) -> Array:
    return np.asarray(mass * (offset @ offset * np.eye(3) - np.outer(offset, offset)))


def _replace(values: Array, i: int, value: ArrayLike) -> Array:
    changed = values.copy()
    changed[i] = value
    return changed
