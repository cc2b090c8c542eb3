"""Branch and bound: check boxes, the largest first, and halve those without a proof."""

import heapq
import logging
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass, field

import numpy as np

from orthocas.certificates.box_checks import NEVER, UNKNOWN, BoxCheck, BoxResults
from orthocas.charts.certificate import MOST_BOXES, OPEN, PROVED, Subdivision, halve_interval
from orthocas.errors import CertifyError
from orthocas.tools.checks import Array
from orthocas.tools.interrupts import check_remembered
from orthocas.tools.processes import ATTEMPTS, worker_died


@dataclass(frozen=True, slots=True)
class SearchRules:
    """How boxes are distributed to workers."""

    batch: int = 512  #: largest number of boxes per task
    small: int = 128  #: smallest useful number of boxes; smaller tasks cost more per box
    tasks: int = 8  #: tasks to form if few boxes are waiting
    in_flight: int = 64  #: largest number of tasks in an executor at a time


RULES = SearchRules()

_log = logging.getLogger(__name__)
Look = Callable[["Search"], None]  #: called after each batch


@dataclass(frozen=True)
class Limits:
    """When a search ends before everything is proved."""

    seconds: float = np.inf
    boxes: int = MOST_BOXES // 4
    smallest: float = 2.0**-12  #: a joint's interval is not halved below this fraction of the whole width
    hopeless: int = MOST_BOXES  #: after this many boxes, the search ends if it is expected to need more than `boxes`


