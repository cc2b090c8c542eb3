"""A small atlas of the planar arm, for tests."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.atlas.atlas_file import Stock

ASKED = oc.AtlasSettings(degree=2, leak_deg=14.0, half_width=0.8, splits=5)


def planar() -> oc.Problem:
    known = problems.get("planar_3r_xy")
    return oc.Problem(known.robot, known.task, domain=known.domain)


def built(path: Path, **options: Any) -> oc.Atlas:
    with ThreadPoolExecutor(1) as executor:
        return oc.build_atlas(planar(), path, ASKED, executor=executor, **options)


def cells_of(stock: Stock) -> list[tuple[Any, ...]]:
    """What a file says of each cell, in an order that does not depend on how it came."""
    names = ("tile", "outcome", "joint", "levels", "places", "leak_deg", "conditioning")
    return sorted(tuple(np.nan_to_num(np.ravel(record[name])).tolist() for name in names) for record in stock.records)
