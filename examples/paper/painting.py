"""Paints lines of constant value on triangles by cutting the triangles along both edges of every line."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocas.tools.checks import Array

Numbers = NDArray[np.intp]  #: indices of vertices or triangles


@dataclass(frozen=True, eq=False)
class Isolines:
    """Lines of constant value on a surface."""

    values: Array  #: values at the vertices, (V,)
    levels: Array  #: (L,)
    colours: Array  #: of the levels, RGBA, (L, 4)
    width: float  #: in units of the surface


def paint(corners: Array, faces: Numbers, lines: Isolines, colours: Array) -> tuple[Array, Array, Numbers]:
    """Cut triangles along lines, and colour the parts inside the lines.

    Args:
        corners: vertices of triangles, (F, 3, 3).
        faces: vertex indices of the triangles, (F, 3).
        lines: the lines to paint.
        colours: RGBA of the triangles, (F, 4).

    Returns:
        Corners (G, 3, 3), colours (G, 4), and the original triangle of each part (G,).
    """
    values = lines.values[faces]
    half = lines.width / 2 * np.maximum(_slopes(corners, values), 1e-3 * np.ptp(lines.values) / max(np.ptp(corners), 1))
    pieces = np.concatenate([corners, values[..., None]], axis=2)
    source: Numbers = np.arange(len(corners))
    for level in lines.levels:
        for edge in (-1.0, 1.0):
            pieces, source = cut(pieces, source, level + edge * half[source])
    middle = pieces[..., 3].mean(axis=1)
    painted = colours[source]
    for level, colour in zip(lines.levels, lines.colours, strict=True):
        painted[np.abs(middle - level) < half[source]] = colour
    return pieces[..., :3], painted, source


def cut(pieces: Array, source: Numbers, levels: Array) -> tuple[Array, Numbers]:
    """Cut triangles where a function, linear on each triangle, crosses a level.

    Args:
        pieces: corners with the value of the function in the last column, (F, 3, 4).
        source: an index that the parts inherit, (F,).
        levels: one level per triangle, (F,).

    Returns:
        Pieces (G, 3, 4) and their indices (G,).
    """
    above = pieces[..., 3] > levels[:, None]
    count = above.sum(axis=1)
    crossed = (count == 1) | (count == 2)
    rows = np.flatnonzero(crossed)
    lone = np.argmax(above[rows] == (count[rows] == 1)[:, None], axis=1)  # the corner alone on its side
    a, b, c = (pieces[rows, (lone + k) % 3] for k in range(3))
    p, q = (_between(a, end, levels[rows]) for end in (b, c))
    parts = [np.stack(part, axis=1) for part in ((a, p, q), (p, b, c), (p, c, q))]
    return np.concatenate([pieces[~crossed], *parts]), np.concatenate([source[~crossed], *3 * [source[rows]]])


def _between(a: Array, b: Array, levels: Array) -> Array:
    """The point of each edge where the last column equals the level."""
    share = (levels - a[:, 3]) / (b[:, 3] - a[:, 3])
    point: Array = a + share[:, None] * (b - a)
    point[:, 3] = levels
    return point


def _slopes(corners: Array, values: Array) -> Array:
    """Length of the gradient of a linear function on each triangle, (F,); 0 for triangles without area."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    rise = np.stack([values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]], axis=1)
    edges = np.stack([first, second], axis=1)  # (F, 2, 3)
    gram = edges @ edges.transpose(0, 2, 1)
    slope: Array = np.sqrt(np.maximum(np.einsum("fi,fij,fj->f", rise, np.linalg.pinv(gram, hermitian=True), rise), 0))
    return slope