@dataclass(eq=False)
class Search:
    """A search in progress: the tree of boxes, and the boxes still to check."""

    check: BoxCheck
    base: Subdivision  #: the search works on its open parts
    limits: Limits
    executor: Executor | None = None
    evaluated: int = 0
    proved_volume: float = 0.0  #: proved fraction of the whole volume
    open_count: int = 0  #: number of boxes without a proof so far
    conditioning: float = np.inf  #: smallest lower bound on proved boxes
    signs: dict[int, Array] = field(default_factory=dict)  #: sign of det J -> a point with this sign
    _codes: list[int] = field(default_factory=list)
    #: index of the lower half of each box; the upper half follows it
    _children: list[int] = field(default_factory=list)
    _waiting: list[tuple[float, int, Array, Array]] = field(default_factory=list)  #: a heap of boxes to check
    _deaths: Counter[int] = field(default_factory=Counter)  #: number of died processes, by the indices of their boxes

    def __post_init__(self) -> None:
        low, high = self.base.leaves(OPEN)
        # A resumed search starts with the volume that is already proved.
        self.proved_volume = self.base.share
        self._add(low, high)

    @property
    def folded(self) -> bool:
        """Whether det J has both signs."""
        return len(self.signs) == 2

    @property
    def finished(self) -> bool:
        """Whether everything is proved."""
        return OPEN not in self._codes and not self.folded

    def run(self, look: Look) -> None:
        """Search until all is proved, a fold is found, or a limit is reached. An interrupted search keeps its state."""
        end = time.monotonic() + self.limits.seconds
        pending: dict[Future[BoxResults], list[tuple[float, int, Array, Array]]] = {}
        try:
            while self._waiting or pending:
                # End at a fold, at a limit, or if the pace shows that the search would need too many boxes.
                hopeless = self.evaluated > max(self.limits.hopeless, self.proved_volume * self.limits.boxes)
                if self.folded or time.monotonic() > end or self.evaluated >= self.limits.boxes or hopeless:
                    break
                self._step(pending)
                look(self)
        finally:
            # Unfinished batches wait again.
            for future, batch in pending.items():
                future.cancel()
                self._return(batch)

    def visit(self, points: Array) -> None:
        """Record the signs of det J at points (k, n), where they are proved."""
        # A point is a box of zero width.
        results = self.check(points, points)
        for point, regular, sign in zip(points, results.regular, results.sign.tolist(), strict=True):
            if regular and sign:
                self.signs.setdefault(int(sign), point)

    def build_subdivision(self) -> Subdivision:
        """The tree so far."""
        codes: list[int] = []
        root = 0
        for code in self.base.codes.tolist():
            if code != OPEN:
                codes.append(code)
                continue
            # Build the tree below an open part of the base; each box comes before its halves.
            waiting, root = [root], root + 1
            while waiting:
                place = waiting.pop()
                codes.append(self._codes[place])
                if codes[-1] < PROVED:
                    waiting += [self._children[place] + 1, self._children[place]]
        return Subdivision(self.base.low, self.base.high, np.array(codes, dtype=np.uint8))

    def _step(self, pending: dict[Future[BoxResults], list[tuple[float, int, Array, Array]]]) -> None:
        """Evaluate one batch in this process, or exchange batches with the executor."""
        check_remembered()
        # Without an executor, evaluate one batch here; after Ctrl-C it waits again.
        if self.executor is None:
            batch = self._take()
            try:
                results = self.check(*_stack_corners(batch))
            except KeyboardInterrupt:
                self._return(batch)
                raise
            self._apply(batch, results)
            return
        # Keep the executor busy, and collect results.
        while self._waiting and len(pending) < RULES.in_flight:
            batch = self._take()
            try:
                pending[self.executor.submit(self.check, *_stack_corners(batch))] = batch
            except BrokenExecutor:
                raise CertifyError(
                    "the executor is broken, because one of its processes died: create a new one"
                ) from None
        done = wait(pending, return_when=FIRST_COMPLETED).done
        for future in done:
            batch = pending.pop(future)
            if not worker_died(future):
                self._apply(batch, future.result())
                continue
            # Retry boxes whose process died; after the last attempt they stay open.
            self._deaths.update(place for _, place, _, _ in batch)
            given_up = [box for box in batch if self._deaths[box[1]] >= ATTEMPTS]
            self._return([box for box in batch if self._deaths[box[1]] < ATTEMPTS])
            if given_up:
                _log.warning("%d boxes are left unproved: worker processes died over them", len(given_up))

    def _take(self) -> list[tuple[float, int, Array, Array]]:
        # Take many boxes, but form enough tasks for all workers of an executor.
        waiting = len(self._waiting)
        if self.executor is not None:
            waiting = max(waiting // RULES.tasks, min(RULES.small, waiting))
        return [heapq.heappop(self._waiting) for _ in range(min(RULES.batch, waiting))]

    def _return(self, batch: list[tuple[float, int, Array, Array]]) -> None:
        for box in batch:
            heapq.heappush(self._waiting, box)

    def _apply(self, batch: list[tuple[float, int, Array, Array]], results: BoxResults) -> None:
        """Close the boxes that are proved, and halve the others."""
        low, high = _stack_corners(batch)
        self.evaluated += len(batch)
        # Signs at centres of boxes without a proof are only hints, so check one point for each new sign.
        for sign in {-1, 1} - set(self.signs):
            there = np.flatnonzero(results.sign == sign)
            if there.size:
                self.visit((low + high)[there[:1]] / 2)
        # Close proved boxes, and halve all others.
        proved = results.proved
        if proved.any():
            self.conditioning = min(self.conditioning, float(results.conditioning[proved].min()))
            self.proved_volume += float(_measure_volumes(self.base, low[proved], high[proved]).sum())
        for k, (_, place, a, b) in enumerate(batch):
            if proved[k]:
                self._codes[place] = PROVED
                self.open_count -= 1
                continue
            widths = (b - a) / (self.base.high - self.base.low)
            joint = int(results.widest[k])
            # If bounds are infinite, halve the relatively widest joint. Halving the same joint each time might never
            # help.
            if joint == UNKNOWN:
                joint = max(self.check.joints, key=lambda i: float(widths[i]))
            # Boxes stay open if they are too small, or if halving is useless.
            if joint == NEVER or widths[joint] <= self.limits.smallest:
                continue
            # Replace the box by its halves.
            top, bottom = b.copy(), a.copy()
            top[joint] = bottom[joint] = halve_interval(a[joint], b[joint])
            self._codes[place], self._children[place] = joint, len(self._codes)
            self.open_count -= 1
            self._add(np.array([a, bottom]), np.array([top, b]))

    def _add(self, low: Array, high: Array) -> None:
        # New boxes wait, the largest first.
        self.open_count += len(low)
        for volume, a, b in zip(_measure_volumes(self.base, low, high).tolist(), low, high, strict=True):
            heapq.heappush(self._waiting, (-volume, len(self._codes), a, b))
            self._codes.append(OPEN)
            self._children.append(0)


def _measure_volumes(base: Subdivision, low: Array, high: Array) -> Array:
    # Relative to the whole volume.
    return np.asarray(((high - low) / (base.high - base.low)).prod(axis=1))


def _stack_corners(batch: list[tuple[float, int, Array, Array]]) -> tuple[Array, Array]:
    return np.array([box[2] for box in batch]), np.array([box[3] for box in batch])
