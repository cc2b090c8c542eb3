"""Control across the charts of an atlas: the posture asked for, and laws that are handed over."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from orthocas.atlas.atlas import Atlas
from orthocas.atlas.index import Index
from orthocas.charts.chart import Chart
from orthocas.control.controller import Controller, ControlStatus
from orthocas.control.gains import command_limit, non_negative_gains, positive_gains
from orthocas.control.memory import memory_of
from orthocas.errors import InvalidValueError, LawWarning, PathError
from orthocas.tools.cached import building, cached_property
from orthocas.tools.checks import Array, Indices, require_kind
from orthocas.tools.display import Shown, number_list

_ENOUGH = 1e-12  # of phi, relative to its sizes
_ITERATIONS = 12
_SINGULAR = 1e12  # condition number of J
_RATE = 10.0  # [1/s] at which xi comes to rest after a hand-over
_ALIKE = 0.05  # difference of two hand-overs at one place of the tool, in sizes of the task values
_DRIFT = 1e-3  # [rad] or [m] that motions which repeat may leave behind without a word
_LAWS = 16  # built for charts, the last ones
_KEPT = 64  # lists of neighbours


class AskedPosture:
    """q_d(t) with h(q_d) = x_d(t), held in the coordinates of a chart: phi_d = (x_d, xi_d).

    At a hand-over from chart a to chart b at q_d, the coordinates asked for become phi_b(q_d), J_b dq_d and
    J_b ddq_d + dJ_b/dt dq_d. So q_d, dq_d and ddq_d are continuous. From there on the velocity of xi_d decays like a
    critically damped system: d3xi/dt3 + 2 w d2xi/dt2 + w^2 dxi/dt = 0 with w = 10 1/s.

    A chart is left where the position lies in the outer half of the overlap of its box, if another chart's cell holds
    it. A cell ends where that overlap begins, so charts do not alternate.

    Every hand-over begins a new xi_d, so motions that repeat through several charts are not cyclic. A LawWarning
    says so once, when a hand-over comes again with the tool at the same place and other joints.

    Args:
        atlas: the atlas.
    """

    chart: Chart  #: the chart of the moment
    number: int  #: of the chart
    q: Array  #: q_d, (n,)
    dq: Array  #: (n,)
    ddq: Array  #: (n,)
    phi: Array  #: phi_d with two derivatives, (3, n)

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas

    def start(self, q: Array, time: float = 0.0) -> None:
        """Begin at rest at a posture (n,).

        Raises:
            PathError: if the atlas has no chart there.
        """
        self.number = int(self.atlas.chart_at(q))
        if self.number < 0:
            raise PathError(f"q = {np.round(q, 3).tolist()} has no chart in the atlas, expected a covered posture")
        xi = self.atlas.xi(q, self.number)
        self._time = self._since = time
        self._xi = np.stack([xi, 0 * xi, 0 * xi])
        self.q, self.dq, self.ddq = q.copy(), 0 * q, 0 * q
        self.chart = self.atlas.chart(self.number, q)
        self.phi = np.stack([self.chart.phi(q), self.dq, self.ddq])
        self._passed: list[tuple[tuple[int, int], Array, Array]] = []
        self._warned = False

    def move(self, time: float, x: Array) -> None:
        """Go on to a time and the task values with two derivatives of that time, (3, m), in the same chart.

        Raises:
            PathError: if no posture near the last one has these coordinates.
        """
        self._time, self._x = time, x
        self.phi = np.hstack([x, self._held(time - self._since)])
        chart = self.chart
        phi, jacobian, bend = (chart.function(name) for name in ("phi", "jacobian", "second_derivative"))
        q, error = self.q, np.inf
        for _ in range(_ITERATIONS):
            missing, J = self.phi[0] - phi(q).full()[:, 0], jacobian(q).full()
            error = np.abs(missing / chart.phi_sizes).max()
            if error <= _ENOUGH or not (np.isfinite(J).all() and np.linalg.cond(J) < _SINGULAR):
                break
            q = q + np.linalg.solve(J, missing)
        if not error <= _ENOUGH:
            raise PathError(f"the task values at {time:.4g} s cannot be reached with the posture held")
        self.q, self.dq = q, np.linalg.solve(J, self.phi[1])
        self.ddq = np.linalg.solve(J, self.phi[2] - bend(q, self.dq, self.dq).full()[:, 0])

    def wanted_at(self, q: Array) -> int:
        """The chart for a position (n,), perhaps the same."""
        index, joints = self.atlas.index, list(self.atlas.plan.joints)
        u = np.abs(index.on_cube(q[None, joints], np.array([self.number]))).max()
        overlap = self.atlas.settings.overlap
        if u <= (1 + 1 / (1 + overlap)) / 2:
            return self.number
        found = int(self.atlas.chart_at(q))
        return found if found >= 0 else self.number

    def hand_over(self, number: int) -> None:
        """Go on in another chart with the same motion of the joints."""
        self._watch_drift(number)
        phi = np.stack(self.atlas.handed_over(self.q, self.dq, self.ddq, number))
        self.chart = self.atlas.chart(number, self.q)
        self.number, self._since, self._xi = number, self._time, phi[:, self.atlas.problem.m :]
        self.move(self._time, self._x)

    def _watch_drift(self, number: int) -> None:
        """Warn if the same hand-over comes again with other joints."""
        charts, x = (self.number, number), self._x[0]
        sizes = self.chart.phi_sizes[: len(x)]
        alike = (
            (q, there)
            for known, there, q in self._passed
            if known == charts and (abs(x - there) < _ALIKE * sizes).all()
        )
        before = next(alike, None)
        if before is None:
            self._passed.append((charts, x.copy(), self.q.copy()))
        elif not self._warned and (drift := self._drift_since(*before, x)) > _DRIFT:
            self._warned = True
            warnings.warn(
                f"this motion repeats through several charts, and its joints are {drift:.2g} off since it passed here "
                "first: wide charts and corridors are cyclic, hand-overs are not (docs/how-to/atlas.md)",
                LawWarning,
                stacklevel=3,
            )

    def _drift_since(self, q: Array, there: Array, x: Array) -> float:
        """How far joints are from q, beyond what the small difference of the tool's places asks of them."""
        J = self.chart.jacobian(self.q)[: len(x)]
        return float(np.abs(self.q - q - np.linalg.pinv(J) @ (x - there)).max())

    def _held(self, t: float) -> Array:
        """xi_d with two derivatives, (3, r), t after the last hand-over."""
        xi, v, a = self._xi
        rise, decay = a + _RATE * v, np.exp(-_RATE * t)
        gone = v * (1 - decay) / _RATE + rise * (1 - decay * (1 + _RATE * t)) / _RATE**2
        return np.stack([xi + gone, (v + rise * t) * decay, (rise - _RATE * (v + rise * t)) * decay])


