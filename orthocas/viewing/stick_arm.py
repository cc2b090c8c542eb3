"""The look of a robot without mesh files: drums at the joints, rods between them, made from its kinematic tree."""

import numpy as np

from orthocas.checks import Array
from orthocas.robots.tree import KinematicTree
from orthocas.viewing.solids import FINE, Solid, ball, capsule, drum

Look = list[list[Solid]]  #: what each frame of `BodyPoses` carries: base, bodies, tip

SHELL, JOINT, TOOL = (226, 229, 233), (72, 80, 92), (214, 96, 20)
_THICK = 0.042  # radius of the first rod, as a share of the length of the chain
_TAPER = 0.45  # share of the radius that is lost on the way to the tip
_SHORT = 0.35  # radii below which a rod is left out


def stick_arm(tree: KinematicTree, thickness: float = 1.0, facets: int = FINE) -> Look:
    """Drums about the joint axes and tapered rods between the frames, thinner or thicker than usual by a factor."""
    look: Look = [[] for _ in range(tree.n + 2)]
    radii = thickness * _radii(tree)
    for i, parent in enumerate(tree.parents):
        r = radii[i + 1]
        look[i + 1].append(_joint(tree, i, r, facets))
        _add_rod(look[parent + 1], tree.translations[i], (radii[parent + 1], r), facets)
    r = radii[tree.tip_parent + 1]
    _add_rod(look[tree.tip_parent + 1], tree.tip_translation, (r, 0.75 * r), facets)
    look[-1].append(ball(0.55 * r, TOOL, facets))
    if np.linalg.norm(tree.translations[0]) > radii[0]:
        look[0].append(drum(1.7 * radii[0], 0.35 * radii[0], JOINT, facets))
    return look


def chain_length(tree: KinematicTree) -> float:
    """Length of the chain from the base to the tip, through all joint frames [m]."""
    length, i = float(np.linalg.norm(tree.tip_translation)), tree.tip_parent
    while i >= 0:
        length += float(np.linalg.norm(tree.translations[i]))
        i = tree.parents[i]
    return max(length, 1e-3)


def _radii(tree: KinematicTree) -> Array:
    """Radius of the rods that begin at the base and at each body, (n + 1,)."""
    total = chain_length(tree)
    run = np.zeros(tree.n + 1)
    for i, parent in enumerate(tree.parents):
        run[i + 1] = run[parent + 1] + np.linalg.norm(tree.translations[i])
    return np.asarray(_THICK * total * (1 - _TAPER * np.clip(run / total, 0.0, 1.0)))


def _joint(tree: KinematicTree, i: int, r: float, facets: int) -> Solid:
    """A drum about the axis of a revolute joint, or a slim rail along that of a prismatic one."""
    if tree.prismatic[i]:
        return drum(0.8 * r, 2.2 * r, JOINT, facets)
    return drum(1.18 * r, 1.3 * r, JOINT, facets)


def _add_rod(solids: list[Solid], end: Array, radii: tuple[float, float], facets: int) -> None:
    """A rod from the origin of a body to a point of it, unless it is hidden in the drums."""
    if np.linalg.norm(end) > _SHORT * radii[0]:
        solids.append(capsule(np.zeros(3), end, radii, SHELL, facets))
