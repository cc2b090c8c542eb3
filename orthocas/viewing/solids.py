"""Solids that robots are drawn from: triangles with one colour, in the frame of a body."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from orthocas.checks import Array, Indices
from orthocas.robots.spatial import rotation_z_to

Colour = tuple[int, int, int]  #: red, green, blue, 0 to 255

FINE, COARSE = 24, 6  #: facets around an axis


@dataclass(frozen=True, eq=False)
class Solid:
    """Triangles of one colour."""

    vertices: Array  #: (V, 3) in the frame of the body [m]
    faces: Indices  #: (F, 3) rows of vertices, counterclockwise from outside
    colour: Colour

    def moved(self, rotation: Array, translation: Array) -> "Solid":
        """The solid turned by a rotation (3, 3), then shifted by a translation (3,)."""
        return replace(self, vertices=self.vertices @ rotation.T + translation)


def joined(solids: Sequence[Solid], colour: Colour) -> Solid:
    """All triangles of some solids as one, in one colour."""
    first = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    faces = [solid.faces + start for solid, start in zip(solids, first, strict=False)]
    return Solid(np.concatenate([solid.vertices for solid in solids]), np.concatenate(faces), colour)


def by_colour(solids: Sequence[Solid]) -> list[Solid]:
    """One solid for each colour, which is faster to draw than many."""
    colours = dict.fromkeys(solid.colour for solid in solids)
    return [joined([solid for solid in solids if solid.colour == colour], colour) for colour in colours]


def capsule(start: Array, end: Array, radii: tuple[float, float], colour: Colour, facets: int = FINE) -> Solid:
    """A rod with round ends from one point (3,) to another, with a radius at each end [m]."""
    length = float(np.linalg.norm(end - start))
    low, high = (
        _arc(radii[0], -np.pi / 2, 0.0, facets),
        _arc(radii[1], 0.0, np.pi / 2, facets) + np.array([0.0, length]),
    )
    axis = np.array([0.0, 0.0, 1.0]) if length == 0 else (end - start) / length
    return _revolved(np.concatenate([low, high]), colour, facets).moved(rotation_z_to(axis), start)


def drum(radius: float, half_height: float, colour: Colour, facets: int = FINE) -> Solid:
    """A cylinder with rounded edges about the z axis, with its middle at the origin."""
    edge = 0.25 * min(radius, half_height)
    lower, upper = _arc(edge, -np.pi / 2, 0.0, facets), _arc(edge, 0.0, np.pi / 2, facets)
    shift = np.array([radius - edge, half_height - edge])
    rim = np.concatenate([lower + shift * [1, -1], upper + shift])
    return _revolved(np.concatenate([[[0.0, -half_height]], rim, [[0.0, half_height]]]), colour, facets)


def block(size: Array, colour: Colour) -> Solid:
    """A box of a size (3,) [m] with its middle at the origin. Faces share no vertices, so that edges look sharp."""
    vertices: list[Array] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            across = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)[:: int(sign)]
            corner = np.insert(across, 0, sign, axis=1)
            faces += [[4 * len(vertices) + k for k in triple] for triple in ((0, 1, 2), (0, 2, 3))]
            vertices.append(np.roll(corner, axis, axis=1))
    return Solid(np.concatenate(vertices) * np.asarray(size) / 2, np.array(faces), colour)


def ball(radius: float, colour: Colour, facets: int = FINE) -> Solid:
    """A sphere about the origin."""
    return _revolved(_arc(radius, -np.pi / 2, np.pi / 2, facets), colour, facets)


def _arc(radius: float, start: float, end: float, facets: int) -> Array:
    """Points (r, z) on an arc about the origin."""
    count = max(round(facets * (end - start) / (2.5 * np.pi)), 1) + 1
    angle = np.linspace(start, end, count)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _revolved(profile: Array, colour: Colour, facets: int) -> Solid:
    """A profile of points (r, z), from bottom to top, turned about the z axis."""
    angle = np.linspace(0.0, 2 * np.pi, facets, endpoint=False)
    r, z = profile.T
    ring = np.stack([np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle)), np.outer(z, np.ones_like(angle))], axis=-1)
    index = np.arange(len(profile) * facets).reshape(len(profile), facets)
    here, next_ = index, np.roll(index, -1, axis=1)
    lower = np.stack([here[:-1], next_[:-1], next_[1:]], axis=-1).reshape(-1, 3)
    upper = np.stack([here[:-1], next_[1:], here[1:]], axis=-1).reshape(-1, 3)
    return Solid(ring.reshape(-1, 3), np.concatenate([lower, upper]), colour)
