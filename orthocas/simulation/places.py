"""Where pushes act: points of links."""

from orthocas.checks import Array, as_point, require_known
from orthocas.errors import InvalidValueError
from orthocas.robots import KinematicTree

Link = str | int | None  #: a link by the name or the index of the joint that moves it; None: the tip


def place_of(tree: KinematicTree, link: Link, point: Array) -> tuple[int, Array]:
    """Body and position (3,) [m] in its frame, for a point in the frame of a link, or of the tip.

    Raises:
        UnknownNameError, InvalidValueError: if the robot has no such link.
    """
    if link is None:
        return tree.tip_parent, as_point("point", tree.tip_translation + tree.tip_rotation @ point, 3)
    if isinstance(link, str):
        require_known("link, named by the joint that moves it,", link, tree.joint_names)
        return tree.joint_names.index(link), point
    if not 0 <= link < tree.n:
        raise InvalidValueError("link", link, f"the index of a joint, from 0 to {tree.n - 1}")
    return int(link), point
