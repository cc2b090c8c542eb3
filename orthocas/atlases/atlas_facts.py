"""What an atlas tells about itself (ours)."""

from dataclasses import asdict
from typing import Any

import numpy as np

from orthocas.atlases.atlas_file import Stock
from orthocas.atlases.outcomes import Outcome
from orthocas.showing import listed, number_list


def facts_of(stock: Stock, charts: int) -> dict[str, str]:
    """Charts, joints and what was asked of them."""
    plan, problem = stock.plan, stock.plan.problem
    names = problem.robot.joint_names
    counts = " x ".join(str(count) for count in plan.lattice.counts.tolist())
    asked = plan.settings
    return {
        "atlas": f"{charts} charts of {problem.heading}",
        "fitted": f"{len(stock.charts)} charts, {_proved(stock)} of them proved not to fold; "
        f"{len(plan.maps)} symmetries, the identity included",
        "task": problem.task.heading,
        "metric": problem.metric.name,
        "boxes": f"divide {listed(names[i] for i in plan.joints)}; {counts} tiles",
        "half-widths": f"of tiles {number_list(plan.lattice.width / 2)}, halved at most {asked.splits} times",
        "left out": f"cyclic {listed(names[i] for i in plan.cyclic) or 'none'}, "
        f"idle {listed(names[i] for i in plan.idle) or 'none'}",
        "asked": f"leak {asked.leak_deg:g} deg, conditioning {asked.conditioning:g}, "
        f"relative singular value above {asked.least_singular_value:g}",
        "file": f"{stock.contents.size / 2**20:.3g} MiB",
    }


def data_of(stock: Stock, charts: int) -> dict[str, Any]:
    """Plain data for JSON."""
    plan, problem = stock.plan, stock.plan.problem
    names = problem.robot.joint_names
    outcomes = np.bincount(stock.records["outcome"], minlength=len(Outcome))
    return {
        "charts": charts,
        "fitted": len(stock.charts),
        "bytes": stock.contents.size,
        "task": problem.task.name,
        "metric": problem.metric.name,
        "joints": [names[i] for i in plan.joints],
        "cyclic_joints": [names[i] for i in plan.cyclic],
        "idle_joints": [names[i] for i in plan.idle],
        "symmetries": len(plan.maps),
        "tiles": plan.lattice.counts.tolist(),
        "tile_half_widths": (plan.lattice.width / 2).tolist(),
        "settings": asdict(plan.settings),
        "boxes": {outcome.name.lower(): int(outcomes[outcome]) for outcome in Outcome},
        "certified": _proved(stock),
        "fit_seconds": float(stock.records["seconds"].sum()),
    }


def _proved(stock: Stock) -> int:
    return int((stock.records["certified"][stock.charts] > 0).sum())
