"""The least distance between a robot's links in C, with its gradient: of capsules that contain them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from orthocas.codegen.rendering import Precision, clean_word, clean_words, render
from orthocas.robots.capsules import FittedCapsules
from orthocas.robots.collisions import Collisions
from orthocas.robots.robot import Robot
from orthocas.robots.shapes import HalfSpaceGeometry
from orthocas.tools.checks import Array
from orthocas.tools.display import listed


@dataclass(frozen=True, slots=True)
class DistanceRules:
    """Numbers of distances in C."""

    postures: int = 2000  #: by which pairs are put into the order of how often they are the nearest
    seed: int = 0  #: of them
    grown: float = 1e-9  #: of the balls around links, relative: more than rounding
    locals_bytes: int = 1024  #: of stack for other variables


RULES = DistanceRules()


def render_distance(fitted: FittedCapsules, values: Mapping[str, Any], precision: Precision) -> dict[str, str]:
    """NAME_distance.h and NAME_distance.c.

    Args:
        fitted: the capsules.
        values: of other templates of the library: name, NAME, version, farthest and largest.
        precision: of their numbers.
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
        carried = np.zeros(tree.n, dtype=int)
        carried[tree.carriers(parts[0].body)] = 1
        ball = {"centre": centre, "radius": float(max(far)) * (1 + RULES.grown)}
        links.append({"body": parts[0].body, "first": len(capsules), "count": len(parts), "carried": carried, **ball})
        capsules += [{"start": p[0], "end": p[1], "radius": float(r)} for p, r in zip(rows, radii, strict=True)]
    pairs, plane_pairs = list[tuple[int, int, int]](), list[tuple[int, int, int]]()
    for number in _order_pairs(model):
        first, second = model.pairs[number]
        kind, place = numbers[second]
        (plane_pairs if kind == "plane" else pairs).append((numbers[first][1], place, number))
    # A float more than a radius in double.
    up = (lambda value: value) if precision.scalar is np.float64 else lambda value: _round_up(value, precision)
    for item in (*capsules, *links):
        item["radius"] = up(item["radius"])
    numbers_held = 12 * tree.n + 3 * len(links) + 6 * len(capsules)
    values = {
        **values,
        "n": tree.n,
        "ratio": f"{fitted.ratio:.2f}",
        "missing": clean_word(listed(model.missing)) if model.missing else "",
        "pair_count": len(model.pairs),
        "names": [[_quote(name) for name in pair] for pair in model.pairs],
        "parents": tree.parents,
        "slides": [int(slides) for slides in tree.prismatic],
        "rotations": [rotation.ravel() for rotation in tree.rotations],
        "translations": tree.translations,
        "capsules": capsules,
        "links": links,
        "pairs": pairs,
        "planes": planes if plane_pairs else [],
        "plane_pairs": plane_pairs,
        "stack": precision.size * numbers_held + len(links) + RULES.locals_bytes,
    }
    files = {f"{values['name']}_distance.{kind}": render(f"distance.{kind}", values) for kind in ("h", "c")}
    return {file: precision.translate(text) for file, text in files.items()}


_BOX = ((np.min, -1.0), (np.max, 1.0))  #: how a box around balls begins and ends


def _order_pairs(model: Collisions) -> list[int]:
    """Numbers of the pairs, those first that are the nearest most often in seeded postures."""
    counts = np.zeros(len(model.pairs), dtype=int)
    if len(model.pairs):
        near = model.distance(Robot(model.tree).sample(RULES.postures, RULES.seed)).pair
        places = {pair: k for k, pair in enumerate(model.pairs)}
        np.add.at(counts, [places[pair] for pair in near], 1)
    return [int(k) for k in np.argsort(-counts, kind="stable")]


def _round_up(value: float, precision: Precision) -> float:
    """The next larger number of a type, and what the rounding of places adds."""
    return float(precision.next_above(np.array([value * (1 + 4 * precision.rounding)]))[0])


def _quote(name: str) -> str:
    """A name within a string of C."""
    return clean_words([name])[0].replace('"', "'")
