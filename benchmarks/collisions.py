"""Collisions: agreement with coal called directly, times, capsules in C, and hostile streams (15 min; `--quick`: 20 s).

Distances are held against Pinocchio's own geometry model of the same file, with hulls of the same meshes and the same
pairs, all of which it computes. Streams are of phi: 60 steps to that of a random posture of the domain, with noise and
jumps, around a post next to the elbow. Contacts are looked for at the postures by `check_free`, and between them by
conservative advancement.
"""

import subprocess
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import casadi as ca
import coal
import numpy as np
import pinocchio as pin
from benchmark import run, table
from scipy.spatial import ConvexHull

import orthocas as oc
from orthocas.charts.trackers import TrackerStatus
from orthocas.native.libraries import find_compilers
from orthocas.robots.capsules import FittedCapsules
from orthocas.robots.collisions import Collisions
from orthocas.robots.kinematics import build_body_poses
from orthocas.robots.urdf import find_robot_file
from orthocas.tools.checks import Array

CHARTS = {
    "panda": "panda-wide",
    "xarm7": "xarm7-wide",
    "baxter": "baxter-left-wide",
    "pr2": "pr2-left-wide",
    "tiago_pro": "tiago-pro-left-wide",
    "ur5": "ur5-position",
}
DIRECT_ONLY = {"romeo": "romeo-left-wide", "ur10": "ur10-position"}  # in the first table
DIRECT, TIMED, CAPSULES, TICKS = 2000, 4096, 3000, 20_000  # postures; postures; postures; ticks of an arm
CONTACTS = 50  # postures whose contacts are compared, for one whose distances are
KEPT = 150_000  # ticks of an arm in C
TOLERANCE = 1e-10  # of coal's distances, relative
MARGIN, AVOID, STEP = 0.01, 0.03, 0.1  # [m]; [m]; largest step of a joint in a tick [rad]
NOISE, JUMPS, LEG = 0.003, 0.02, 60  # of phi relative to its sizes; share of ticks with a far target; ticks
PROGRAM = """
#include <stdio.h>
#include <time.h>
#include "arm_distance.h"
static double q[ROWS * JOINTS];
int main(int count, char **words) {
  double best = 1e9, d, g[JOINTS], points[6], sum = 0.0;
  int pair, i, k;
  FILE *file = count > 1 ? fopen(words[1], "rb") : 0;
  if (!file || fread(q, sizeof(double), ROWS * JOINTS, file) != ROWS * JOINTS) return 1;
  for (k = 0; k < 20; ++k) {
    struct timespec a, b;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &a);
    for (i = 0; i < ROWS; ++i) { arm_distance(q + JOINTS * i, &d, g, points, &pair); sum += d; }
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &b);
    double seconds = (double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec);
    if (seconds / ROWS < best) best = seconds / ROWS;
  }
  printf("%.17g %g\\n", 1e6 * best, sum);
  return 0;
}
"""


KEEPING = """
#include <stdint.h>
#include <stdio.h>
#include <time.h>
#include "arm_distance.h"
static double goals[LEGS * JOINTS], ways[(LEGS * LEG + 1) * JOINTS];
static uint64_t state = 88172645463325252u;
static double draw(void) { /* from -1 to 1, by xorshift */
  state ^= state << 13;
  state ^= state >> 7;
  state ^= state << 17;
  return (double)(state >> 11) / 4503599627370496.0 - 1.0;
}
int main(int count, char **words) {
  double wish[JOINTS], distance;
  long counts[4] = {0, 0, 0, 0};
  int leg, k, i;
  FILE *file = count > 2 ? fopen(words[1], "rb") : 0;
  if (!file || fread(ways, sizeof(double), JOINTS, file) != JOINTS) return 1;
  if (fread(goals, sizeof(double), LEGS * JOINTS, file) != LEGS * JOINTS) return 1;
  clock_t begin = clock();
  for (leg = 0; leg < LEGS; ++leg) {
    for (k = 0; k < LEG; ++k) {
      const double *q = ways + JOINTS * (leg * LEG + k);
      const int far = draw() > 1.0 - 2.0 * JUMPS;
      for (i = 0; i < JOINTS; ++i) {
        double step = (goals[JOINTS * leg + i] - q[i]) / (far ? 1 : LEG - k) + NOISE * draw();
        wish[i] = q[i] + (far ? step : (step > STEP ? STEP : (step < -STEP ? -STEP : step)));
      }
      ++counts[arm_keep_clear(q, wish, MARGIN, ways + JOINTS * (leg * LEG + k + 1), &distance)];
    }
  }
  printf("%g %ld %ld %ld %ld\\n", 1e6 * (double)(clock() - begin) / CLOCKS_PER_SEC / (LEGS * LEG), counts[0], counts[1],
         counts[2], counts[3]);
  file = fopen(words[2], "wb");
  return !file || fwrite(ways, sizeof(double), (LEGS * LEG + 1) * JOINTS, file) != (LEGS * LEG + 1) * JOINTS;
}
"""


