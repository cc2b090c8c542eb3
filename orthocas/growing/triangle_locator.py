"""The closest point on a triangle mesh to each of many points."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from orthocas.casadi_tools.batch import THREADS
from orthocas.checks import Array, frozen_array, require_shape
from orthocas.errors import InvalidValueError
from orthocas.growing.triangle_mesh import Indices

Mask = NDArray[np.bool_]

_FIRST = 8  # pieces of triangles near a query that are looked at first
_WIDEN = 4  # times as many in the next round
_PAIRS = 400_000  # pairs of query and piece held at once; about 300 bytes each
_FLAT = 1e-28  # (height / longest edge)^2 below this is rounding: such a triangle is its edges
_EDGES = ((0, 1), (1, 2), (2, 0))


class Located(NamedTuple):
    """Closest points on a mesh.

    The point is barycentric[i] @ vertices[faces[face[i]]].
    """

    face: Indices  #: (N,)
    barycentric: Array  #: (N, 3), >= 0, sums of 1
    distance: Array  #: (N,)


class TriangleLocator:
    """Finds closest points on a mesh.

    Every triangle is cut into pieces of similar radius, a k-d tree holds their centroids. The k pieces with the
    nearest centroids give a distance d. No other piece is closer if d <= D - R, where D is the distance of the k-th
    centroid and R the largest radius of a piece around its centroid; otherwise k grows.

    Args:
        vertices: (V, 2) or (V, 3), finite.
        faces: (F, 3) indices of vertices; triangles without area count as what they are, segments and points.

    Raises:
        ShapeError: if an array has another shape.
        InvalidValueError: if there is no triangle, or a vertex is not finite, or does not exist.

    Source:
        The nearest face by a k-d tree: [AS2023] Sec. 5.2. The proof of the closest one is ours:
        docs/derivations.md#disk-chart.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        points = frozen_array("vertices", vertices, (None, None))
        if points.shape[1] not in (2, 3):
            require_shape("vertices", points.shape, (None, 3))
        corners = np.asarray(faces, dtype=np.int64)
        require_shape("faces", corners.shape, (None, 3))
        if not len(corners) or not 0 <= corners.min() <= corners.max() < len(points):
            raise InvalidValueError("faces", f"{len(corners)} triangles", f"at least one, of {len(points)} vertices")
        self._corners = points[corners]  # (F, 3, d)
        pieces, self._face = _cut(self._corners)
        centroids = pieces.mean(axis=1)
        self._radius = _radii(pieces)
        self._tree = cKDTree(centroids)

    def locate(self, points: Array) -> Located:
        """Closest points on the mesh to points (N, d), finite."""
        require_shape("points", points.shape, (None, self._corners.shape[2]))
        count = len(points)
        result = Located(np.zeros(count, dtype=np.int64), np.zeros((count, 3)), np.full(count, np.inf))
        open_, k = np.arange(count), min(_FIRST, self._tree.n)
        while len(open_):
            chunks = np.array_split(open_, -(-len(open_) * k // _PAIRS))
            open_ = np.concatenate([chunk[~self._search(points[chunk], k, chunk, result)] for chunk in chunks])
            k = min(_WIDEN * k, self._tree.n)
        return result

    def _search(self, points: Array, k: int, rows: Indices, result: Located) -> Mask:
        """Look at the k nearest pieces of each point, store the closest points, and tell which are proven closest."""
        reach, piece = (a.reshape(len(points), k) for a in self._tree.query(points, k, workers=THREADS))
        nearest = self._face[piece[:, 0]]
        first = closest_on_triangles(points, self._corners[nearest])[1]
        promising = reach - self._radius[piece] <= first[:, None]
        promising[:, 0] = True  # whatever rounding says
        query, place = np.nonzero(promising)
        face = self._face[piece[query, place]]
        barycentric, distance = closest_on_triangles(points[query], self._corners[face])
        order = np.lexsort((face, distance, query))
        best = order[np.unique(query[order], return_index=True)[1]]
        for target, source in zip(result, (face, barycentric, distance), strict=True):
            target[rows] = source[best]
        proven: Mask = (distance[best] <= reach[:, -1] - self._radius.max()) | (k == self._tree.n)
        return proven


def closest_on_triangles(points: Array, triangles: Array) -> tuple[Array, Array]:
    """Barycentric coordinates (N, 3) of the point of each triangle (N, 3, d) closest to its point (N, d), and distance.

    The foot of the perpendicular if it lies inside, otherwise the closest point of the three edges.
    """
    barycentric = _foot(points, triangles)
    distance = np.where(barycentric.min(axis=1) >= 0, _distance(points, triangles, barycentric), np.inf)
    for i, j in _EDGES:
        edge = triangles[:, j] - triangles[:, i]
        square = np.einsum("nd,nd->n", edge, edge)
        along = np.einsum("nd,nd->n", points - triangles[:, i], edge) / np.where(square > 0, square, 1.0)
        on_edge = np.zeros((len(points), 3))
        on_edge[:, j] = np.clip(along, 0.0, 1.0)
        on_edge[:, i] = 1.0 - on_edge[:, j]
        length = _distance(points, triangles, on_edge)
        closer = length < distance
        barycentric[closer], distance[closer] = on_edge[closer], length[closer]
    return barycentric, distance


def _foot(points: Array, triangles: Array) -> Array:
    """Barycentric coordinates (N, 3) of the foot of the perpendicular; -1 for triangles without area."""
    a, b, p = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0], points - triangles[:, 0]
    aa, ab, bb, pa = (np.einsum("nd,nd->n", x, y) for x, y in ((a, a), (a, b), (b, b), (p, a)))
    safe = np.where(aa > 0, aa, 1.0)
    height = b - (ab / safe)[:, None] * a
    square = np.einsum("nd,nd->n", height, height)
    flat = (aa == 0) | (square <= _FLAT * bb)
    v = np.einsum("nd,nd->n", p, height) / np.where(flat, 1.0, square)
    u = (pa - v * ab) / safe
    foot = np.stack([1.0 - u - v, u, v], axis=1)
    foot[flat] = -1.0
    return foot


def _distance(points: Array, triangles: Array, barycentric: Array) -> Array:
    distance: Array = np.linalg.norm(np.einsum("nc,ncd->nd", barycentric, triangles) - points, axis=1)
    return distance


def _radii(triangles: Array) -> Array:
    """Largest distance of a corner from the centroid, (F,)."""
    radii: Array = np.linalg.norm(triangles - triangles.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    return radii


def _cut(triangles: Array) -> tuple[Array, Indices]:
    """Halve the widest triangles across their longest edge until there are about twice as many; pieces and faces."""
    face, pieces = np.arange(len(triangles)), triangles
    while True:
        radii = _radii(pieces)
        wide = radii > radii.max() / 1.5
        if radii.max() == 0 or len(pieces) + np.sum(wide) > 2 * len(triangles):
            return pieces, face
        pieces = np.concatenate([pieces[~wide], _halves(pieces[wide])])
        face = np.concatenate([face[~wide], np.tile(face[wide], 2)])


def _halves(triangles: Array) -> Array:
    """Both halves of triangles (N, 3, d) cut across their longest edge, (2 N, 3, d)."""
    lengths = np.linalg.norm(triangles[:, [2, 0, 1]] - triangles[:, [1, 2, 0]], axis=2)  # opposite corner 0, 1, 2
    corner = lengths.argmax(axis=1)[:, None]
    top, i, j = (np.take_along_axis(triangles, ((corner + c) % 3)[:, :, None], axis=1)[:, 0] for c in range(3))
    middle = (i + j) / 2
    return np.concatenate([np.stack([top, i, middle], axis=1), np.stack([top, middle, j], axis=1)])
