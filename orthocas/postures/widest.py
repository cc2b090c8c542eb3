"""The widest box on which trial charts keep their bounds (ours)."""

from dataclasses import dataclass

import numpy as np

from orthocas.checks import Array
from orthocas.domains import Box
from orthocas.errors import DomainError
from orthocas.minimising.watch import Monitor, Progress
from orthocas.postures.probe import Bounds, Miss, Prober, Verdict

_START, _STEP = 0.5, 1.6  # first scale of the box, and factor to the next while the border is unknown
_CLOSE = 1.06  # the border is found within this factor
_SMALLEST = 1e-3  # scale of a box that is too small to be of use
_ROUNDS = 2  # exchanges of width between joints
_WIDER = 1.2  # factor by which one joint alone is widened
_LARGEST_EXCHANGE = np.log(1.5)
_STAGE = "suggest a domain"
_PROBES, _PROBES_OF_A_JOINT = 15, 3  # about as many as a search needs
#: what helps if no box keeps the bounds
REMEDIES = (
    "another home (home=..., --centre or --home), another metric (metric=..., --metric), a larger leak_deg "
    "(--leak-deg) or a smaller conditioning (--conditioning) may help"
)


@dataclass(eq=False)
class WidestBox:
    """Search for the half-widths with the largest product that keep the bounds.

    From a common scale, rounds of exchange follow: joints whose widening costs little become wider, the others
    narrower, and the scale returns to the border of the bounds. At the optimum all joints that are free cost the same.

    Args:
        prober: fits and judges trial boxes.
        home: centre of the boxes, (n,).
        room: largest half-widths, (n,).
        free: joints to widen. The others have their full room.
        bounds: what is asked.
        monitor: called with progress.
    """

    prober: Prober
    home: Array
    room: Array
    free: list[int]
    bounds: Bounds
    monitor: Monitor
    probes: int = 0

    def found(self, unit: Array) -> tuple[Array, dict[int, list[Miss]]]:
        """Half-widths (n,), and for every free joint the bounds that break if it alone becomes a fifth wider.

        The list of a joint is empty if no bound breaks because the joint has no room.

        Args:
            unit: half-widths to start from, (n,); only their proportions count.

        Raises:
            DomainError: if no box around the home keeps the bounds.
        """
        if not self.free:
            return self.room.copy(), {}
        widths = self._to_border(unit, _START)
        for _ in range(_ROUNDS):
            trial = self._to_border(widths * np.exp(-self._exchange(widths)), 1.0)
            if np.log(trial[self.free]).sum() <= np.log(widths[self.free]).sum():
                break
            widths = trial
        return self._grown(widths)

    def verdict(self, widths: Array) -> Verdict:
        """Fit and judge the box of the given half-widths."""
        self.probes += 1
        detail = f"trial {self.probes}: mean half-width {widths[self.free].mean():.3g}"
        expected = _PROBES + _PROBES_OF_A_JOINT * len(self.free)
        self.monitor(Progress(_STAGE, min(0.99, self.probes / expected), detail))
        return self.prober.verdict(Box(self.home, widths))

    def _clipped(self, widths: Array) -> Array:
        clipped = self.room.copy()
        clipped[self.free] = np.minimum(widths, self.room)[self.free]
        return clipped

    def _excess(self, widths: Array) -> float:
        return max(self.verdict(widths).excess(self.bounds).values())

    def _refusal(self, widths: Array) -> DomainError:
        """Which bound breaks even on a box of these half-widths (n,), and what may help."""
        found = self.verdict(widths)
        miss = next(iter(found.excess(self.bounds)))
        return DomainError(
            f"no box around the home {np.round(self.home, 4).tolist()} keeps the bounds: with half-widths of "
            f"{widths[self.free].max():.1g} {found.told(miss, self.bounds)}; {REMEDIES}"
        )

    def _to_border(self, unit: Array, scale: float) -> Array:
        """The widest multiple of half-widths that keeps the bounds."""
        low, high = 0.0, np.inf
        while high > _CLOSE * low:
            widths = self._clipped(scale * unit)
            if self._excess(widths) <= 1:
                low = scale
                if np.array_equal(widths, self.room):
                    break
            else:
                high = scale
            if high < _SMALLEST:
                raise self._refusal(widths)
            scale = low * _STEP if np.isinf(high) else high / _STEP**2 if low == 0 else float(np.sqrt(low * high))
        return self._clipped(low * unit)

    def _exchange(self, widths: Array) -> Array:
        """How much narrower each joint becomes, as logarithms of factors, (n,): its cost above the mean cost."""
        costs, here = np.zeros(len(widths)), self._excess(widths)
        open_joints = [k for k in self.free if widths[k] < self.room[k]]
        for k in open_joints:
            costs[k] = np.log(self._excess(self._widened(widths, k)) / here) / np.log(_WIDER)
        if open_joints:
            costs[open_joints] -= costs[open_joints].mean()
        return np.clip(costs, -_LARGEST_EXCHANGE, _LARGEST_EXCHANGE)

    def _grown(self, widths: Array) -> tuple[Array, dict[int, list[Miss]]]:
        """Widen each joint alone while the bounds are kept, and say what breaks then."""
        broken: dict[int, list[Miss]] = {k: [] for k in self.free}
        for k in self.free:
            factor = _WIDER
            while widths[k] < self.room[k]:
                wider = self._widened(widths, k, factor)
                misses = [name for name, ratio in self.verdict(wider).excess(self.bounds).items() if ratio > 1]
                if misses and factor == _WIDER:
                    broken[k] = misses
                    break
                widths = widths if misses else wider
                factor = _WIDER if misses else factor**2
        return widths, broken

    def _widened(self, widths: Array, k: int, factor: float = _WIDER) -> Array:
        wider = widths.copy()
        wider[k] = min(factor * widths[k], self.room[k])
        return wider
