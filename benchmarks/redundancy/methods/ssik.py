"""ssik: analytical inverse kinematics, with the tracker and the redundancy coordinate that it names."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import ssik
from redundancy.arms import BASE, TICK, TIP, Arm
from redundancy.protocol import Target, Unsuited

from orthocas.tools.checks import Array

STEPS, NEAR = 6, 1e-4  # of the search for the redundancy, and the error at which it ends [rad]


class SSIK:
    """Its streaming tracker. A wish for the elbow or the posture slides the redundancy, by a search for its value."""

    name = "ssik"
    packages = ("ssik",)
    grid = ({"jump_threshold": 0.5}, {"jump_threshold": 0.1}, {"jump_threshold": 1.0})

    def __init__(self, arm: Arm, jump_threshold: float) -> None:
        if arm.mobile:
            raise Unsuited("solves arms of 6 or 7 joints")
        self.arm, self.threshold = arm, jump_threshold
        with TemporaryDirectory() as folder:
            path = Path(folder) / "arm.urdf"
            path.write_text(arm.file)
            self.ik = ssik.Manipulator.from_urdf(path, base=BASE, ee=TIP)

    def start(self, q: Array, path: Sequence[Target] | None) -> None:
        """Begin at q."""
        self.tracker = self.ik.tracker(q, max_joint_speed=self.arm.fastest, jump_threshold=self.threshold, t0=0.0)
        self.time, self.posture = 0.0, q

    def step(self, target: Target) -> Array:
        """Follow, and slide where posture or elbow ask for it."""
        self.time += TICK
        q = np.array(self.tracker.update(target.placement.homogeneous, self.time).q)
        asked = target.elbow is not None or target.posture is not self.arm.home
        if asked and self.tracker.redundancy is not None:
            self._slide(target)
            q = np.array(self.tracker.q)
        return q

    def _slide(self, target: Target) -> None:
        """A secant on what is left of the wish, in the redundancy's own number."""
        last, rest = self.tracker.redundancy.t, self._rest(target)
        ahead = last + 1e-3
        for _ in range(STEPS):
            if abs(rest) < NEAR:
                return
            low, high = self.tracker.redundancy.arc
            self.tracker.set_redundancy(float(np.clip(ahead, low, high)))
            now, left = self.tracker.redundancy.t, self._rest(target)
            if now == last or left == rest:
                return
            ahead, last, rest = now - left * (now - last) / (left - rest), now, left

    def _rest(self, target: Target) -> float:
        """What is left of the wished elbow, or of the way to the wished posture along the self-motion."""
        q = np.array(self.tracker.q)
        if target.elbow is not None:
            return target.elbow - self.arm.elbow(q)
        return float(self.arm.elbow(target.posture) - self.arm.elbow(q))


METHODS = (SSIK,)
