"""3-D scenes with correct occlusion: everything becomes triangles of one collection, which is sorted by depth.

Matplotlib sorts only within a collection, so that a separate line is either completely in front of a surface or
completely behind it.
"""

from typing import Any

import numpy as np
from matplotlib.colors import to_rgba
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import ArrayLike

from orthocas.tools.checks import Array

from . import solids
from .painting import Isolines, Numbers, paint
from .style import GREY

Colour = str | tuple[float, ...] | Array
_AMBIENT = 0.6  # share of ambient light


class Scene:
    """Collects coloured triangles, and draws them."""

    def __init__(self) -> None:
        self._corners: list[Array] = []
        self._normals: list[Array] = []
        self._colours: list[Array] = []

    @property
    def corners(self) -> Array:
        """Corners of all triangles, (F, 3, 3)."""
        return np.concatenate(self._corners)

    @property
    def colours(self) -> Array:
        """RGBA of all triangles before shading, (F, 4)."""
        return np.concatenate(self._colours)

    def add_surface(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        colour: Colour,
        alpha: float = 1.0,
        lines: Isolines | None = None,
    ) -> None:
        """Add a triangle mesh.

        Args:
            vertices: (V, 3).
            faces: (F, 3).
            colour: one colour, or RGB or RGBA per face (F, 3 or 4).
            alpha: opacity.
            lines: isolines to paint on the mesh.
        """
        points, triples = np.asarray(vertices, dtype=float), np.asarray(faces)
        corners, normals = points[triples], _smooth_normals(points, triples)
        colours = _face_colours(colour, alpha, len(triples))
        if lines is not None:
            corners, colours, source = paint(corners, triples, lines, colours)
            normals = normals[source]
        self._corners.append(corners)
        self._normals.append(normals)
        self._colours.append(colours)

    def add_tube(self, points: ArrayLike, radius: float, colour: Colour) -> None:
        """Add a tube around a polyline (P, 3)."""
        self.add_surface(*solids.tube(points, radius), colour)

    def add_arrow(self, start: ArrayLike, vector: ArrayLike, radius: float, colour: Colour) -> None:
        """Add an arrow with a shaft of the given radius."""
        self.add_surface(*solids.arrow(start, vector, radius), colour)

    def add_ball(self, centre: ArrayLike, radius: float, colour: Colour) -> None:
        """Add a ball."""
        self.add_surface(*solids.ball(centre, radius), colour)

    def add_cube(self, low: ArrayLike, high: ArrayLike, radius: float, colour: Colour = GREY) -> None:
        """Add the twelve edges of a box."""
        ends = np.array([np.broadcast_to(low, 3), np.broadcast_to(high, 3)], dtype=float)
        for axis in range(3):
            for corner in np.ndindex(2, 2):
                first, second = np.insert(corner, axis, 0), np.insert(corner, axis, 1)
                edge = [ends[which, range(3)] for which in (first, second)]
                self.add_surface(*solids.straight_tube(edge[0], edge[1], radius), colour)

    def draw(self, axes: Any, view: tuple[float, float], low: ArrayLike, high: ArrayLike, zoom: float = 1.0) -> None:
        """Draw the scene in 3-D axes with the same scale on all three axes.

        Args:
            axes: matplotlib axes with projection="3d".
            view: elevation and azimuth of the camera [deg]; the light comes from above its left shoulder.
            low: lower corner of the visible box, one number or (3,).
            high: upper corner of the visible box.
            zoom: size of the picture within the axes.
        """
        shaded = _lit(np.concatenate(self._normals), self.colours, view)
        edges = np.where(shaded[:, 3:] < 1, [0.0, 0.0, 0.0, 0.0], shaded)  # hides hairlines between opaque faces
        faces = Poly3DCollection(self.corners, facecolors=shaded, edgecolors=edges, linewidths=0.18, clip_on=False)
        faces.set_rasterized(True)  # in vector graphics, whose text and lines stay lines
        axes.add_collection3d(faces)
        lower, upper = np.broadcast_to(low, 3), np.broadcast_to(high, 3)
        for letter, least, most in zip("xyz", lower, upper, strict=True):
            getattr(axes, f"set_{letter}lim")(least, most)
        axes.set_box_aspect(upper - lower, zoom=zoom)
        axes.set_proj_type("persp", focal_length=2.0)
        axes.view_init(elev=view[0], azim=view[1])


def _face_colours(colour: Colour, alpha: float, count: int) -> Array:
    """RGBA per face, (count, 4)."""
    if isinstance(colour, np.ndarray) and colour.ndim == 2:
        rgba = np.ones((count, 4))
        rgba[:, : colour.shape[1]] = colour
    else:
        rgba = np.tile(to_rgba(colour if isinstance(colour, str) else tuple(colour)), (count, 1))
    rgba[:, 3] *= alpha
    return rgba


def _smooth_normals(points: Array, faces: Numbers) -> Array:
    """Unit normal of each face, averaged over the neighbouring faces for smooth shading, (F, 3)."""
    corners = points[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    at_vertices = np.zeros_like(points)
    for k in range(3):
        np.add.at(at_vertices, faces[:, k], flat)
    normals = at_vertices[faces].sum(axis=1)
    unit: Array = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return unit


def _lit(normals: Array, colours: Array, view: tuple[float, float]) -> Array:
    """Lambert shading of both sides, (F, 4)."""
    elevation, azimuth = np.radians(view)
    towards = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    light = towards + 0.6 * np.cross(towards, right) - 0.5 * right
    light /= np.linalg.norm(light)
    shaded = colours.copy()
    shaded[:, :3] *= (_AMBIENT + (1 - _AMBIENT) * np.abs(normals @ light))[:, None]
    return shaded
