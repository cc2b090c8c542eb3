"""All self-motion curves of a task value, r = 1, whatever the limits, and where limits cut them."""

import ctypes
from dataclasses import asdict, dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.native.curves import RULES
from orthocas.native.kernels import generate_kernels, get_source, render
from orthocas.native.libraries import keep_library, load_library, pointer
from orthocas.tasks.task import Frames, Task
from orthocas.tools.batch import dense_function, run_in_threads
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array

_FLAGS = ("-O3",)


@dataclass(frozen=True, eq=False)
class Curve:
    """A self-motion curve: points in order, a cubic between neighbouring points, and its crossings of limits."""

    q: Array  #: points (P, n), unwrapped; on a closed curve, the last equals the first up to full turns
    tangent: Array  #: unit tangents (P, n), with det [J; t] > 0
    length: Array  #: arc length from each point to the next, (P,); 0 at the last
    closed: bool
    crossings: NDArray[Any]  #: records `crossing_type` in order along the curve

    @cached_property
    def places(self) -> Array:
        """Length of the curve up to each point, (P,)."""
        return np.concatenate([[0.0], np.cumsum(self.length[:-1])])

    def point(self, place: float) -> tuple[Array, Array]:
        """The point at a place, exact at crossings, and the direction there, (n,) each."""
        k = int(np.clip(np.searchsorted(self.places, place, side="right") - 1, 0, len(self.places) - 2))
        h = float(self.length[k])
        q, t = evaluate_cubic(
            self.q[k], self.q[k + 1], self.tangent[k], self.tangent[k + 1], h, (place - self.places[k]) / h
        )
        # At a crossing, use its exact posture instead of the point on the cubic.
        at = np.flatnonzero(self.crossings["place"] == place)
        return (self.crossings["q"][at[0]] if at.size else q), t


def evaluate_cubic(
    a: Array, b: Array, start: Array, end: Array, h: Array | float, u: Array | float
) -> tuple[Array, Array]:
    """Points at fractions u of cubic curves of length h from a to b with unit tangents, and unit directions there."""
    d = b - a
    q = a + (3 * u * u - 2 * u**3) * d + h * ((u - 2 * u * u + u**3) * start + (u**3 - u * u) * end)
    slope = 6 * (u - u * u) * d + h * ((1 - 4 * u + 3 * u * u) * start + (3 * u * u - 2 * u) * end)
    return q, slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-300)


@dataclass(frozen=True, eq=False)
class StoredPostures:
    """Random postures within the limits, in the order of the branches, and where they are in x.

    Starts for a value x_d are the postures with the least |x - x_d|^2 det(J J^T)^(-1/m). Each self-motion curve then
    gets starts in proportion to its length, whatever its distance from singular positions.
    """

    q: Array  #: (S, n)
    places: NDArray[np.float32]  #: (k, S): distances between them are errors of x
    weights: NDArray[np.float32]  #: weights of squared distances, (S,)
    begins: NDArray[np.intc]  #: index of the first posture of each branch, then S


def crossing_type(n: int) -> np.dtype[Any]:
    """A record of a crossing: a joint, less full turns, is at its lowest (side 0) or highest (1) position."""
    fields: list[Any] = [("place", "f8"), ("q", "f8", (n,))]
    return np.dtype([*fields, *((name, "i4") for name in ("curve", "joint", "side", "turns", "rises"))], align=True)


