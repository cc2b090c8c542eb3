"""Scenes: solids around a robot, by name."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

from orthocas.errors import InvalidValueError
from orthocas.robots.shapes import Shape
from orthocas.tools.checks import require_kind, require_text
from orthocas.tools.display import Shown, listed

__all__ = ["Scene", "Solid"]


@runtime_checkable
class Solid(Protocol):
    """A solid in the world, or in the frame of what carries it."""

    @property
    def heading(self) -> str:
        """The solid in a few words."""
        ...

    @property
    def shape(self) -> Shape:
        """The solid for collision checks."""
        ...


class Scene(Shown):
    """Solids around a robot, by name, in the frame of the world; see `Collisions.with_scene`.

    Args:
        solids: of `orthocas.obstacles`: boxes, spheres, capsules, planes, meshes and point clouds.

    Example:
        >>> import orthocas as oc
        >>> table = oc.obstacles.Box([0.6, 1.0, 0.02], [0.5, 0.0, 0.2])
        >>> scene = oc.Scene({"table": table, "post": oc.obstacles.Capsule([0.4, 0.3, 0.2], [0.4, 0.3, 0.9], 0.03)})
        >>> scene.names
        ('table', 'post')
    """

    def __init__(self, solids: Mapping[str, Solid]) -> None:
        require_kind("solids", solids, Mapping)
        for name, solid in solids.items():
            require_text("name of a solid", name)
            if isinstance(solid, type) or not isinstance(solid, Solid):
                raise InvalidValueError(f"solid '{name}'", f"a {type(solid).__name__}", "one of orthocas.obstacles")
        self.solids = MappingProxyType(dict(solids))

    def __reduce__(self) -> tuple[Any, ...]:
        return Scene, (dict(self.solids),)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the solids."""
        return tuple(self.solids)

    def facts(self) -> dict[str, str]:
        """The solids."""
        return {"scene": f"{len(self.solids)} solids: {listed(self.solids)}"} | {
            name: solid.heading for name, solid in self.solids.items()
        }
