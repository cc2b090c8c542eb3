"""A load fixed to the tip: mass, centre of mass and inertia, as numbers."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, as_float_array, require_finite
from orthocas.errors import InvalidValueError
from orthocas.robots.tree import KinematicTree

PAYLOAD = 10  #: numbers of a payload
_FORMS = "a mass, (4,) mass and centre, or (10,) mass, centre and inertia Ixx, Ixy, Ixz, Iyy, Iyz, Izz"
_MATRIX = [0, 1, 2, 1, 3, 4, 2, 4, 5]  # places of Ixx, Ixy, Ixz, Iyy, Iyz, Izz in the matrix
_INDEFINITE = 1e-6  # of the largest entry, as rounded inertias of data sheets have


def payload_numbers(name: str, value: ArrayLike) -> Array:
    """The ten numbers of a payload, read-only.

    Args:
        name: for messages.
        value: mass [kg] of a point at the tip, (4,) with its centre in the tip frame [m], or (10,) with the inertia
            about that centre, in axes of the tip frame: Ixx, Ixy, Ixz, Iyy, Iyz, Izz [kg m^2].

    Raises:
        InvalidValueError: for another form, a negative mass, or an inertia that no body has.
    """
    given = np.atleast_1d(as_float_array(name, value))
    if given.shape not in ((1,), (4,), (PAYLOAD,)):
        raise InvalidValueError(f"shape of {name}", given.shape, _FORMS)
    require_finite(name, given)
    numbers = np.zeros(PAYLOAD)
    numbers[: len(given)] = given
    if numbers[0] < 0:
        raise InvalidValueError(f"mass of {name}", numbers[0], "a mass >= 0")
    inertia = numbers[4:][_MATRIX].reshape(3, 3)
    smallest = float(np.linalg.eigvalsh(inertia)[0])
    if smallest < -_INDEFINITE * np.abs(inertia).max():
        raise InvalidValueError(f"smallest principal inertia of {name}", smallest, "a number >= 0")
    numbers.setflags(write=False)
    return numbers


def with_payload(tree: KinematicTree, payload: ArrayLike) -> KinematicTree:
    """The tree with a payload merged into the body that carries the tip; unchanged if that is the base."""
    numbers, i = payload_numbers("payload", payload), tree.tip_parent
    mass, centre, inertia = tree.masses[i], tree.centres[i], tree.inertias[i]
    total = mass + numbers[0]
    if i < 0 or total == 0:
        return tree
    R = tree.tip_rotation
    added = tree.tip_translation + R @ numbers[1:4]
    together = (mass * centre + numbers[0] * added) / total
    turned = R @ numbers[4:][_MATRIX].reshape(3, 3) @ R.T
    inertia = inertia + turned + _steiner(mass, centre - together) + _steiner(numbers[0], added - together)
    return replace(
        tree,
        masses=_replaced(tree.masses, i, total),
        centres=_replaced(tree.centres, i, together),
        inertias=_replaced(tree.inertias, i, inertia),
    )


def _steiner(mass: float, offset: Array) -> Array:
    return np.asarray(mass * (offset @ offset * np.eye(3) - np.outer(offset, offset)))


def _replaced(values: Array, i: int, value: ArrayLike) -> Array:
    changed = values.copy()
    changed[i] = value
    return changed