@dataclass(frozen=True, eq=False)
class CurveKernel:
    """Finds curves and corrects points on them, in compiled C: runtime/self_motion.c. Threads may share it.

    Raises:
        CompileError, InvalidValueError: at the first call, if there is no C compiler, or no folder to keep the library.
    """

    equations: ca.Function
    lower: Array
    upper: Array
    turning: NDArray[np.bool_]

    def find_curves(self, target: Array, starts: Array, patience: int = RULES.patience) -> list[Curve]:
        """All curves of a target that starts (S, n) lead to, with their crossings of limits.

        The search ends after `patience` starts in turn that find no new curve.
        """
        n = len(self.lower)
        nodes = np.empty((RULES.nodes, 2 * n + 1))
        ends, closed = np.zeros(RULES.curves, dtype=np.intc), np.zeros(RULES.curves, dtype=np.intc)
        used = ctypes.c_int()
        # Points of all curves lie one after the other, with their ends.
        count = self._c.find_curves(
            *(pointer(target), pointer(starts), len(starts), patience, pointer(nodes), RULES.nodes),
            *(pointer(ends), pointer(closed), ctypes.byref(used)),
        )
        if not count:
            return []
        room = np.empty(RULES.crossings, crossing_type(n))
        size = self._c.find_crossings(
            pointer(target), pointer(nodes), pointer(ends), count, pointer(room), RULES.crossings
        )
        # Crossings come curve by curve, and are put in the order of places within each.
        nodes, crossings, curves, begin = nodes[: ends[count - 1]].copy(), room[:size].copy(), [], 0
        parts = np.searchsorted(crossings["curve"], np.arange(count + 1)).tolist()
        for k, end in enumerate(ends[:count].tolist()):
            own, part = crossings[parts[k] : parts[k + 1]], nodes[begin:end]
            own = own[np.argsort(own["place"], kind="stable")]
            curves.append(Curve(part[:, :n], part[:, n : 2 * n], part[:, 2 * n], bool(closed[k]), own))
            begin = end
        return curves

    def choose_starts(self, stored: StoredPostures, place: Array) -> Array:
        """Stored postures near a place of x, in turn from each branch, (S, n)."""
        count, branches = len(stored.q), len(stored.begins) - 1
        distance, single = np.empty(count, dtype=np.float32), place.astype(np.float32)
        chosen = np.empty(RULES.starts + branches, dtype=np.intc)
        total = self._c.choose_starts(
            *(pointer(stored.places), pointer(stored.weights), pointer(stored.begins), branches),
            *(len(stored.places), count, pointer(single), RULES.starts),
            *(pointer(distance), pointer(chosen)),
        )
        return stored.q[chosen[:total]]

    def choose_postures(self, targets: Array, starts: Array | None, stored: StoredPostures, places: Array) -> Array:
        """Postures (N, n) within the limits of targets (N, k), nearest to starts (N, n), or farthest from the limits.

        They are the best ones on all curves that stored postures and starts lead to; NaN where there is none.
        """
        count, n, branches = len(targets), len(self.lower), len(stored.begins) - 1
        q, most = np.empty((count, n)), RULES.starts + branches
        inputs = np.ascontiguousarray(targets), np.ascontiguousarray(places, dtype=np.float32)
        first = None if starts is None else np.ascontiguousarray(starts)
        known = [pointer(part) for part in (stored.q, stored.places, stored.weights, stored.begins)]

        def choose_piece(begin: int) -> None:
            rows = slice(begin, begin + RULES.piece)
            # Memory of C, which costs nothing where it is not used.
            memory = (
                *(np.empty((RULES.nodes, 2 * n + 1)), np.empty(RULES.crossings, crossing_type(n))),
                *(np.empty((RULES.samples, 2 * n + 2)), np.empty(len(stored.q), dtype=np.float32)),
                *(np.empty(most, dtype=np.intc), np.empty((most + 1, n))),
            )
            own = [pointer(part[rows]) for part in inputs]
            self._c.choose_rows(
                *(len(q[rows]), own[0], targets.shape[1], own[1], None if first is None else pointer(first[rows])),
                *(*known, branches, len(stored.places), len(stored.q), RULES.patience),
                *(*map(pointer, memory), pointer(q[rows])),
            )

        run_in_threads(choose_piece, range(0, count, RULES.piece))
        return q

    def correct(self, target: Array, q: Array, tangent: Array) -> NDArray[np.bool_]:
        """Bring points q (K, n) to their curve across tangents (K, n), both in place; return successes, (K,)."""
        good = np.empty(len(q), dtype=np.bool_)
        self._c.correct_rows(pointer(target), len(q), pointer(q), pointer(tangent), pointer(good))
        return good

    @cached_property
    def _c(self) -> Any:
        sources = write_curves(self.equations, self.lower, self.upper, self.turning)
        return load_library(keep_library("self-motion", sources, _FLAGS))


def write_curves(equations: ca.Function, lower: Array, upper: Array, turning: NDArray[np.bool_]) -> dict[str, str]:
    """C of the search for curves: kernels and tables of a task, and runtime/self_motion.c, which they include."""
    kernels = generate_kernels([equations], "kernel")
    values = {
        "kernels": kernels.code,
        "arrays": kernels.declare_arrays,
        "call": kernels.write_call,
        "n": len(lower),
        "rules": asdict(RULES),
        "low": lower,
        "high": upper,
        "turning": turning,
    }
    included = {name: get_source(name) for name in ("self_motion.c", "curve_math.c", "arc_postures.c")}
    return {"task_curves.c": render("task_curves.c", values), **included}


def build_equations(task: Task, scale: Array) -> ca.Function:
    """q (n, 1), target -> e (m, 1) and J (m, n), both divided by the scale; d(e)/dt = -J dq at e = 0.

    For tasks of a whole orientation, the target is the position, if the task has one, and the rotation (3, 3) by
    columns; e is the rotation vector to it in the axes of the task's frame, and J the geometric Jacobian. Other
    tasks compare values of x.
    """
    robot, turn = task.robot, task.turn
    q = ca.SX.sym("q", robot.n)
    if turn is None or not turn.whole:
        target = ca.SX.sym("target", task.m)
        e, J = target - task.function(q), task.jacobian_function(q)
    else:
        frames = Frames.from_recipe(task.recipe)
        p, R, J = (frames.build_function(robot, name)(q) for name in ("position", "rotation", "jacobian"))
        first = 3 if turn.with_position else 0
        target = ca.SX.sym("target", first + 9)
        # The rotation vector of R_d R^T: its axis times atan2(sine, cosine) / sine.
        across = ca.reshape(target[first:], 3, 3) @ R.T
        axis = ca.vertcat(across[2, 1] - across[1, 2], across[0, 2] - across[2, 0], across[1, 0] - across[0, 1]) / 2
        sine = ca.sqrt(ca.sumsqr(axis) + 1e-32)  # never zero, so that derivatives are finite
        e = ca.atan2(sine, (ca.trace(across) - 1) / 2) / sine * axis
        e, J = (ca.vertcat(target[:3] - p, e), J) if first else (e, J[3:, :])
    parts = [ca.cse(part / ca.repmat(ca.DM(scale), 1, part.shape[1])) for part in (e, J)]
    return dense_function("task", [q, target], parts, ["q", "target"])


def build_curvature(equations: ca.Function) -> ca.Function:
    """q (n, 1), target -> the second derivative of |e|^2 / 2, (n, n), with e from `build_equations`."""
    q, target = (ca.SX.sym(name, equations.size1_in(i)) for i, name in enumerate(("q", "target")))
    e, J = equations(q, target)
    # The gradient of |e|^2 / 2 is -J^T e.
    H = ca.jacobian(-J.T @ e, q)
    return dense_function("curvature", [q, target], [ca.cse((H + H.T) / 2)], ["q", "target"])