@dataclass(frozen=True)
class Command:
    """What a law says at one instant."""

    torque: Array  #: (n,) [N m] or [N]
    status: int  #: `ControlStatus`
    storage: float  #: energy of robot and springs as the law sees it [J]
    dissipated: float  #: power of its damping [W]


class AtlasLaw(Protocol):
    """A torque law that follows a posture through the charts of an atlas."""

    @property
    def atlas(self) -> Atlas:
        """The atlas."""
        ...

    @property
    def name(self) -> str:
        """Short name."""
        ...

    def command(self, q: Array, dq: Array, asked: AskedPosture) -> Command:
        """The torque for a state and the posture asked for, whose chart is that of q."""
        ...


def require_atlas_law(law: AtlasLaw) -> None:
    """Raise InvalidValueError for an object without the attributes of a law on an atlas."""
    if isinstance(law, type) or not (isinstance(getattr(law, "atlas", None), Atlas) and hasattr(law, "command")):
        raise InvalidValueError("law", f"a {type(law).__name__}", "a law on an atlas, such as BlendedImpedance")


@dataclass(frozen=True, eq=False, repr=False)
class HandedOver(Shown):
    """A law of charts, for example `lambda chart: oc.control.PDPlus(chart, 60.0)`, in the chart of the moment.

    References are mapped with velocity and acceleration at hand-overs. The torque changes there by the difference of
    the springs' shapes, which is as small as the tracking error. V jumps by the difference of the springs' energies.

    Args:
        atlas: the atlas.
        law: builds the law of a chart. Gains refer to the coordinates of the chart. For pickles, a function of a module
            or `functools.partial(oc.control.PDPlus, stiffness=60.0)`.

    Raises:
        InvalidValueError: if `atlas` is no atlas, or `law` cannot be called.
    """

    atlas: Atlas
    law: Callable[[Chart], Controller]

    def __post_init__(self) -> None:
        require_kind("atlas", self.atlas, Atlas)
        if not callable(self.law):
            raise InvalidValueError("law", f"a {type(self.law).__name__}", "a function of a chart")

    @property
    def name(self) -> str:
        """The name of the law of charts."""
        return next(iter(self._laws.values())).name if self._laws else "law of charts"

    def command(self, q: Array, dq: Array, asked: AskedPosture) -> Command:
        """The torque of the law of the chart."""
        law = self._of(asked)
        inputs = (q, dq, *asked.phi, *law.gains.values())
        torque, status = law.function.call([*inputs])
        storage, power = (0.0, 0.0) if law.energy is None else (float(v) for v in law.energy.call([*inputs]))
        return Command(np.array(torque).ravel(), int(status), storage, power)

    def facts(self) -> dict[str, str]:
        """The law of charts, and the atlas."""
        return {"law": self.name, **self.atlas.facts()}

    @cached_property
    def _laws(self) -> dict[int, Controller]:
        return {}

    def _of(self, asked: AskedPosture) -> Controller:
        with building:  # threads may share the law
            law = self._laws.get(asked.number)
            if law is None:
                law = self.law(asked.chart)
                if law.command != "torque":
                    raise InvalidValueError("law", f"one that commands {law.command}", "a torque law")
                if memory_of(law) is not None:
                    raise InvalidValueError("law", "one with a memory", "one without, because a memory is of one chart")
                while len(self._laws) >= _LAWS:
                    self._laws.pop(next(iter(self._laws)))
                self._laws[asked.number] = law
            return law


