"""Least distances between a robot's links, by capsules that contain them, in C and in exported modules."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from orthocas.charts.walls import RULES as CLEARANCE
from orthocas.codegen.export_forms import Form, write_function
from orthocas.codegen.rendering import Precision, clean_word, render
from orthocas.robots.capsules import FittedCapsules
from orthocas.robots.collisions import Collisions
from orthocas.robots.kinematics import build_body_poses
from orthocas.robots.robot import Robot
from orthocas.robots.shapes import HalfSpaceGeometry
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array
from orthocas.tools.display import listed


@dataclass(frozen=True, slots=True)
class DistanceRules:
    """Numbers of distances in C."""

    postures: int = 2000  #: random postures that sort pairs by how often each is the nearest
    seed: int = 0  #: seed of these postures
    grown: float = 1e-9  #: relative enlargement of the balls around links, which covers rounding
    locals_bytes: int = 1024  #: stack for other variables [bytes]
    rounds: int = 16  #: largest number of distances for checking a motion
    resolution: float = 1e-6  #: [m]; distances less than this above the clearance count as too near
    #: squared sine of an angle below which axes count as parallel in modules, which may use single precision
    parallel: float = 1e-6
    least_square: float = 1e-18  #: [m^2], keeps square roots in modules differentiable


RULES = DistanceRules()


def render_distance(fitted: FittedCapsules, values: Mapping[str, Any], precision: Precision) -> dict[str, str]:
    """The contents of NAME_distance.h and NAME_distance.c.

    Args:
        fitted: the fitted capsules.
        values: values of the library's other templates: name, NAME, version, farthest and largest.
        precision: number type.
    """
    model = fitted.collisions
    tree, names = model.tree, list(dict.fromkeys(part.name for part in model.parts))
    capsules, links, planes = list[dict[str, Any]](), list[dict[str, Any]](), list[Array]()
    numbers: dict[str, tuple[str, int]] = {}
    for name in names:
        parts = [part for part in model.parts if part.name == name]
        if isinstance(parts[0].shape.geometry, HalfSpaceGeometry):
            normal = parts[0].shape.rotation[:, 2]
            numbers[name] = "plane", len(planes)
            planes.append(np.append(normal, normal @ parts[0].shape.translation))
            continue
        numbers[name] = "link", len(links)
        ends = [part.shape.list_corners() for part in parts]
        radii = np.array([radius for _, radius in ends])
        rows = [np.concatenate([points[:1], points[-1:]]) for points, _ in ends]
        low, high = (f([p + s * r for p, r in zip(rows, radii, strict=True)], axis=(0, 1)) for f, s in _BOX)
        centre = (low + high) / 2
        far = [np.linalg.norm(p - centre, axis=1).max() + r for p, r in zip(rows, radii, strict=True)]
        tree.require_no_mimics("distances in C")
        carried = np.zeros(tree.n, dtype=int)
        carried[tree.carriers(parts[0].body)] = 1
        ball = {"centre": centre, "radius": float(max(far)) * (1 + RULES.grown)}
        links.append({"body": parts[0].body, "first": len(capsules), "count": len(parts), "carried": carried, **ball})
        for (start, end), r in zip(rows, radii, strict=True):
            reach = float(np.linalg.norm(end - start) / 2 + r) * (1 + RULES.grown)
            capsules.append({"start": start, "end": end, "radius": float(r), "reach": reach})
    pairs, plane_pairs = list[tuple[int, int, int]](), list[tuple[int, int, int]]()
    for number in _order_pairs(model):
        first, second = model.pairs[number]
        kind, place = numbers[second]
        (plane_pairs if kind == "plane" else pairs).append((numbers[first][1], place, number))

    def up(value: float) -> float:
        # Round a radius up, and add the rounding errors of positions.
        if precision.scalar is np.float64:
            return value
        return float(precision.next_above(np.array([value * (1 + 4 * precision.rounding)]))[0])

    for item in (*capsules, *links):
        item["radius"] = up(item["radius"])
    for capsule in capsules:
        capsule["reach"] = up(capsule["reach"])
    values = {
        **values,
        "n": tree.n,
        "ratio": f"{fitted.ratio:.2f}",
        "missing": clean_word(listed(model.missing)) if model.missing else "",
        "dropped": clean_word(listed([f"{a} and {b}" for a, b in fitted.dropped])) if fitted.dropped else "",
        "pair_count": len(model.pairs),
        "names": [[clean_word(name).replace('"', "'") for name in pair] for pair in model.pairs],
        "parents": tree.parents,
        "slides": [int(slides) for slides in tree.prismatic],
        "rotations": [rotation.ravel() for rotation in tree.rotations],
        "translations": tree.translations,
        "capsules": capsules,
        "links": links,
        "pairs": pairs,
        "planes": planes if plane_pairs else [],
        "plane_pairs": plane_pairs,
        "rates": [up(rate) for rate in model.rates.max(axis=0, initial=0.0).tolist()],
        "clear": {
            "zone": CLEARANCE.zone,
            "left": 1 - CLEARANCE.fall,
            "between": CLEARANCE.between,
            "halvings": CLEARANCE.halvings,
            "rounds": RULES.rounds,
            "resolution": RULES.resolution,
            "most": 1 + CLEARANCE.halvings * (1 + RULES.rounds),
        },
        "stack": bound_distance_stack(fitted, precision.size),
    }
    files = {f"{values['name']}_distance.{kind}": render(f"distance.{kind}", values) for kind in ("h", "c")}
    return {file: precision.translate(text) for file, text in files.items()}


def bound_distance_stack(fitted: FittedCapsules, size: int) -> int:
    """Upper bound of the stack of NAME_distance [bytes]: poses of joints, links and capsules of `size` bytes."""
    model = fitted.collisions
    names = [part.name for part in model.parts if part.shape.bounded]
    links = len(set(names))
    return size * (18 * model.tree.n + 3 * links + 9 * len(names)) + links + RULES.locals_bytes


def build_distance_form(fitted: FittedCapsules) -> Form:
    """The functions `distance` and `pair_distances` of an exported module."""
    model = fitted.collisions
    tree, parts = model.tree, [part for part in model.parts if part.shape.bounded]
    # Poses of the bodies, and of the world as the last one.
    q = ca.SX.sym("q", tree.n)
    poses = [*build_body_poses(tree, q), (ca.SX.eye(3), ca.SX.zeros(3))]
    rows = ca.vertcat(*(ca.vec(ca.horzcat(rotation, translation).T) for rotation, translation in poses))
    code = write_function(
        "_body_poses", "Rotations and places of the bodies, row by row, (12 B, N).", dense_function("f", [q], [rows])
    )
    corners = [part.shape.list_corners() for part in parts]
    radii = np.array([radius for _, radius in corners])
    own: dict[str, list[int]] = {}
    for k, part in enumerate(parts):
        own.setdefault(part.name, []).append(k)
    # Pairs of capsules, equally many for each pair of names; the last one is repeated where there are fewer.
    pairs = [(k, pair) for k, pair in enumerate(model.pairs) if pair[1] in own]
    rows_of = [[(i, j) for i in own[a] for j in own[b]] for _, (a, b) in pairs]
    most = max(map(len, rows_of), default=1)
    numbers = np.array([[*row, *(most - len(row)) * [row[-1]]] for row in rows_of], dtype=int).reshape(-1, 2)
    # Half-spaces, as normals and offsets.
    solids = {part.name: part.shape for part in model.parts}
    planes = [(k, pair) for k, pair in enumerate(model.pairs) if pair[1] not in own]
    most_planes = max((len(own[first]) for _, (first, _) in planes), default=1)
    below = [[*own[a], *(most_planes - len(own[a])) * own[a][-1:]] for _, (a, _) in planes]
    normals = [
        np.append(shape.rotation[:, 2], shape.rotation[:, 2] @ shape.translation)
        for shape in (solids[b] for _, (_, b) in planes)
    ]
    order = np.argsort([k for k, _ in (*pairs, *planes)])
    flat = np.array(below, dtype=int).ravel()
    tables = {
        "capsule_ends": np.array([*(points[0] for points, _ in corners), *(points[-1] for points, _ in corners)]),
        "radii": (radii[numbers[:, 0]] + radii[numbers[:, 1]])[:, None],
        "plane_normals": np.repeat(np.reshape(normals, (-1, 4)), most_planes, axis=0)[:, :, None],
        "plane_radii": radii[flat][:, None],
    }
    bodies = [part.body if part.body >= 0 else tree.bodies for part in parts]
    indices = {
        "capsule_bodies": [*bodies, *bodies],
        "first": numbers[:, 0].tolist(),
        "second": numbers[:, 1].tolist(),
        "plane_first": flat.tolist(),
        "pair_order": order.tolist(),
    }
    values = {
        "pairs": ascii(model.pairs),
        "bodies": tree.bodies + 1,
        "capsules": len(parts),
        "count": len(pairs),
        "most": most,
        "planes": len(planes),
        "most_planes": most_planes,
        "parallel": RULES.parallel,
        "least_square": RULES.least_square,
    }
    return Form("distance", values, code, tables, indices)


_BOX = ((np.min, -1.0), (np.max, 1.0))  #: how to find the lower and the upper corner of a box around balls


def _order_pairs(model: Collisions) -> list[int]:
    """Indices of the pairs, sorted by how often each is the nearest in random postures."""
    counts = np.zeros(len(model.pairs), dtype=int)
    if len(model.pairs):
        near = model.distance(Robot(model.tree).sample(RULES.postures, RULES.seed)).pair
        places = {pair: k for k, pair in enumerate(model.pairs)}
        np.add.at(counts, [places[pair] for pair in near], 1)
    return [int(k) for k in np.argsort(-counts, kind="stable")]
