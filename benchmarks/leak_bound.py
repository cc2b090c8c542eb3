"""How small can the leak of even coordinates be on a ball? A bound from the curvature of the task, and fits beside it.

Let N(q) = ker J_x(q) with projector P(q), e a unit vector, and T(x) = W x with W antisymmetric. W x is tangent to every
sphere around the centre and has no divergence, so the mean over a ball of grad xi . W x is 0 for every xi. With
grad xi = e + S x + d(x), |S| <= curvature, |d| <= change |x|^2 / 2 this gives, with means over the ball,

    rms sin(leak) >= (e . mean P T - curvature |mean sym(x (P T)^T)| - change / 2 mean |x|^2 |P T|)
                     / sqrt(mean (1 + curvature |x| + change |x|^2 / 2)^2 |T - P T|^2).

W is the antisymmetric part of x -> -dP[x] e on the space orthogonal to N, so that the bound is |W| R / sqrt(n + 2) to
first order in the radius R. Quadratic coordinates reach that order: there it is the least leak. Means are Monte Carlo.
"""

import numpy as np
from benchmark import run
from redundancy.arms import Arm

import orthocas as oc
from orthocas.tasks.corridor import Corridor
from orthocas.tools.checks import Array

ARMS, TASKS, RADII = ("iiwa", "panda"), ("position", "pose"), (0.05, 0.1, 0.2, 0.4)
SAMPLES, STEP = 40_000, 1e-5  # of the ball; of differences [rad]
HEADER = (
    "| arm, task | radius [rad] | first order [deg] | bound [deg] | fitted, degree 4 [deg] | fitted / first order | "
    "fitted / bound |\n|" + " --- |" * 7
)


def ball(n: int, count: int, seed: int) -> Array:
    """Points of the unit ball with their opposites (2 count, n)."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, n))
    x *= (rng.uniform(size=(count, 1)) ** (1 / n)) / np.linalg.norm(x, axis=1)[:, None]
    return np.concatenate([x, -x])


def projectors(problem: oc.Problem, q: Array) -> Array:
    """P(q) of points (N, n), the projectors onto ker J_x (N, n, n)."""
    J = problem.task.batched_jacobian(q)[0].reshape(len(q), -1, q.shape[1])
    basis = np.linalg.qr(J.transpose(0, 2, 1))[0]
    return np.asarray(np.eye(q.shape[1]) - basis @ basis.transpose(0, 2, 1))


def twist(problem: oc.Problem, centre: Array, e: Array) -> Array:
    """W of a direction e (n, n)."""
    n, P = len(centre), projectors(problem, centre[None])[0]
    steps = STEP * np.eye(n)
    slopes = (projectors(problem, centre + steps) - projectors(problem, centre - steps)) / (2 * STEP)
    B = np.stack([slope @ e for slope in slopes], axis=1)  # x -> dP[x] e
    across = np.eye(n) - P
    B = across @ B @ across
    return np.asarray((B - B.T) / 2)


def bound(problem: oc.Problem, centre: Array, radius: float, e: Array, curvature: float, change: float) -> float:
    """Of the mean of sin^2 of one coordinate's leak; 0 if there is none."""
    x = radius * ball(len(centre), SAMPLES, 3)
    T = x @ twist(problem, centre, e).T
    PT = np.einsum("kij,kj->ki", projectors(problem, centre + x), T)
    lengths = np.linalg.norm(x, axis=1)
    moment = x.T @ PT / len(x)
    bent = curvature * np.linalg.norm((moment + moment.T) / 2)
    rest = change / 2 * (lengths**2 * np.linalg.norm(PT, axis=1)).mean()
    most = 1 + curvature * lengths + change / 2 * lengths**2
    size = np.sqrt((most**2 * ((T - PT) ** 2).sum(axis=1)).mean())
    return float(max(0.0, e @ PT.mean(axis=0) - bent - rest) / size) ** 2 if size > 0 else 0.0


def smoothness(chart: oc.Chart, centre: Array, radius: float) -> tuple[Array, Array, Array]:
    """Unit gradients at the centre (r, n), Hessians there over the gradients' lengths, and how fast these change."""
    x = radius * ball(len(centre), 2000, 4)
    g = chart.jacobian(centre)[chart.m :]
    steps = 1e-4 * np.eye(len(centre))
    H = np.stack([(chart.jacobian(centre + s) - chart.jacobian(centre - s))[chart.m :] / 2e-4 for s in steps], axis=2)
    sizes = np.linalg.norm(g, axis=1)
    rest = chart.jacobian(centre + x)[:, chart.m :] - g - np.einsum("rij,kj->kri", H, x)
    far = np.linalg.norm(x, axis=1) > radius / 2
    change = (2 * np.linalg.norm(rest, axis=2)[far] / (x[far] ** 2).sum(axis=1)[:, None]).max(axis=0)
    return g / sizes[:, None], np.linalg.norm(H, axis=(1, 2)) / sizes, change / sizes


def row(name: str, kind: str, radius: float, found: dict[str, float]) -> str:
    """A ball: what the curvature of the task demands, and what a fit reaches."""
    arm = Arm(name)
    centre, n = arm.home, arm.n
    task = oc.Task.named(arm.robot, kind, centre)
    domain = Corridor(oc.Box(centre, radius), [centre], radius)
    problem = oc.Problem(arm.robot, task, domain=domain)
    chart = oc.fit(problem, oc.Polynomial(4)).chart
    basis = np.linalg.svd(projectors(problem, centre[None])[0])[0][:, : chart.r].T
    first = np.sqrt(sum((twist(problem, centre, e) ** 2).sum() for e in basis) / chart.r / (n + 2)) * radius
    gradients, curvatures, changes = smoothness(chart, centre, radius)
    pieces = [bound(problem, centre, radius, *one) for one in zip(gradients, curvatures, changes, strict=True)]
    least = float(np.sqrt(np.mean(pieces)))
    q = centre + radius * ball(n, SAMPLES // 2, 5)
    rows, P = chart.jacobian(q)[:, chart.m :], projectors(problem, q)
    lean = ((rows - rows @ P) ** 2).sum(axis=2) / (rows**2).sum(axis=2)
    fitted = float(np.sqrt(lean.mean()))
    found[f"{name}, {kind}, {radius:g}"] = fitted / least if least else float("inf")
    angles = [np.degrees(np.arcsin(min(1.0, value))) for value in (first, least, fitted)]
    return (
        f"| {name}, {kind} | {radius:g} | {' | '.join(f'{angle:.3f}' for angle in angles)} | {fitted / first:.2f} | "
        f"{fitted / least if least else float('inf'):.2f} |"
    )


def main(quick: bool = False) -> dict[str, float]:
    """Print the table; return how far fits are above the bound."""
    found: dict[str, float] = {}
    print(HEADER)
    for name in ARMS[: 1 if quick else 2]:
        for kind in TASKS:
            for radius in RADII[:1] if quick else RADII:
                print(row(name, kind, radius, found), flush=True)
    return found


if __name__ == "__main__":
    run(main, __doc__)
