"""ssik: analytical inverse kinematics, with the tracker and the redundancy coordinate that it names."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import ssik

from orthocas.tools.checks import Array
from redundancy.arms import BASE, TICK, TIP, Arm
from redundancy.protocol import Target, Unsuited
from redundancy.search import secant


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
        self.tracker = self._tracker(q)
        self.time, self.posture, self.wished = 0.0, self.arm.home, None

    def step(self, target: Target) -> Array:
        """Slide to a wished posture of a tool at rest, or follow, and search for a wished elbow."""
        self.time += TICK
        if target.elbow is None and target.posture is not self.posture:
            self.posture = target.posture
            there = self._tracker(target.posture).redundancy
            self.wished = there.t if there else None
        if target.elbow is None and self.wished is not None:
            self.tracker.set_redundancy(self.wished, self.time)
        else:
            self.tracker.update(target.placement.homogeneous, self.time)
        if target.elbow is not None and self.tracker.redundancy is not None:
            self._slide(target.elbow)
        return np.array(self.tracker.q)

    def _tracker(self, q: Array) -> ssik.Tracker:
        return self.ik.tracker(q, max_joint_speed=self.arm.fastest, jump_threshold=self.threshold, t0=0.0)

    def _slide(self, wished: float) -> None:
        """Search for the redundancy at which the elbow has the wished angle [rad]."""

        def rest(value: float) -> float:
            if self.tracker.redundancy is not None:
                self.tracker.set_redundancy(float(np.clip(value, *self.tracker.redundancy.arc)))
            return wished - self.arm.elbow(np.array(self.tracker.q))

        secant(rest, self.tracker.redundancy.t)


METHODS = (SSIK,)
