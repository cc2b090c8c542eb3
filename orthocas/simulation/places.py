"""Where pushes act: points of links."""

from typing import NamedTuple

import numpy as np

from orthocas.checks import Array, require_known
from orthocas.errors import InvalidValueError
from orthocas.robots import KinematicTree

Link = str | int | None  #: a link, by the name or the index of the joint that moves it; None: the tip


class Place(NamedTuple):
    """A point of a body."""

    body: int  #: index of the joint that moves it, -1 for the base
    point: tuple[float, float, float]  #: in the frame of the body in `KinematicTree` [m]


def place_of(tree: KinematicTree, link: Link, point: Array) -> Place:
    """The place of a point (3,) in the frame of a link, or of the tip.

    Raises:
        UnknownNameError, InvalidValueError: if the robot has no such link.
    """
    if link is None:
        x, y, z = tree.tip_translation + tree.tip_rotation @ point
        return Place(tree.tip_parent, (float(x), float(y), float(z)))
    if isinstance(link, str):
        require_known("link, named by the joint that moves it,", link, tree.joint_names)
        link = tree.joint_names.index(link)
    require_link(link, tree.n)
    return Place(int(link), tuple(point.tolist()))


def require_link(link: object, n: int | None = None) -> None:
    """Raise InvalidValueError unless the link is a name, None, or an index (of n joints, if n is known)."""
    if link is None or isinstance(link, str):
        return
    whole = isinstance(link, int | np.integer) and not isinstance(link, bool)
    if not whole or link < 0 or (n is not None and link >= n):  # type: ignore[operator]
        most = "" if n is None else f" from 0 to {n - 1}"
        raise InvalidValueError("link", repr(link)[:80], f"the name of a joint, or the index of one{most}")