def load(name: str) -> tuple[oc.Chart, Collisions]:
    """A chart, and the collision model of its robot."""
    chart = oc.load((CHARTS | DIRECT_ONLY)[name])
    return chart, chart.robot.with_solids(find_robot_file(name)).collisions


@dataclass(frozen=True)
class Direct:
    """Pinocchio's geometry of a robot file, with meshes as hulls and the pairs of a collision model."""

    model: Any
    geometry: Any

    @classmethod
    def of(cls, path: Path, collisions: Collisions, folder: Path) -> "Direct":
        """Joints that the robot does not have are locked at zero, or at the limit closest to it."""
        model = pin.buildModelFromUrdf(str(path))
        geometry = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.COLLISION, [str(folder)])
        q = np.clip(pin.neutral(model), model.lowerPositionLimit, model.upperPositionLimit)
        others = [i for i in range(1, model.njoints) if model.names[i] not in collisions.tree.joint_names]
        model, geometry = pin.buildReducedModel(model, geometry, others, q)
        for solid in geometry.geometryObjects:
            if isinstance(solid.geometry, coal.BVHModelBase):
                solid.geometry = hull_of(np.array(solid.geometry.vertices()))
        names = [model.frames[solid.parentFrame].name for solid in geometry.geometryObjects]
        for first, second in collisions.pairs:
            for i in [k for k, name in enumerate(names) if name == first]:
                for j in [k for k, name in enumerate(names) if name == second]:
                    geometry.addCollisionPair(pin.CollisionPair(i, j))
        return cls(model, geometry)

    @property
    def joints(self) -> list[Any]:
        """Without the universe."""
        return list(self.model.joints)[1:]

    def measure(self, q: Array) -> Array:
        """Least distances of all pairs at postures (N, n)."""
        data, placed, least = self.model.createData(), self.geometry.createData(), np.empty(len(q))
        for request in placed.distanceRequests:
            request.gjk_tolerance, request.gjk_max_iterations = TOLERANCE, 1000
        for k, posture in enumerate(self.configure(q)):
            pin.computeDistances(self.model, data, self.geometry, placed, posture)
            least[k] = min(result.min_distance for result in placed.distanceResults)
        return least

    def check_free(self, q: Array) -> Array:
        """Whether no pair touches at postures (N, n)."""
        data, placed = self.model.createData(), self.geometry.createData()
        touches = partial(pin.computeCollisions, self.model, data, self.geometry, placed, stop_at_first_collision=True)
        return np.array([not touches(posture) for posture in self.configure(q)])

    def configure(self, q: Array) -> Iterator[Array]:
        """Pinocchio's configurations: joints without limits have a cosine and a sine."""
        for posture in q:
            parts = zip(posture, self.joints, strict=True)
            yield np.concatenate([[np.cos(p), np.sin(p)] if joint.nq == 2 else [p] for p, joint in parts])


