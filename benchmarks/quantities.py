"""Swivels and joints as coordinates of wide charts: themselves, and coordinates like them (3 min)."""

from benchmark import run, table
from wide_charts import robot_of

import orthocas as oc
from orthocas.bases.given import SEW_KINDS
from orthocas.tools.display import percent

ARMS = ("iiwa", "panda", "xarm7", "baxter, left")
NEAR = (
    ("iiwa", "swivel"),
    ("panda", "swivel"),
    ("xarm7", "swivel"),
    ("baxter, left", "swivel"),
    ("iiwa", "A3"),
    ("panda", "panda_joint3"),
)
EXACT_HEADER = "| arm, angle | share of the branch | conditioning 1 % |\n|" + " --- |" * 3
NEAR_HEADER = (
    "| arm, like | share of the branch | moves it for each unit, 5 to 95 % | correlation | against it |\n|"
    + " --- |" * 5
)


def exact_row(name: str, kind: str, quick: bool) -> str:
    """The angle itself: the share of the branch on which it is regular, and how well."""
    robot = robot_of(name)
    task = oc.Task.pose(robot)
    if kind == "conventional":
        fit = oc.fit_wide(robot, task, like="swivel", exact=True)
    else:
        fit = oc.fit_wide(robot, task, parametrisation=oc.SEW("stereographic"))
    report = oc.evaluate(fit.chart, 500 if quick else 100_000, seed=1)
    return f"| {name}, {kind} | {percent(fit.regular_share, 2)} | {report.conditioning.p01:.3f} |"


def near_row(name: str, like: str, quick: bool) -> str:
    """A coordinate like the quantity, on all of the branch."""
    robot = robot_of(name)
    fit = oc.fit_wide(robot, oc.Task.pose(robot), like=like, exact=False, samples=1000 if quick else None)
    meaning = fit.meaning
    assert meaning is not None
    rates = f"{meaning.slow:.2f} to {meaning.fast:.2f}"
    against = percent(meaning.against, fault=True)
    return f"| {name}, {like} | {percent(fit.regular_share, 2)} | {rates} | {meaning.correlation:.2f} | {against} |"


def main(quick: bool = False) -> tuple[list[str], list[str]]:
    """Print both tables; return their rows."""
    exact = [(name, kind) for name in (ARMS[1:2] if quick else ARMS) for kind in SEW_KINDS]
    return (
        table(EXACT_HEADER, (exact_row(name, kind, quick) for name, kind in exact)),
        table(NEAR_HEADER, (near_row(name, like, quick) for name, like in (NEAR[4:5] if quick else NEAR))),
    )


if __name__ == "__main__":
    run(main, __doc__)