@dataclass(frozen=True, eq=False)
class Blend:
    """w_k(q) = b_k / sum_j b_j, b_k = prod_i s((1 - |u_i|) / (1 - u_0)), with u on the cube of the box of chart k.

    s rises from s(0) = 0 to s(1) = 1 with two continuous derivatives, s(t) = 6 t^5 - 15 t^4 + 10 t^3. It is 1 where the
    box does not reach into its neighbours of the same size: |u| <= u_0 = (1 - overlap) / (1 + overlap). So w_k is twice
    continuously differentiable inside the union of the boxes, away from its boundary.
    """

    index: Index
    _neighbours: dict[int, Indices] = field(default_factory=dict)

    def at(self, q: Array, near: int) -> tuple[Indices, Array, Array]:
        """Charts whose boxes hold a position (n,), their weights (K,), and the gradients of the weights (K, n).

        Args:
            q: the position.
            near: one of these charts.
        """
        index, joints = self.index, list(self.index.plan.joints)
        charts = self._around(near)
        points = np.repeat(q[None, joints], len(charts), axis=0)
        u = index.on_cube(points, charts)
        inside = np.flatnonzero((np.abs(u) < 1).all(axis=1))
        if not inside.size:
            return np.array([near]), np.ones(1), np.zeros((1, len(q)))
        charts, u = charts[inside], u[inside]
        values, slopes = self._bumps(u)
        bumps = values.prod(axis=1)
        rising = bumps[:, None] * slopes / np.maximum(values, 1e-300)
        rising *= np.sign(u) * self._signs[charts] / index.box_half_widths[index.rows(charts)[1]]
        gradients = np.zeros((len(charts), len(q)))
        gradients[:, joints] = rising
        total = bumps.sum()
        weights = bumps / total
        return charts, weights, (gradients - weights[:, None] * gradients.sum(axis=0)) / total

    def _bumps(self, u: Array) -> tuple[Array, Array]:
        """s and ds/d|u| for each joint."""
        overlap = self.index.plan.settings.overlap
        width = 2 * overlap / (1 + overlap)
        t = np.minimum((1 - np.abs(u)) / width, 1.0)
        return t**3 * (t * (6 * t - 15) + 10), -30 * t**2 * (t - 1) ** 2 / width

    def _around(self, near: int) -> Indices:
        """Charts whose boxes meet that of a chart, itself included."""
        known = self._neighbours.get(near)
        if known is None:
            lattice = self.index.plan.lattice
            apart = self._centres - self._centres[near]
            apart -= np.where(lattice.endless, 2 * np.pi * np.round(apart / (2 * np.pi)), 0.0)
            known = np.flatnonzero((np.abs(apart) <= self._half_widths + self._half_widths[near]).all(axis=1))
            with building:  # threads may share the blend
                while len(self._neighbours) >= _KEPT:
                    self._neighbours.pop(next(iter(self._neighbours)))
                self._neighbours[near] = known
        return known

    @cached_property
    def _centres(self) -> Array:
        return self.index.image_centres(np.arange(self.index.count))[0]

    @cached_property
    def _signs(self) -> Array:
        return self.index.image_centres(np.arange(self.index.count))[1]

    @cached_property
    def _half_widths(self) -> Array:
        return np.asarray(self.index.box_half_widths[self.index.rows(np.arange(self.index.count))[1]])