def hull_of(vertices: Array) -> Any:
    """coal's convex hull of points."""
    hull = ConvexHull(vertices)
    places = {int(corner): k for k, corner in enumerate(hull.vertices)}
    points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for corner in hull.vertices:
        points.append(vertices[corner])
    for face in hull.simplices:
        triangles.append(coal.Triangle(*(places[int(corner)] for corner in face)))
    return coal.Convex(points, triangles)


def seconds_of(call: Callable[[Array], object], q: Array) -> float:
    """The least processor time of three calls."""
    best = np.inf
    for _ in range(3):
        begin = time.process_time()
        call(q)
        best = min(best, time.process_time() - begin)
    return best


def write_row(*cells: object) -> str:
    """A row of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def compare(names: list[str], count: int, found: dict[str, float]) -> Iterator[str]:
    """Rows of the agreement and the times."""
    for name in names:
        chart, collisions = load(name)
        path = find_robot_file(name)
        robot = oc.Robot(collisions.tree)
        q, timed = robot.sample(count, seed=7), robot.sample(min(TIMED, 2 * count), seed=8)
        direct, own = Direct.of(path, collisions, path.parents[4]), collisions.distance(q).distance
        many, distances = robot.sample(CONTACTS * count, seed=11), direct.measure(q)
        # coal's answer "they touch" misses some contacts that its distances show: these decide
        doubted = many[direct.check_free(many) != collisions.check_free(many)]
        differs = int(((direct.measure(doubted) > 0) != collisions.check_free(doubted)).sum())
        apart = float(np.abs(own - distances)[distances > 1e-3].max())
        times = [1e6 * seconds_of(f, timed) / len(timed) for f in (collisions.distance, collisions.check_free)]
        inside = 100 * (1 - collisions.check_free(chart.domain.sample(5 * count, 3)).mean())
        found |= {f"{name}, differ": differs, f"{name}, apart [m]": apart, f"{name}, distance [us]": times[0]}
        cells = f"{apart:.0e}", f"{inside:.1f}", *(f"{value:.0f}" for value in times)
        yield write_row(name, len(collisions.pairs), differs, len(doubted), *cells)


def time_c(chart: oc.Chart, fitted: FittedCapsules, q: Array) -> float:
    """[us] of a call of NAME_distance with its gradient."""
    with TemporaryDirectory() as folder:
        generated = oc.generate_c(chart, folder, name="arm", capsules=fitted)
        Path(folder, "time.c").write_text(PROGRAM)
        q.tofile(f"{folder}/q")
        sizes = [f"-DROWS={len(q)}", f"-DJOINTS={q.shape[1]}"]
        sources = [f"{folder}/time.c", str(generated.folder / "arm_distance.c")]
        subprocess.run([find_compilers()[0], "-O2", *sizes, "-o", f"{folder}/time", *sources, "-lm"], check=True)
        printed = subprocess.run([f"{folder}/time", f"{folder}/q"], check=True, capture_output=True).stdout
        return float(printed.split()[0])


def fit(names: list[str], count: int, found: dict[str, float]) -> Iterator[str]:
    """Rows of fitted capsules."""
    for name in names:
        chart, collisions = load(name)
        begin = time.process_time()
        fitted = oc.fit_capsules(collisions)
        took = time.process_time() - begin
        q = oc.Robot(collisions.tree).sample(count, seed=9)
        # Pairs whose capsules always touch are left out.
        kept = Collisions(collisions.tree, collisions.parts, fitted.collisions.pairs)
        hulls, capsules = kept.distance(q).distance, fitted.collisions.distance(q).distance
        apart = hulls > 0
        gap = (hulls - capsules)[apart]
        lost = int((gap < -1e-8).sum() + (capsules[~apart] > 0).sum())
        us, worst = time_c(chart, fitted, q), max(fitted.ratios.values())
        found |= {f"{name}, ratio": fitted.ratio, f"{name}, lost": lost, f"{name}, C [us]": us}
        cells = f"{fitted.ratio:.2f}", f"{worst:.2f}", lost, f"{1e3 * np.median(gap):.0f}", f"{us:.1f}", f"{took:.0f}"
        yield write_row(name, len(fitted.pieces), *cells)


def put_post(collisions: Collisions, robot: oc.Robot, q: Array) -> tuple[Collisions, oc.Scene | None]:
    """A post beside the fourth link in posture q, which the elbow meets when it swings; none if it is met already."""
    elbow = np.array(ca.DM(build_body_poses(robot.tree, ca.SX(ca.DM(q)))[3][1])).ravel()
    place, up = elbow + np.array([0.0, 0.35, 0.0]), np.array([0.0, 0.0, 0.4])
    scene = oc.Scene({"post": oc.obstacles.Capsule(place - up, place + up, 0.05)})
    around = collisions.with_scene(scene)
    return (around, scene) if around.distance(q).distance > 2 * MARGIN else (collisions, None)


def find_start(chart: oc.Chart, collisions: Collisions) -> Array:
    """The first free posture of the domain: its centre, or seeded ones."""
    q = np.vstack([chart.domain.centre, chart.domain.sample(200, 1)])
    return np.asarray(q[np.flatnonzero(collisions.distance(q).distance > MARGIN)[0]])


def draw_target(chart: oc.Chart, begin: Array, end: Array, share: float, rng: np.random.Generator) -> Array:
    """A target (n,) between two phi with noise, or now and then one that is far away."""
    noise = NOISE * chart.parts.phi_sizes * rng.normal(size=chart.n)
    return (end if rng.random() < JUMPS else (1 - share) * begin + share * end) + noise


def stream(names: list[str], ticks: int, found: dict[str, float]) -> Iterator[str]:
    """Rows of hostile streams, a quarter of them with each choice of `nearest` and `avoid`."""
    for name in names:
        chart, collisions = load(name)
        start = find_start(chart, collisions)
        around, _ = put_post(collisions, chart.robot, start)
        contacts, nearest, seconds = 0, np.inf, 0.0
        counts = dict.fromkeys(TrackerStatus, 0)
        for part in range(4):
            options = {"nearest": part % 2 == 1, "avoid": AVOID if part > 1 else None}
            tracker = chart.tracker(start, STEP, collisions=around, margin=MARGIN, **options)
            q, rng = [start], np.random.default_rng(part)
            for goal in chart.phi(chart.domain.sample(ticks // 4 // LEG, (4, part))):
                phi = chart.phi(q[-1])
                for k in range(LEG):
                    aim = draw_target(chart, phi, goal, (k + 1) / LEG, rng)
                    begin = time.perf_counter()
                    q.append(tracker.step(aim))
                    seconds += time.perf_counter() - begin
                    counts[tracker.status] += 1
            way = np.array(q)
            contacts += int((~around.check_free(way)).sum())
            contacts += sum(around.find_contact(way[k : k + 101]) is not None for k in range(0, len(way) - 1, 100))
            nearest = min(nearest, float(around.distance(way).distance.min()))
        kinds, total = ({"OK", "NEAREST", "NEARER"}, {"YIELDING"}, {"BRAKED"}), sum(counts.values())
        shares = [100 * sum(n for status, n in counts.items() if status.name in kind) / total for kind in kinds]
        found |= {f"{name}, contacts": contacts, f"{name}, nearest [m]": nearest}
        cells = f"{1e3 * nearest:.1f}", *(f"{share:.0f}" for share in shares), f"{1e6 * seconds / total:.0f}"
        yield write_row(name, total, contacts, *cells)


def keep_clear(names: list[str], ticks: int, found: dict[str, float]) -> Iterator[str]:
    """Rows of hostile streams of postures through NAME_keep_clear in C, checked against the hulls."""
    for name in [*names, *(["baxter, both arms"] if "baxter" in names else [])]:
        if name in CHARTS:
            chart, own = load(name)
            goals = chart.domain.sample(ticks // LEG, 5)
        else:
            path = find_robot_file("baxter")
            robot = oc.Robot.from_urdf(path, tips=["left_gripper", "right_gripper"])
            own, middle = robot.collisions, robot.tree.centre_posture
            problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Box(middle, 0.1))
            chart, goals = oc.fit(problem, oc.Linear(), samples=300).chart, robot.sample(ticks // LEG, 5)
        fitted = oc.fit_capsules(own)
        # Capsules of short wrists are near each other in all postures: then the margin is two thirds of the most.
        apart = fitted.collisions.distance(goals).distance
        most = float(apart.max())
        margin, far = min(MARGIN, most / 1.5), next(k for k in (2 * MARGIN, 1.5 * MARGIN, most) if k <= most)
        start = goals[int(np.argmax(apart >= far))]
        around, scene = put_post(own, chart.robot, start)
        if scene is not None:
            fitted = replace(fitted, collisions=fitted.collisions.with_scene(scene))
        way, us, counts = run_stream(chart, fitted, start, goals, margin)
        contacts = int((~around.check_free(way)).sum())
        pieces = range(0, len(way) - LEG, 20 * LEG)
        contacts += sum(around.find_contact(way[k : k + LEG + 1]) is not None for k in pieces)
        total = sum(counts)
        found |= {f"{name}, contacts in C": contacts, f"{name}, ticks in C": total}
        shares = (f"{100 * count / total:.0f}" for count in counts[:3])
        yield write_row(name, total, f"{1e3 * margin:.0f}", contacts, *shares, f"{us:.1f}")


def run_stream(
    chart: oc.Chart, fitted: FittedCapsules, start: Array, goals: Array, margin: float
) -> tuple[Array, float, tuple[int, ...]]:
    """Postures (N, n), [us] of a tick, and how many ticks had each status."""
    with TemporaryDirectory() as folder:
        generated = oc.generate_c(chart, folder, name="arm", capsules=fitted)
        Path(folder, "keep.c").write_text(KEEPING)
        np.vstack([start, goals]).tofile(f"{folder}/goals")
        numbers = {"JOINTS": chart.n, "LEGS": len(goals), "LEG": LEG, "STEP": STEP, "MARGIN": margin}
        numbers |= {"JUMPS": JUMPS, "NOISE": NOISE}
        sizes = [f"-D{name}={value}" for name, value in numbers.items()]
        sources = [f"{folder}/keep.c", str(generated.folder / "arm_distance.c")]
        subprocess.run([find_compilers()[0], "-O2", *sizes, "-o", f"{folder}/keep", *sources, "-lm"], check=True)
        words = [f"{folder}/keep", f"{folder}/goals", f"{folder}/way"]
        us, *counts = subprocess.run(words, check=True, capture_output=True).stdout.split()
        return np.fromfile(f"{folder}/way").reshape(-1, chart.n), float(us), tuple(map(int, counts))


HEADS = (
    "robot | pairs | contacts that differ | from `collide` | largest difference of distances [m] "
    "| domain in contact [%] | distance and gradient [us] | free or not [us]",
    "robot | capsules | volume over the links | of the worst link | contacts of hulls missed "
    "| nearer than hulls, median [mm] | `NAME_distance` [us] | fit [s]",
    "chart of | ticks | contacts | nearest [mm] | as wished or nearest [%] | xi yields [%] | braked [%] "
    "| time of a tick [us]",
    "robot | ticks in C | margin [mm] | contacts of hulls | as wished [%] | shorter [%] | at rest [%] "
    "| time of a tick [us]",
)


def main(quick: bool = False) -> dict[str, float]:
    """Print the tables; the numbers of a test."""
    names, found = list(CHARTS)[:1] if quick else list(CHARTS), dict[str, float]()
    counts = (50, 200, 400, 6000) if quick else (DIRECT, CAPSULES, TICKS, KEPT)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for head, rows, count in zip(HEADS, (compare, fit, stream, keep_clear), counts, strict=True):
            print(f"| {head} |")
            more = [] if quick or rows is not compare else list(DIRECT_ONLY)
            table("| --- " * (head.count("|") + 1) + "|", rows(names + more, count, found))
    return found


if __name__ == "__main__":
    run(main, __doc__)
