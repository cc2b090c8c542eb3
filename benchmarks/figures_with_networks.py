"""The figures of fits with networks in place of polynomials, several starts each: the numbers side by side (20 min)."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from orthocas.bases import MLP

sys.path.append(str(Path(__file__).parent.parent / "examples"))

from paper import FIGURES, ChosenFit
from paper.chosen_fit import USUAL

NUMBERS: dict[str, tuple[str, ...]] = {  # of each figure
    "fig19": ("mean_tilt_in_section_deg", "task_angle_std_deg"),
    "fig20": ("involutive_std_deg", "non_involutive_std_deg"),
    "fig23": ("coupling_x_from_xi1", "coupling_xi1_from_x", "task_angle_std_deg"),
    "fig24": ("strong_fitted_coupling_x_from_xi1", "strong_fitted_missed_x", "strong_fitted_task_angle_std_deg"),
    "fig25": ("largest_error", "largest_curvature", "largest_coriolis"),
    "fig26": ("fitted_large_tracking_error_x", "fitted_large_missed_x", "fitted_feedback_coupling_y_from_x"),
    "fig27": ("task_std_deg", "mutual_std_deg"),
    "fig28": ("joint_error_at_the_end_rad", "largest_coupling_index"),
    "fig30": ("feedback_coupling_x_from_y", "feedback_coupling_x_from_xi1", "task_angle_std_deg"),
}


def row(figure: str, fits: Sequence[ChosenFit], quick: bool) -> list[str]:
    """One line for each number: the polynomial, then the networks."""
    draw = FIGURES[figure].draw_fit
    assert draw is not None
    found = [draw(quick, fit).numbers for fit in fits]
    return [
        f"| {figure}: {name} | {' | '.join(f'{numbers[name]:.3g}' for numbers in found)} |" for name in NUMBERS[figure]
    ]


def main(quick: bool = False, figures: Sequence[str] = tuple(NUMBERS)) -> list[str]:
    """The rows; `quick` uses small networks, two starts, and coarse figures."""
    network, seeds = (MLP((12, 12)), 2) if quick else (MLP((32, 32)), 3)
    fits = [USUAL, *(ChosenFit(network, seed) for seed in range(seeds))]
    head = f"| figure: number | polynomial | {' | '.join(f'{network.label}, start {k + 1}' for k in range(seeds))} |"
    lines = [head, "| --- |" + " --- |" * len(fits)]
    print("\n".join(lines), flush=True)
    for figure in figures:
        lines += (rows := row(figure, fits, quick))
        print("\n".join(rows), flush=True)
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("figures", nargs="*")
    arguments = parser.parse_args()
    main(arguments.quick, arguments.figures or tuple(NUMBERS))
