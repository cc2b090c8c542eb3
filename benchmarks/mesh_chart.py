"""Time of a disk chart of a planar 3R leaf: surface, harmonic map, closest points; compared with bare libigl."""

import time
from collections.abc import Callable
from typing import Any

import igl
import numpy as np
from benchmark import run, table

from orthocas.exact.mesh import TriangleLocator, TriangleMesh, build_level_surface, map_to_disk, require_disk

HEADER = (
    "| triangles | surface [s] | harmonic map [s] | closest points [s] | libigl: harmonic map [s] "
    "| libigl: closest points [s] |\n| --- | --- | --- | --- | --- | --- |"
)
OFF_SURFACE = 0.01  # standard deviation of the queries from the mesh [rad]


def leaf(cells: int) -> TriangleMesh:
    """The leaf x = 0 of the planar 3R arm with unit links and q1 in (0, pi)."""
    low, high = (0.0, -np.pi, -np.pi), (np.pi, np.pi, np.pi)
    return build_level_surface(
        lambda q: np.cos(np.cumsum(q, axis=1)).sum(axis=1),
        lambda q: np.cumsum(-np.sin(np.cumsum(q, axis=1))[:, ::-1], axis=1)[:, ::-1],
        *(0.0, low, high, cells),
    )


def seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    """Wall time in seconds, and the result."""
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def row(cells: int, queries: int = 100_000) -> str:
    """Build one chart and print its times."""
    rng = np.random.default_rng(7)
    surface_time, mesh = seconds(lambda: leaf(cells))
    map_time, disk = seconds(lambda: map_to_disk(mesh))
    corners = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=queries)]]
    points = np.einsum("nc,ncd->nd", rng.dirichlet([1, 1, 1], queries), corners)
    points += OFF_SURFACE * rng.normal(size=points.shape)
    locate_time, found = seconds(lambda: TriangleLocator(mesh.vertices, mesh.faces).locate(points))
    loop = require_disk(mesh)
    circle = igl.map_vertices_to_circle(mesh.vertices, loop)
    bare_map_time, bare_disk = seconds(lambda: igl.harmonic(mesh.vertices, mesh.faces, loop, circle, 1))
    bare_locate_time, (squares, _, _) = seconds(
        lambda: igl.point_mesh_squared_distance(points, mesh.vertices, mesh.faces)
    )
    assert np.abs(bare_disk - disk).max() < 1e-8
    assert np.abs(np.sqrt(squares) - found.distance).max() < 1e-12
    peers = f"{bare_map_time:.2f} | {bare_locate_time:.2f}"
    return f"| {len(mesh.faces)} | {surface_time:.2f} | {map_time:.2f} | {locate_time:.2f} | {peers} |"


def main(quick: bool = False) -> list[str]:
    """Rows for grids of 60 to 300 cells; `quick` uses one grid of 20 cells."""
    grids = [(20, 1_000)] if quick else [(cells,) for cells in (60, 100, 150, 204, 300)]
    return table(HEADER, (row(*grid) for grid in grids))


if __name__ == "__main__":
    run(main, __doc__)
