"""The gauge: fix what the loss leaves free, that is offset, scale, order and sign of the coordinates (ours)."""

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.coordinates.fitted import Coordinates
from orthocas.errors import InvalidValueError, OrthocasError
from orthocas.parametrisations import Parametrisation, ReorderableFamily
from orthocas.parametrisations.circle import CircleFamily
from orthocas.parametrisations.family import JointSpace
from orthocas.problem import Problem
from orthocas.samples import Samples

_DIGITS = 6  # of gradients at the centre that count for the order: fits end with about as many


def in_closed_form(problem: Problem, parametrisation: Parametrisation, samples: Samples) -> Coordinates:
    """Coordinates in closed form, which need no fit; see `orthocas.parametrisations.ClosedForm`."""
    assert parametrisation.closed_form is not None
    found = parametrisation.closed_form(problem)
    r = problem.r
    raw = Coordinates(parametrisation, JointSpace.of(problem), (), found.theta, np.zeros(r), np.ones(r))
    origin = problem.domain.centre if found.origin is None else found.origin
    scaled = normalised(raw, origin, samples)
    return scaled if found.scaled else replace(scaled, scale=np.ones(r))


def normalised(raw: Coordinates, origin: Array, samples: Samples) -> Coordinates:
    """Shift and scale fitted coordinates so that they vanish at the origin, and their mean gradient length is 1.

    Raises:
        OrthocasError: if the gradient of a coordinate vanishes on the domain.
    """
    r = len(raw.offset)
    if isinstance(raw.family, CircleFamily):  # an angle keeps its period
        return replace(raw, theta=raw.family.turned(raw.theta, raw.once("xi", origin[None, :])[0, :r]))
    lengths = np.linalg.norm(raw.once("jacobian", samples.points)[:, :r], axis=2).mean(axis=0)
    if not lengths.min() > 0:
        raise OrthocasError(f"coordinate {int(np.argmin(lengths))} has a vanishing gradient on the domain")
    return replace(raw, offset=raw.once("xi", origin[None, :])[0, :r], scale=1 / lengths)


def in_gauge(coordinates: Coordinates, centre: Array) -> Coordinates:
    """Reorder coordinates and choose their signs, independently of how a fit found them.

    Coordinates that move the first joints come first. They are sorted by the mean index of the joints that move,
    sum_k k g_k^2 / |g|^2, with the gradient g at the centre of the domain. The joint with the largest |g_k| moves in
    the positive direction. Coordinates that change places in the arm's mirror have the same mean; the one that moves
    the first joint on which they differ further comes first. Idle joints stay last.
    """
    g = coordinates.once("jacobian", centre[None, :])[0, : len(coordinates.offset)]
    size = (g**2).sum(axis=1)
    moved = (g**2 @ np.arange(g.shape[1])) / np.where(size > 0, size, 1.0)  # g = 0: a fold at the centre
    largest = np.take_along_axis(g, np.abs(g).argmax(axis=1)[:, None], axis=1)[:, 0]
    signs = np.where(largest < 0, -1.0, 1.0)
    keys = np.round(np.column_stack([moved, -signs[:, None] * g]), _DIGITS)
    return _rearranged(coordinates, np.lexsort(keys.T[::-1]), signs)


def aligned(coordinates: Coordinates, chart: Chart, samples: Samples) -> Coordinates:
    """Reorder coordinates and choose their signs so that they are closest to those of a chart.

    Each is matched with the coordinate of the chart whose gradient is most parallel, on average over samples.

    Raises:
        InvalidValueError: if the chart has other joints, another number of coordinates, or other idle joints.
    """
    fitted = len(coordinates.offset)
    if chart.n != coordinates.space.n or chart.r != coordinates.r:
        raise InvalidValueError(
            "align_to",
            f"a chart with n = {chart.n}, r = {chart.r}",
            f"one with n = {coordinates.space.n}, r = {coordinates.r}",
        )
    ours, theirs = (
        J / np.linalg.norm(J, axis=2, keepdims=True)
        for J in (coordinates.jacobian(samples.points)[:, :fitted], chart.coordinates.jacobian(samples.points))
    )
    parallel = np.einsum("sin,sjn->ij", ours, theirs[:, :fitted]) / len(samples)
    theirs_in_order, order = scipy.optimize.linear_sum_assignment(-np.abs(parallel.T))
    signs = np.sign(parallel.T[theirs_in_order, order])
    back = np.empty(fitted)
    back[order] = signs
    return _rearranged(coordinates, order, back)


def _rearranged(coordinates: Coordinates, order: NDArray[np.int_], signs: Array) -> Coordinates:
    """Coordinates in another order, each times a sign. Families that cannot be reordered keep their order.

    Args:
        coordinates: the coordinates.
        order: the old place of each new place.
        signs: signs of the coordinates in their old places.
    """
    family = coordinates.family
    if not isinstance(family, ReorderableFamily):
        return replace(coordinates, scale=coordinates.scale * signs)
    places = [int(k) for k in order]
    return replace(
        coordinates,
        theta=family.reordered(coordinates.theta, places),
        offset=coordinates.offset[places],
        scale=(coordinates.scale * signs)[places],
    )
