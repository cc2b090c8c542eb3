"""Charts of the base leaf S0 = {h(q) = x0}: linear, circle and disk leaves, and reading them from files."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NoReturn

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.errors import GrowError, InvalidValueError
from orthocas.exact.mesh import TriangleLocator, TriangleMesh, build_level_surface, map_to_disk
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import evaluate_samples, sample_uniform
from orthocas.tools.cached import building, cached_property
from orthocas.tools.checks import Array, Indices, freeze_array, freeze_indices, require_known, require_memory
from orthocas.tools.expressions import compute_determinant, wrap_shortest
from orthocas.tools.interrupts import deferred


@dataclass(frozen=True, slots=True)
class LeafRules:
    """Numbers of the charts of leaves."""

    on_leaf: float = 1e-6  #: largest distance of points that count as lying on the leaf [rad] or [m]
    disk_steps: int = 30  #: Newton steps from a triangle to the leaf
    on_disk: float = 1e-12  #: [rad] or [m] accepted distance from the leaf
    fewest_across: int = 5  #: fewest cells along the shortest edge of a region
    scale_samples: int = 1000  #: samples for measuring the size of the gradient
    stages: int = 8  #: intermediate points on the path to the coordinates of a linear leaf
    iterations: int = 10  #: Newton steps at each of these points
    solved: float = 1e-12  #: scaled residual of a solution
    on_curve: float = 1e-5  #: [rad]; a point farther from the curve belongs to another component of the leaf
    piece: float = 1.0  #: arc length per call of the integrator
    steps: int = 100  #: outputs per call of the integrator
    longest: float = 200.0  #: [rad], longest curve that is traced
    singular: float = 0.01  #: smallest singular value of J_x allowed on the curve, relative to the largest
    fewest: int = 20  #: fewest samples of a curve
    closings: int = 3  #: corrections of the length of a curve
    projections: int = 4  #: Gauss-Newton steps from the nearest sample to the nearest point of the curve


RULES = LeafRules()

CELLS = 60  #: default number of marching cubes cells along the longest edge of the region
SAMPLES = 2000  #: points on the curve; the spline through them is accurate to about 1e-12
Leaf = Literal["linear", "circle", "disk"]  #: kinds of base leaves


@dataclass(frozen=True, eq=False)
class LeafValues:
    """Coordinates of points on the base leaf."""

    xi: Array  #: (N, r)
    gradients: Array  #: d xi0 / dq along the leaf, (N, r, n)
    inside: NDArray[np.bool_]  #: whether the chart covers each point, (N,); other rows are meaningless


def find_turning_joints(problem: Problem) -> NDArray[np.bool_]:
    """Whether each joint position is an angle, (n,)."""
    return ~np.array(problem.robot.tree.prismatic, dtype=np.bool_)


def remove_turns(problem: Problem, differences: Array) -> Array:
    """Differences of joint positions, (..., n), with angles reduced to at most half a turn."""
    return np.asarray(wrap_shortest(differences, np.where(find_turning_joints(problem), 2 * np.pi, 0.0)))


def require_on_leaf(problem: Problem, level: Array, points: Array) -> None:
    """Raise InvalidValueError unless points (N, n) lie on the leaf h(q) = level (m,), relative to the size of J_x."""
    # Dividing an error of the task by the size of the gradients gives a distance.
    J = problem.task.evaluate_jacobian(points)
    off = np.abs(problem.task.batched(points)[0] - level).max(axis=1)
    size = np.sqrt((J**2).sum(axis=(1, 2)).mean())
    if not off.max() <= RULES.on_leaf * size:
        what = f"error of the task on the base leaf h(q) = {level.tolist()}"
        raise InvalidValueError(what, f"{off.max():.3g}", f"at most {RULES.on_leaf * size:.3g}")


@dataclass(frozen=True, eq=False)
class DiskLeaf:
    """xi0(q), the harmonic map of a triangulated leaf onto the unit disk, linear on every triangle.

    A point of the leaf gets the coordinates of the nearest point of the mesh. Between neighbouring triangles, the
    gradient jumps by an amount of the order of the cell size, and the value by the order of its third power.
    """

    problem: Problem = field(repr=False)
    level: Array  #: x0, (1,)
    region_centre: Array  #: (3,)
    region_half_width: Array  #: (3,)
    vertices: Array = field(repr=False)  #: (V, 3), on the leaf
    faces: Indices = field(repr=False)  #: (F, 3), indices of vertices
    disk: Array = field(repr=False)  #: images of the vertices, (V, 2)
    kind = "disk"
    turn = 0.0
    periodic = True

    def __post_init__(self) -> None:
        # Arrays may come from a file, so check shapes and indices, and that points lie on disk and leaf.
        count = len(self.vertices)
        shapes: dict[str, tuple[int | None, ...]] = {
            "level": (1,),
            "region_centre": (3,),
            "region_half_width": (3,),
            "vertices": (count, 3),
            "disk": (count, 2),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, freeze_array(name, getattr(self, name), shape))
        object.__setattr__(self, "faces", freeze_indices("faces", self.faces, (None, 3), count))
        # Check that the mesh is on the leaf, and its image in the disk.
        if not len(self.faces):
            raise InvalidValueError("faces", "empty", "at least one triangle")
        if np.linalg.norm(self.disk, axis=1).max() > 1 + 1e-9:
            raise InvalidValueError("disk", "outside the unit disk", "images of the vertices in the unit disk")
        require_on_leaf(self.problem, self.level, self.vertices)

    @property
    def region(self) -> Box:
        """The box that bounds the charted part of the leaf."""
        return Box(self.region_centre, self.region_half_width)

    @cached_property
    def mesh(self) -> TriangleMesh:
        """The leaf as triangles."""
        return TriangleMesh(self.vertices, self.faces)

    def values(self, points: Array) -> LeafValues:
        """Coordinates of points on the leaf, (N, 3)."""
        points = self.region_centre + remove_turns(self.problem, points - self.region_centre)
        located = self._in_space.locate(points)
        corners = self.disk[self.faces[located.face]]
        xi = np.einsum("sk,skr->sr", located.barycentric, corners)
        inside = (np.abs(points - self.region_centre) <= self.region_half_width + 1e-9).all(axis=1)
        return LeafValues(xi, self._gradients[located.face], np.asarray(inside))

    def points(self, xi: Array, near: Array | None = None) -> Array:
        """Points of the leaf with coordinates xi (N, 2) in the disk; NaN for xi outside.

        Each point moves from its triangle along the normal onto the leaf, so that `values` returns xi.
        """
        inside = np.hypot(xi[:, 0], xi[:, 1]) <= 1
        located = self._in_disk.locate(np.where(inside[:, None], xi, 0.0))
        corners = self.faces[located.face]
        feet = np.einsum("sk,skn->sn", located.barycentric, self.vertices[corners])
        normals = self._normals[located.face]
        # Newton's method along the normals of the triangles, for all points at once.
        height = np.zeros((len(xi), 1))
        for _ in range(RULES.disk_steps):
            q = feet + height * normals
            residual = self.problem.task.batched(q)[0] - self.level
            slope = (self.problem.task.batched_jacobian(q)[0].reshape(-1, 3) * normals).sum(axis=1, keepdims=True)
            height = height - residual / slope
            if np.abs(residual / slope).max(initial=0.0) < RULES.on_disk:
                break
        covered = inside & (located.distance < RULES.on_disk)
        return np.where(covered[:, None], feet + height * normals, np.nan)

    def to_arrays(self) -> Mapping[str, Array | Indices]:
        """All arrays, for chart files."""
        names = ("level", "region_centre", "region_half_width", "vertices", "faces", "disk")
        return {name: getattr(self, name) for name in names}

    @cached_property
    def _in_space(self) -> TriangleLocator:
        return TriangleLocator(self.vertices, self.faces)

    @cached_property
    def _in_disk(self) -> TriangleLocator:
        return TriangleLocator(self.disk, self.faces)

    @cached_property
    def _edges(self) -> tuple[Array, Array]:
        """Two edges of every triangle in space, (F, 2, 3), and in the disk, (F, 2, 2)."""
        first, *others = (self.faces[:, k] for k in range(3))
        # Edges from the first corner to the other two.
        in_space = np.stack([self.vertices[other] - self.vertices[first] for other in others], axis=1)
        in_disk = np.stack([self.disk[other] - self.disk[first] for other in others], axis=1)
        return in_space, in_disk

    @cached_property
    def _normals(self) -> Array:
        normals = np.cross(self._edges[0][:, 0], self._edges[0][:, 1])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    @cached_property
    def _gradients(self) -> Array:
        """Gradients G of the two coordinates on every triangle, (F, 2, 3): E G^T = edges in the disk, n G^T = 0."""
        in_space, in_disk = self._edges
        return np.asarray((np.linalg.pinv(in_space) @ in_disk).transpose(0, 2, 1))


def build_disk_leaf(problem: Problem, level: Array, region: Box, cells: int = CELLS) -> DiskLeaf:
    """Triangulate the part of a leaf inside a region, and map it onto the unit disk.

    Args:
        problem: a problem with n = 3 and m = 1.
        level: x0, (1,).
        region: box that bounds the charted part of the leaf.
        cells: number of cells along the longest edge of the region.

    Raises:
        GrowError: if n is not 3, m is not 1, or the shortest edge of the region has too few cells.
        NotADiskError: if that part of the leaf is not a disk. The message says what it is.
    """
    if (problem.n, problem.m) != (3, 1):
        raise GrowError(
            f"the problem has n = {problem.n} and m = {problem.m}, expected n = 3 and m = 1 for a disk leaf"
        )
    low, high = region.centre - region.half_width, region.centre + region.half_width
    across = cells * float(region.half_width.min() / region.half_width.max())
    if across < RULES.fewest_across:
        widths = (2 * region.half_width).round(4).tolist()
        raise GrowError(
            f"the region has edges {widths}, so {cells} cells along the longest give {across:.1f} along "
            f"the shortest, expected at least {RULES.fewest_across}"
        )
    require_memory(f"a mesh with {cells} cells", 40.0 * cells**3)
    task = problem.task
    points = sample_uniform(region, RULES.scale_samples, 0)
    # The scale makes units irrelevant.
    scale = float(np.sqrt((task.batched_jacobian(points)[0] ** 2).sum(axis=(1, 2)).mean()))
    mesh = build_level_surface(
        lambda q: task.batched(q)[0][:, 0] / scale,
        lambda q: task.batched_jacobian(q)[0].reshape(-1, 3) / scale,
        float(level[0]) / scale,
        low,
        high,
        cells,
    )
    disk = map_to_disk(mesh)
    return DiskLeaf(problem, level, region.centre, region.half_width, mesh.vertices, mesh.faces, disk)


@dataclass(frozen=True, eq=False)
class LinearLeaf:
    """xi0(q) = N^T (q - q0) for q on the leaf of q0, as in [AS2023] eq. (21).

    It is a chart where the leaf is a graph over its tangent space at q0. Its values are defined everywhere on the leaf.
    Where the leaf folds, the Jacobian of the grown chart loses rank, which `evaluate` reports.
    """

    problem: Problem = field(repr=False)
    level: Array  #: x0 = h(q0), (m,)
    centre: Array  #: q0, (n,)
    normals: Array = field(repr=False)  #: N, (n, r), unit columns with J_x(q0) A^-1(q0) N = 0
    kind = "linear"
    turn = 0.0
    periodic = False

    def __post_init__(self) -> None:
        n, m, r = self.problem.n, self.problem.m, self.problem.r
        for name, shape in (("level", (m,)), ("centre", (n,)), ("normals", (n, r))):
            object.__setattr__(self, name, freeze_array(name, getattr(self, name), shape))
        require_on_leaf(self.problem, self.level, self.centre[None])
        if np.abs(np.linalg.norm(self.normals, axis=0) - 1).max() > 1e-9:
            raise InvalidValueError("normals", self.normals.tolist(), "columns of length 1")

    def values(self, points: Array) -> LeafValues:
        """Coordinates of points on the leaf, (N, n)."""
        gradients = np.broadcast_to(self.normals.T, (len(points), *self.normals.T.shape))
        return LeafValues((points - self.centre) @ self.normals, gradients, np.ones(len(points), dtype=bool))

    def points(self, xi: Array, near: Array | None = None) -> Array:
        """Points of the leaf (N, n) with coordinates xi (N, r); NaN where no such point exists.

        Newton's method follows the straight line from the coordinates of `near`, or of q0, to xi, so that it stays on
        one sheet.
        """
        q = np.broadcast_to(self.centre, (len(xi), len(self.centre)))
        q = q if near is None else np.where(np.isfinite(near), near, q)
        # Follow the straight line to xi in steps, so that Newton's method stays on the sheet.
        start = (q - self.centre) @ self.normals
        N = np.broadcast_to(self.normals.T, (len(xi), *self.normals.T.shape))
        for fraction in np.linspace(0.0, 1.0, RULES.stages + 1)[1:]:
            for _ in range(RULES.iterations):
                residual = self._compute_residual(q, start + fraction * (xi - start))
                if np.abs(residual).max(initial=0.0) < RULES.solved:
                    break
                J = np.concatenate([self.problem.task.evaluate_jacobian(q) / self._scale, N], axis=1)
                q = q - (np.linalg.pinv(J) @ residual[:, :, None])[:, :, 0]
        solved = np.abs(self._compute_residual(q, xi)).max(axis=1) < 1e3 * RULES.solved
        return np.where(solved[:, None], q, np.nan)

    def to_arrays(self) -> Mapping[str, Array]:
        """All arrays, for chart files."""
        return {"level": self.level, "centre": self.centre, "normals": self.normals}

    def _compute_residual(self, q: Array, xi: Array) -> Array:
        x = self.problem.task.batched(q)[0]
        return np.concatenate([(x - self.level) / self._scale, (q - self.centre) @ self.normals - xi], axis=1)

    @cached_property
    def _scale(self) -> float:
        """Size of J_x at q0, which makes the units of the task irrelevant."""
        return float(np.linalg.norm(self.problem.task.evaluate_jacobian(self.centre[None])))


def build_linear_leaf(problem: Problem, centre: Array) -> LinearLeaf:
    """The leaf through a joint position (n,), with coordinates along its tangent space there."""
    points = centre[None]
    normals = (problem.metric.evaluate(points) @ evaluate_samples(problem, points).null_basis)[0]
    level = problem.task.batched(points)[0][0]
    return LinearLeaf(problem, level, centre, normals / np.linalg.norm(normals, axis=0))


@dataclass(frozen=True, eq=False)
class CircleLeaf:
    """xi0 = 2 pi l / L in (-pi, pi] on a closed curve of length L, where l is the arc length from the first sample.

    At the point opposite the first sample, xi0 jumps from pi to -pi, because no coordinate is smooth on a whole circle.
    """

    problem: Problem = field(repr=False)
    level: Array  #: x0, (m,)
    curve: Array = field(repr=False)  #: samples at equal arc lengths, (K + 1, n); the last equals the first up to turns
    length: Array  #: L, (1,)
    kind = "circle"
    turn = 2 * np.pi
    periodic = True

    def __post_init__(self) -> None:
        for name, shape in (("level", (self.problem.m,)), ("curve", (None, self.problem.n)), ("length", (1,))):
            object.__setattr__(self, name, freeze_array(name, getattr(self, name), shape))
        if len(self.curve) < RULES.fewest or not self.length[0] > 0:
            raise InvalidValueError("curve", f"{len(self.curve)} samples of length {self.length[0]}", "a closed curve")
        require_on_leaf(self.problem, self.level, self.curve)

    @property
    def cut(self) -> Array:
        """The point of the leaf where xi0 jumps from pi to -pi, (n,)."""
        return np.asarray(self._spline(self.length[0] / 2) + self._drift / 2)

    def values(self, points: Array) -> LeafValues:
        """Coordinates of points on the leaf, (N, n)."""
        nearest = self._tree.query(self._embed(points))[1]
        L = self.length[0]
        # Go from the nearest sample to the nearest point of the curve by Gauss-Newton steps.
        samples = self.curve[nearest]
        near = samples + remove_turns(self.problem, points - samples)
        along = nearest * L / (len(self.curve) - 1)
        for _ in range(RULES.projections):
            tangent = self._spline(along, 1) + self._drift / L
            away = near - self._evaluate(along)
            along = along + (tangent * away).sum(axis=1) / (tangent**2).sum(axis=1)
        tangent = self._spline(along, 1) + self._drift / L
        inside = np.linalg.norm(near - self._evaluate(along), axis=1) < RULES.on_curve
        xi = np.pi - (np.pi - 2 * np.pi * along / L) % (2 * np.pi)
        gradients = 2 * np.pi / L * tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
        return LeafValues(xi[:, None], gradients[:, None, :], inside)

    def points(self, xi: Array, near: Array | None = None) -> Array:
        """Points of the leaf with coordinates xi (N, 1) in [-pi, pi]; both ends are one point. NaN for other xi."""
        along = xi[:, 0] * self.length[0] / (2 * np.pi)
        return np.where(np.abs(xi) <= np.pi + 1e-9, self._evaluate(along), np.nan)

    def to_arrays(self) -> Mapping[str, Array]:
        """All arrays, for chart files."""
        return {"level": self.level, "curve": self.curve, "length": self.length}

    @cached_property
    def _drift(self) -> Array:
        """Full turns of the joints along the curve, (n,) [rad]."""
        return np.asarray(self.curve[-1] - self.curve[0])

    @cached_property
    def _spline(self) -> Any:
        """A spline of the curve minus its drift, periodic in the arc length."""
        fractions = np.linspace(0.0, 1.0, len(self.curve))[:, None]
        periodic = self.curve - fractions * self._drift
        periodic[-1] = periodic[0]
        return scipy.interpolate.CubicSpline(fractions[:, 0] * self.length[0], periodic, bc_type="periodic")

    def _evaluate(self, along: Array) -> Array:
        return np.asarray(self._spline(along) + along[:, None] / self.length[0] * self._drift)

    @cached_property
    def _tree(self) -> Any:
        return scipy.spatial.cKDTree(self._embed(self.curve[:-1]))

    def _embed(self, points: Array) -> Array:
        """Map angles to points on circles, so that full turns do not matter."""
        turning = find_turning_joints(self.problem)
        angles = points[:, turning]
        return np.concatenate([np.cos(angles), np.sin(angles), points[:, ~turning]], axis=1)


def trace_circle_leaf(problem: Problem, level: Array, start: Array) -> CircleLeaf:
    """Trace the leaf from one of its points until it closes.

    Args:
        problem: a problem with r = 1.
        level: x0, (m,).
        start: a point of the leaf, where xi0 = 0, (n,).

    Raises:
        GrowError: if the leaf is too long to close, or runs into a singularity.
    """
    trace = _build_tracer(problem, level, RULES.steps)
    q, travelled, step = start, 0.0, RULES.piece / RULES.steps
    while travelled < RULES.longest:
        piece = trace(q, RULES.piece)
        away = remove_turns(problem, piece[1:] - start)
        # Arc length to the start. The curve closes where it is near the start and about to pass it.
        left = -(np.diff(piece, axis=0) * away).sum(axis=1) / step
        back = np.flatnonzero((np.linalg.norm(away, axis=1) < 2 * step) & (left >= 0))
        if back.size:
            k = int(back[-1])
            return _close_circle(problem, level, start, travelled + (k + 1) * step + left[k])
        q, travelled = piece[-1], travelled + RULES.piece
    raise GrowError(f"the base leaf h(q) = {level.tolist()} does not close within {RULES.longest:g} rad of arc length")


def _close_circle(problem: Problem, level: Array, start: Array, length: float) -> CircleLeaf:
    """Trace the leaf once around, and correct its length."""
    trace = _build_tracer(problem, level, SAMPLES)
    for _ in range(RULES.closings):
        curve = trace(start, length)
        last = curve[-1] - curve[-2]
        length -= float(last @ remove_turns(problem, curve[-1] - start)) / float(np.linalg.norm(last))
    curve = trace(start, length)
    sizes = np.linalg.svd(problem.task.evaluate_jacobian(curve), compute_uv=False)
    # The integrator may step over a singular point.
    if sizes[:, -1].min() < RULES.singular * sizes[:, 0].max():
        _raise_singular(level)
    return CircleLeaf(problem, level, curve, np.array([length]))


def _raise_singular(level: Array) -> NoReturn:
    raise GrowError(f"the base leaf h(q) = {level.tolist()} runs into a singularity of the task")


def _build_tracer(problem: Problem, level: Array, steps: int) -> Callable[[Array, float], Array]:
    """A map (point, length) -> points at equal arc lengths (steps + 1, n) along the leaf, integrated by SUNDIALS.

    The curve follows the unit vector orthogonal to all task gradients. The term -J_x^# (h - x0) keeps it on the leaf.
    """
    q, length = ca.SX.sym("q", problem.n), ca.SX.sym("length")
    # Compute the unit vector by cofactors, and the correction towards the leaf.
    J = problem.task.jacobian_function(q)
    others = [[k for k in range(problem.n) if k != i] for i in range(problem.n)]
    across = ca.vertcat(*((-1) ** (i + 1) * compute_determinant(J[:, columns]) for i, columns in enumerate(others)))
    home = J.T @ ca.solve(J @ J.T, problem.task.function(q) - level)
    rate = length * (across / ca.norm_2(across) - home)
    grid = np.linspace(0.0, 1.0, steps + 1)
    options = {"abstol": 1e-12, "reltol": 1e-12, "max_num_steps": 100_000, "disable_internal_warnings": True}
    with building:
        integrator = ca.integrator(
            "trace", "cvodes", {"x": q, "p": length, "ode": rate}, 0.0, grid[1:].tolist(), options
        )

    # The integrator fails where the gradients lose rank.
    def trace(start: Array, span: float) -> Array:
        try:
            with deferred():
                points = np.asarray(integrator(x0=start, p=span)["xf"]).T
        except RuntimeError:
            points = np.full((steps, problem.n), np.nan)
        if not np.isfinite(points).all():
            _raise_singular(level)
        return np.vstack([start, points])

    return trace


LeafChart = LinearLeaf | CircleLeaf | DiskLeaf  #: a chart xi0 of the base leaf
LEAVES: dict[str, type[LinearLeaf] | type[CircleLeaf] | type[DiskLeaf]] = {
    kind.kind: kind for kind in (LinearLeaf, CircleLeaf, DiskLeaf)
}


def read_leaf(problem: Problem, kind: str, arrays: Mapping[str, NDArray[Any]]) -> LeafChart:
    """Rebuild the chart of a leaf from its arrays.

    Raises:
        UnknownNameError: if no kind of leaf has this name.
        ShapeError: if an array has the wrong shape.
    """
    require_known("leaf", kind, LEAVES)
    return LEAVES[kind](problem, **arrays)
