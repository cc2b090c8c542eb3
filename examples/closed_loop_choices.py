"""Do the conclusions of [AS2023] Sec. 8 depend on choices that the paper does not state? (1 min).

Figs. 22 to 26 and 30 use one stiffness, one damping ratio, one set of lengths and one set of steps. This example varies
these choices, and measures the three conclusions again for each of them:

1. Fitted coordinates couple less than linear ones. Measure: coupling index x <- xi with PD+, at both bases of Fig. 24.
2. The error of fitted coordinates matters less than curvature and Coriolis terms. Measure: largest unwanted task
   acceleration from the error (38), divided by the smaller one of the other two, feedback only.
3. x and y couple more with each other than with xi. Measure: largest deviation of x or y while the other is stepped,
   divided by the deviation while xi is stepped, for the task (x, y), with and without feed-forward.

The first two hold for all choices. Without feed-forward, the third holds for all choices but one. With feed-forward, it
holds for none, because the task controller knows the inertia between x and y, and the remaining disturbance there is
smaller than that from xi.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from paper.fig25 import parts
from paper.planar_loop import (
    ALL_OF_X,
    ALL_OF_XY,
    DAMPING_RATIO,
    FOLDED,
    GENTLE,
    INTERLEAVED,
    LENGTHS,
    STIFFNESS,
    STRONG,
    Arm,
    Axes,
    Moves,
    Place,
    Run,
    follow,
)

import orthocas as oc
from orthocas import problems
from orthocas.control.linear_algebra import DampingDesign
from orthocas.tools.display import percent


@dataclass(frozen=True)
class Choice:
    """The choices that the paper leaves open; the defaults are those of the figures."""

    name: str
    stiffness: tuple[float, float, float] = 3 * (STIFFNESS,)
    damping_ratio: float = DAMPING_RATIO
    damping: DampingDesign = "square_root"
    lengths: tuple[float, ...] = LENGTHS
    steps: float = 1.0  #: size of the steps relative to the figures
    places: tuple[Place, Place, Place] = (GENTLE, STRONG, FOLDED)  #: bases, and boxes around the motion


@dataclass(frozen=True)
class Row:
    """The measurements for one choice."""

    choice: Choice
    linear: tuple[float, float]  #: coupling x <- xi at the bases of low and high curvature [m]
    fitted: tuple[float, float]  #: the same for fitted coordinates
    error_share: float  #: error (38) divided by the smaller one of curvature and Coriolis terms
    mutual_feedback: float  #: deviation of x or y due to the other, divided by that due to xi, feedback only
    mutual_feed_forward: float  #: the same with feed-forward
    not_ok: float  #: largest share of fallbacks in any run with fitted coordinates


WIDE = Place(FOLDED.q2, FOLDED.q3, (-0.65, -0.15, -0.15), (0.15, 1.2, 0.6))
_GENTLE = Place(2.8, -1.9, (-0.25, -0.4, -0.8), (0.3, 0.45, 0.6))  # for links of 1 : 0.8 : 0.6
_STRONG = Place(2.58, 1.95, (-0.12, -0.25, -1.2), (0.5, 0.3, 0.15))
_FOLDED = Place(1.2, -2.9, (-0.5, -0.12, -0.1), (0.1, 0.8, 0.9))
SHORT = (_GENTLE, _STRONG, _FOLDED)
MIXED = (
    30.0,
    100.0,
    300.0,
)  #: unequal, because both designs of D agree if K and Z are the same for all coordinates of a set
CHOICES = (
    Choice("figures"),
    Choice("K = 25", stiffness=(25.0, 25.0, 25.0)),
    Choice("K = 400", stiffness=(400.0, 400.0, 400.0)),
    Choice("Z = 0.5", damping_ratio=0.5),
    Choice("Z = 1", damping_ratio=1.0),
    Choice("K = 30, 100, 300", stiffness=MIXED),
    Choice("same, double diagonal", stiffness=MIXED, damping="double_diagonal"),
    Choice("steps x 0.5", steps=0.5),
    Choice("steps x 0.75", steps=0.75),
    Choice("larger box for (x, y)", places=(GENTLE, STRONG, WIDE)),
    Choice("same, K = 30, 100, 300", stiffness=MIXED, places=(GENTLE, STRONG, WIDE)),
    Choice("lengths 1, 0.8, 0.6", lengths=(1.0, 0.8, 0.6), places=SHORT),
    Choice("lengths 0.5, 0.4, 0.3", lengths=(0.5, 0.4, 0.3), places=SHORT),
)
QUICK = ("figures", "K = 25", "same, double diagonal")


def main(quick: bool = False) -> dict[str, float]:
    """Measure all choices and print a table.

    Args:
        quick: three choices and coarser fits.

    Returns:
        The worst number of each conclusion over all choices, and the coupling of the named problem.
    """
    rows = [measured(choice, quick) for choice in CHOICES if not quick or choice.name in QUICK]
    for line in table(rows):
        print(line)
    gains = np.array([np.divide(row.linear, row.fitted) for row in rows])
    return {
        "choices": float(len(rows)),
        "least_gain_low_curvature": float(gains[:, 0].min()),
        "least_gain_high_curvature": float(gains[:, 1].min()),
        "largest_error_share": max(row.error_share for row in rows),
        "choices_with_mutual_feedback_above_1": float(sum(row.mutual_feedback > 1 for row in rows)),
        "least_mutual_feedback": min(row.mutual_feedback for row in rows),
        "least_mutual_feed_forward": min(row.mutual_feed_forward for row in rows),
        "largest_mutual_feed_forward": max(row.mutual_feed_forward for row in rows),
        "largest_share_not_ok": max(row.not_ok for row in rows),
        "planar_3r_x_coupling_x_from_xi1": named_problem(quick),
    }


def measured(choice: Choice, quick: bool) -> Row:
    """Run all measurements for one choice."""
    gentle, strong, folded = zip((INTERLEAVED, ALL_OF_X, ALL_OF_XY), choice.places, strict=True)
    fitted = [run(choice, "fitted", "x", *which, True, quick) for which in (gentle, strong)]
    linear = [run(choice, "linear", "x", *which, True, quick) for which in (gentle, strong)]
    regulated = run(choice, "fitted", "x", *gentle, False, quick)
    with_both = [run(choice, "fitted", "xy", *folded, forward, quick) for forward in (False, True)]
    sizes = parts(regulated)
    return Row(
        choice,
        (from_xi(linear[0]), from_xi(linear[1])),
        (from_xi(fitted[0]), from_xi(fitted[1])),
        sizes["largest_error"] / min(sizes["largest_curvature"], sizes["largest_coriolis"]),
        mutual_over_xi(with_both[0]),
        mutual_over_xi(with_both[1]),
        max(each.share_not_ok for each in (*fitted, regulated, *with_both)),
    )


def run(choice: Choice, kind: str, axes: Axes, moves: Moves, place: Place, feed_forward: bool, quick: bool) -> Run:
    """One run of a figure with the settings of a choice; steps in x and y scale with the size of the arm."""
    arm = Arm(choice.lengths)
    metres = choice.steps * sum(choice.lengths) / sum(LENGTHS)
    scaled = tuple(
        {label: to * (metres if label in "xy" else choice.steps) for label, to in move.items()} for move in moves
    )
    return follow(
        arm.linear(axes, place) if kind == "linear" else arm.fitted(axes, place, quick),
        arm.base(place),
        scaled,
        feed_forward,
        choice.stiffness,
        choice.damping_ratio,
        choice.damping,
    )


def from_xi(done: Run) -> float:
    """Largest coupling index x <- xi."""
    return float(np.nanmax(done.coupling.index[0, 1:]))


def mutual_over_xi(done: Run) -> float:
    """Largest deviation of x and y while the other is stepped, divided by their largest while xi is stepped."""
    sizes = np.array([max(abs(values)) for values in np.diff(done.reference.targets, axis=0).T])
    excursions = done.coupling.index * sizes
    return float(max(excursions[0, 1], excursions[1, 0]) / max(excursions[:2, 2]))


def named_problem(quick: bool) -> float:
    """Coupling index x <- xi1 of planar_3r_x with the settings of the figures, for steps of 0.1 from its centre."""
    problem = problems.get("planar_3r_x")
    even = oc.Weights(length=0.1)  # even gradient lengths give a step of 0.1 the same meaning for every coordinate
    fitted = oc.fit(problem, oc.Polynomial(8), weights=even, samples=2000 if quick else None).chart
    moves: Moves = ({"x": 0.1}, {"xi1": 0.1}, {"x": 0.0}, {"xi1": 0.0})
    return from_xi(follow(fitted, problem.domain.centre, moves))


def table(rows: list[Row]) -> Iterator[str]:
    """The numbers, one line per choice."""
    yield "                       x <- xi, low curvature  x <- xi, high curvature  error    x, y over xi"
    yield "choice                 linear  fitted  ratio   linear  fitted  ratio    share    feedback  feed-forward"
    for row in rows:
        pairs = "   ".join(f"{a:7.5f} {b:7.5f} {a / b:5.0f}" for a, b in zip(row.linear, row.fitted, strict=True))
        ends = f"{row.error_share:7.4f}  {row.mutual_feedback:8.2f}  {row.mutual_feed_forward:8.2f}"
        note = "" if row.not_ok == 0 else f"  left the box ({percent(row.not_ok, 0, fault=True)})"
        yield f"{row.choice.name:<22} {pairs}  {ends}{note}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    for key, value in main(parser.parse_args().quick).items():
        print(f"{key:>32}: {value:.3g}")
