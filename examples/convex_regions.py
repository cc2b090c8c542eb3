"""Convex regions of xi without collisions, at a constant tool position: Drake's IRIS-ZO over a chart's inverse map.

IRIS-ZO grows a polytope around a posture, in the coordinates that a function maps to joint positions. Here this is the
inverse map at fixed x, so that every point of the polytope has the tool in its place. Points without a joint position
inside the domain violate a constraint of IRIS-ZO. In the end, new points of the polytope are checked.

Needs `drake` (the extra `peers`) and a C compiler.
"""

import argparse
import itertools
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.geometry import Capsule, Sphere
from pydrake.geometry.optimization import HPolyhedron, Hyperellipsoid
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import CoulombFriction
from pydrake.planning import (
    IrisParameterizationFunction,
    IrisZo,
    IrisZoOptions,
    RobotDiagramBuilder,
    SceneGraphCollisionChecker,
)
from pydrake.solvers import MathematicalProgram
from spheres import Places, Query, World

import orthocas as oc
from orthocas.problems import urdf_path
from orthocas.tools.checks import Array
from orthocas.tools.display import percent

THIN = 1e-3  # radius of the links [m]; that of the spheres is the query's, less this
LINKS = range(2, 8)  # those that can collide
SEED_RADIUS = 1e-3  # of the ellipsoid from which a region grows, in xi


def checker_of(query: Query) -> SceneGraphCollisionChecker:
    """The arm among the spheres, in Drake. Links are capsules from joint to joint."""
    builder = RobotDiagramBuilder()
    plant = builder.plant()
    with urdf_path() as path:
        (robot,) = Parser(plant).AddModels(str(path))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("link_0"))
    friction = CoulombFriction(1.0, 1.0)
    for k in LINKS:
        end = "link_ee" if k == LINKS[-1] else f"link_{k + 1}"
        offset = next_origin(plant, end)
        pose = RigidTransform(RotationMatrix.MakeFromOneVector(offset, 2), offset / 2)
        capsule = Capsule(THIN, np.linalg.norm(offset))
        plant.RegisterCollisionGeometry(plant.GetBodyByName(f"link_{k}"), pose, capsule, f"link{k}", friction)
    for i, centre in enumerate(query.spheres):
        ball = Sphere(query.radius - THIN)
        plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(centre), ball, f"sphere{i}", friction)
    plant.Finalize()
    return SceneGraphCollisionChecker(
        model=builder.Build(), robot_model_instances=[robot], edge_step_size=0.05, self_collision_padding=-1.0
    )


def next_origin(plant: object, link: str) -> Array:
    """Origin of a link in the frame of its parent [m]."""
    joint = next(plant.get_joint(i) for i in plant.GetJointIndices() if plant.get_joint(i).child_body().name() == link)
    return np.asarray(joint.frame_on_parent().GetFixedPoseInBodyFrame().translation())


def region_of(world: World, query: Query, places: Places) -> HPolyhedron:
    """A polytope in xi around the query's start."""
    options = IrisZoOptions()
    options.sampled_iris_options.configuration_space_margin = SEED_RADIUS  # queries may start close to a sphere
    fallback = query.start  # of points that violate the constraint

    def joints(xi: Array) -> Array:
        q = places.joints(np.asarray(xi))
        return fallback if q is None else q

    def outside(xi: Array) -> Array:
        return np.array([float(places.joints(np.asarray(xi, dtype=float)) is None)])

    options.parameterization = IrisParameterizationFunction(joints, places.size)
    program = MathematicalProgram()
    xi = program.NewContinuousVariables(places.size)
    program.AddConstraint(outside, lb=[-0.5], ub=[0.5], vars=xi)
    options.sampled_iris_options.prog_with_additional_constraints = program
    seed = Hyperellipsoid.MakeHypersphere(SEED_RADIUS, places.start)
    return IrisZo(checker_of(query), seed, HPolyhedron.MakeBox(*places.box), options)


def main(quick: bool = False, count: int = 5) -> list[str]:
    """Print a row for each query; `quick` takes one."""
    chart, rows = oc.fit(oc.problems.get("iiwa"), oc.Polynomial(4)).chart, []
    print("| faces | CPU [s] | volume, share of the box | points inside and free | tool error [m] |")
    print("| --- | --- | --- | --- | --- |")
    with TemporaryDirectory() as folder:
        world = World(chart, Path(folder))
        found = (query for seed in itertools.count() if (query := world.query(seed, stays=True)) is not None)
        for query in itertools.islice(found, 1 if quick else count):
            rows.append(row(world, query, 200 if quick else 5000))
            print(rows[-1], flush=True)
    return rows


def row(world: World, query: Query, samples: int) -> str:
    """Grow a region and check it at samples."""
    places, clear = Places(world, query, constant_x=True), world.clearance(query)
    start = time.process_time()
    region = region_of(world, query, places)
    seconds = time.process_time() - start
    generator, point, points = RandomGenerator(1), places.start, []
    for _ in range(samples):
        point = region.UniformSample(generator, point, mixing_steps=10)
        points.append(point)
    joints = [places.joints(point) for point in points]
    known = np.array([q for q in joints if q is not None])
    free = sum(clear(q) > 0 for q in known)
    error = np.abs(world.chart.x(known) - places.x).max()
    low, high = places.box
    inside = [region.PointInSet(xi) for xi in np.random.default_rng(0).uniform(low, high, (20_000, places.size))]
    return f"| {len(region.b())} | {seconds:.1f} | {np.mean(inside):.3f} | {percent(free / samples)} | {error:.0e} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--queries", type=int, default=5)
    options = parser.parse_args()
    main(options.quick, options.queries)