@dataclass(frozen=True, eq=False, repr=False)
class BlendedImpedance(Shown):
    """tau = g - J_x^T K_x e_x - sum_k (w_k J_k^T K e_k + V_k grad w_k) - D dq on overlapping charts k.

    The potential V(q) = 1/2 e_x^T K_x e_x + sum_k w_k(q) V_k(q), with V_k = 1/2 e_k^T K e_k, e_k = xi_k(q) - xi_k(q_d)
    and the weights of `Blend`, is a function of q alone, so the loop is passive for a posture q_d at rest: the energy
    1/2 dq^T M dq + V changes by -dq^T D dq. D = 2 zeta (M # S), with S = J_x^T K_x J_x + sum_k w_k J_k^T K J_k and the
    geometric mean #, is symmetric and positive semi-definite everywhere. There is no hand-over: the torque is a smooth
    function of q.

    Args:
        atlas: the atlas.
        stiffness: of the task, then of xi, (n,), > 0 [N/m, J]; every chart has the same.
        damping_ratio: zeta >= 0.
        limit: largest torque of each joint; default the effort limits of the robot.
    """

    atlas: Atlas
    stiffness: Array
    damping_ratio: float
    limit: Array

    name = "blended_impedance"

    def __init__(
        self, atlas: Atlas, stiffness: ArrayLike, damping_ratio: float = 0.7, limit: ArrayLike | None = None
    ) -> None:
        require_kind("atlas", atlas, Atlas)
        for name, value in {
            "atlas": atlas,
            "stiffness": positive_gains("stiffness", stiffness, atlas.problem.n),
            "damping_ratio": float(non_negative_gains("damping_ratio", damping_ratio, 1)[0]),
            "limit": command_limit("limit", limit, atlas.problem.robot.effort_limits),
        }.items():
            object.__setattr__(self, name, value)

    def command(self, q: Array, dq: Array, asked: AskedPosture) -> Command:
        """The torque; its spring is that of `potential`."""
        robot = self.atlas.problem.robot
        V, slope, S = self.potential(q, asked.q, asked.number)
        M = np.array(robot.mass_matrix(q))
        D = 2 * self.damping_ratio * _geometric_mean(M, S)
        wanted = np.array(robot.gravity(q)).ravel() - slope - D @ dq
        torque = np.clip(wanted, -self.limit, self.limit)
        status = ControlStatus.OK if np.array_equal(torque, wanted) else ControlStatus.SATURATED
        return Command(torque, int(status), float(V + dq @ M @ dq / 2), float(dq @ D @ dq))

    def potential(self, q: Array, q_asked: Array, near: int) -> tuple[float, Array, Array]:
        """V [J], dV/dq (n,), and the stiffness of the joints S (n, n), at a position.

        Args:
            q: the position (n,).
            q_asked: where V is zero, (n,).
            near: a chart whose box holds q.
        """
        problem = self.atlas.problem
        m, n = problem.m, problem.n
        charts, weights, rises = self._blend.at(q, near)
        K_x, K = self.stiffness[:m], self.stiffness[m:]
        both = np.stack([q, q_asked])
        e = np.subtract(*problem.task.batched(both)[0])
        J_x = problem.task.batched_jacobian(q[None])[0].reshape(m, n)
        k = len(charts)
        xi = self.atlas.xi(np.repeat(both, k, axis=0), np.tile(charts, 2))
        errors, J = xi[:k] - xi[k:], self.atlas.jacobian(np.tile(q, (k, 1)), charts)
        energies = (errors**2 @ K) / 2
        V = (e**2 @ K_x) / 2 + weights @ energies
        slope = J_x.T @ (K_x * e) + np.einsum("k,kri,kr->i", weights, J, K * errors) + energies @ rises
        S = (J_x.T * K_x) @ J_x + np.einsum("k,kri,r,krj->ij", weights, J, K, J)
        return float(V), slope, S

    def facts(self) -> dict[str, str]:
        """Gains, limits and the atlas."""
        gains = {"stiffness": number_list(self.stiffness), "damping ratio": f"{self.damping_ratio:g}"}
        return {"law": self.name, **gains, "limit": number_list(self.limit), **self.atlas.facts()}

    @cached_property
    def _blend(self) -> Blend:
        return Blend(self.atlas.index)


def _geometric_mean(A: Array, B: Array) -> Array:
    """A # B = A^1/2 (A^-1/2 B A^-1/2)^1/2 A^1/2 of SPD matrices; for B semi-definite, too."""
    values, vectors = np.linalg.eigh(A)
    root, back = ((vectors * values**power) @ vectors.T for power in (0.5, -0.5))
    inner, turned = np.linalg.eigh(back @ B @ back)
    return np.asarray(root @ (turned * np.sqrt(inner.clip(0))) @ turned.T @ root)
