"""Task angle against mutual angle by lambda2, and the price of a chart without folds by lambda3 (60 s).

The left panel shows the front of the 7-DoF arm for polynomial degrees 3 and 4, with the paper's network to compare;
colours show where coordinates become nearly parallel (the rank trap). The right panel raises the regularity weight
lambda3.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import orthocas as oc
from orthocas import problems
from orthocas.charts.quality import Report

PAPER = (2.06, 3.44)
LAMBDA2 = (1.0, 3.0, 10.0, 20.0, 30.0, 60.0, 100.0, 300.0)
LAMBDA3 = (0.0, 150.0, 500.0, 2000.0, 8000.0)


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Draw both panels.

    Args:
        out: folder for the picture.
        quick: degree 2 and three points per curve.

    Returns:
        Numbers of the picture: angles of the last degree [deg], task std of the first one at the ends of the front,
        conditioning at both ends of lambda3.
    """
    out.mkdir(parents=True, exist_ok=True)
    problem, samples = problems.get("iiwa"), 5_000 if quick else 100_000
    degrees, lambda2 = ((2,), LAMBDA2[::3]) if quick else ((3, 4), LAMBDA2)
    lambda3 = LAMBDA3[::2] if quick else LAMBDA3

    def judged(degree: int, *weights: float) -> Report:
        fit = oc.fit(problem, oc.Polynomial(degree), weights=(1000.0, *weights))  # type: ignore[arg-type]
        return oc.evaluate(fit.chart, samples)

    fronts = {degree: [judged(degree, value) for value in lambda2] for degree in degrees}
    regular = [judged(degrees[-1], 30.0, value) for value in lambda3]
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(1.6, 1))
    _draw_fronts(figure, figure.add_subplot(grid[:, 0]), lambda2, fronts)
    upper = figure.add_subplot(grid[0, 1])
    _draw_regularity(upper, figure.add_subplot(grid[1, 1], sharex=upper), degrees[-1], lambda3, regular)
    figure.savefig(out / "front.png", dpi=150)
    first = fronts[degrees[0]]
    last = zip(lambda2, fronts[degrees[-1]], strict=True)
    angles = {f"lambda2 = {value:g}": report for value, report in last}
    angles |= {f"lambda3 = {value:g}": report for value, report in zip(lambda3, regular, strict=True)}
    return {
        **{f"{name}, task std [deg]": report.task_angle.std for name, report in angles.items()},
        **{f"{name}, mutual std [deg]": report.mutual_angle.std for name, report in angles.items()},
        "task_std_small_lambda2": first[0].task_angle.std,
        "task_std_large_lambda2": first[-1].task_angle.std,
        "p01_small_lambda2": first[0].conditioning.p01,
        "p01_without_regularity": regular[0].conditioning.p01,
        "p01_with_regularity": regular[-1].conditioning.p01,
        "folded_with_regularity": float(regular[-1].folded_samples),
    }


def _draw_fronts(figure: Figure, axes: Axes, lambda2: tuple[float, ...], fronts: dict[int, list[Report]]) -> None:
    for (degree, reports), marker, side in zip(fronts.items(), "os", (1, -1), strict=False):
        task = [report.task_angle.std for report in reports]
        mutual = [report.mutual_angle.std for report in reports]
        quality = [report.conditioning.p01 for report in reports]
        axes.plot(task, mutual, color="0.6", zorder=1)
        points = axes.scatter(
            task, mutual, c=quality, cmap="viridis", vmin=0, vmax=0.7, marker=marker, s=45, label=f"degree {degree}"
        )
        for x, y, value in zip(task, mutual, lambda2, strict=True):
            axes.annotate(
                f"{value:g}",
                (x, y),
                xytext=(5 * side, 3 * side - 1),
                textcoords="offset points",
                fontsize=7,
                horizontalalignment="left" if side > 0 else "right",
            )
    axes.margins(x=0.08)
    figure.colorbar(points, ax=axes, label="conditioning, 1 % quantile")
    axes.scatter(*PAPER, color="#d95f02", marker="*", s=120, label="paper's network (its own samples)")
    axes.set_yscale("log")
    axes.set_yticks([1, 2, 3, 5, 10, 20, 40], [str(v) for v in (1, 2, 3, 5, 10, 20, 40)])
    axes.minorticks_off()
    axes.set_xlabel("task angle, std [deg]")
    axes.set_ylabel("mutual angle, std [deg]")
    axes.set_title(r"front by $\lambda_2$ (numbers), $\lambda_1 = 1000$, $\lambda_3 = 0$", fontsize=10)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def _draw_regularity(upper: Axes, lower: Axes, degree: int, lambda3: tuple[float, ...], reports: list[Report]) -> None:
    """The conditioning above, and the task angle that it costs below."""
    places = np.arange(len(lambda3))
    upper.plot(places, [r.conditioning.p01 for r in reports], "o-", color="#1f5fa8", label="1 % quantile")
    upper.plot(places, [r.conditioning.min for r in reports], "s-", color="#7570b3", label="minimum, searched")
    upper.set(ylabel="conditioning", ylim=(0, 1))
    upper.set_title(rf"price of a chart without folds, degree {degree}, $\lambda_2 = 30$", fontsize=10)
    upper.legend(fontsize=8, loc="center right")
    upper.tick_params(labelbottom=False)
    lower.plot(places, [r.task_angle.std for r in reports], "^-", color="#d95f02")
    lower.set_xticks(places, [f"{v:g}\n{r.folded_samples}" for v, r in zip(lambda3, reports, strict=True)])
    lower.set(
        xlabel=r"$\lambda_3$, with the number of folded samples below", ylabel="task angle,\nstd [deg]", ylim=(0, None)
    )
    for axes in (upper, lower):
        axes.grid(alpha=0.3)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for name, value in main(arguments.out, arguments.quick).items():
        print(f"{name:>26}: {value:.3f}")
