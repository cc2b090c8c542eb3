"""The quality of coordinates at joint positions: leak, conditioning, and distance to the border of the domain."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from orthocas.checks import Array
from orthocas.coordinates.map import CoordinateMap
from orthocas.domains import borders, contains
from orthocas.judging.gradients import Judged
from orthocas.problem import Problem
from orthocas.showing import Shown, number_list


@dataclass(frozen=True, eq=False, repr=False)
class PointQuality(Shown):
    """Quality of a chart at one joint position, or at each of N. NaN where a gradient vanishes or has no value."""

    leak_deg: Array  #: leak of each coordinate [deg], (r,) or (N, r); 0 is perfect
    conditioning: Array  #: smallest singular value of the normalised gradients, () or (N,); 1 perfect, 0 singular
    border_distance: Array  #: to the nearest face of the domain, () or (N,), <= 0 outside, inf for a torus [rad] or [m]

    def facts(self) -> dict[str, str]:
        """The worst values of the set, or those of the one position."""
        leak, conditioning, distance = np.atleast_2d(self.leak_deg), np.ravel(self.conditioning), self.border_distance
        known = np.isfinite(conditioning)
        single = np.ndim(self.conditioning) == 0
        facts = {"quality": "at one joint position" if single else f"at {len(leak)} joint positions"}
        if known.any():
            facts["leak"] = f"{'' if single else 'at most '}{number_list(leak[known].max(axis=0))} deg"
            facts["conditioning"] = f"{'' if single else 'at least '}{conditioning[known].min():.3g}"
        if np.size(distance):
            facts["border"] = f"{'' if single else 'at least '}{np.min(distance):.3g} away, in rad or m; < 0 outside"
        if not known.all():
            facts["left out"] = f"{int((~known).sum())}, where a gradient vanishes or has no value"
        return facts

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "leak_deg": self.leak_deg.tolist(),
            "conditioning": self.conditioning.tolist(),
            "border_distance": self.border_distance.tolist(),
        }


def point_quality(problem: Problem, coordinates: CoordinateMap, points: Array) -> PointQuality:
    """Quality at each joint position (N, n)."""
    judged = Judged.at(problem, coordinates, points)
    leak, conditioning = np.full((len(points), coordinates.r), np.nan), np.full(len(points), np.nan)
    leak[judged.kept] = np.degrees(np.arcsin(np.clip(judged.leak_sines, 0.0, 1.0)))
    conditioning[judged.kept] = judged.conditioning
    lower, upper = borders(problem.domain)
    distance = np.minimum(points - lower, upper - points).min(axis=1)
    distance = np.where(contains(problem.domain, points), distance, np.minimum(distance, 0.0))  # too near a singularity
    return PointQuality(leak, conditioning, distance)
