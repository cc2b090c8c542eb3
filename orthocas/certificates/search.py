"""Branch and bound: check boxes, and halve those on which nothing is proved, the largest first."""

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
    """How boxes are shared between workers."""

    batch: int = 512  #: most boxes of one task
    small: int = 128  #: boxes; smaller tasks take longer for each
    tasks: int = 8  #: that the waiting boxes are cut into if they are few
    in_flight: int = 64  #: most tasks of an executor at a time


RULES = SearchRules()

_log = logging.getLogger(__name__)
Look = Callable[["Search"], None]  #: called after each batch


@dataclass(frozen=True)
class Limits:
    """When a search ends before all is proved."""

    seconds: float = np.inf
    boxes: int = MOST_BOXES // 4
    smallest: float = 2.0**-12  #: fraction of the width of the whole below which a joint's interval is not halved
    hopeless: int = MOST_BOXES  #: boxes after which the search ends if the rest would take more than `boxes`


@dataclass(eq=False)
class Search:
    """A search in progress: the tree of boxes, and those still to check."""

    check: BoxCheck
    base: Subdivision  #: its open parts are searched
    limits: Limits
    executor: Executor | None = None
    evaluated: int = 0
    proved_volume: float = 0.0  #: fraction of the whole
    open_count: int = 0  #: number of boxes where nothing is proved so far
    conditioning: float = np.inf  #: least of the lower bounds on proved boxes
    signs: dict[int, Array] = field(default_factory=dict)  #: sign of det J -> a point with that sign
    _codes: list[int] = field(default_factory=list)
    _children: list[int] = field(default_factory=list)  #: place of the lower half; the upper half follows
    _waiting: list[tuple[float, int, Array, Array]] = field(default_factory=list)  #: a heap
    _deaths: Counter[int] = field(default_factory=Counter)  #: of processes, by the places of their boxes

    def __post_init__(self) -> None:
        low, high = self.base.leaves(OPEN)
        # A search that goes on begins with what an earlier one has proved.
        self.proved_volume = self.base.share
        self._add(low, high)

    @property
    def folded(self) -> bool:
        """Whether det J was found with both signs."""
        return len(self.signs) == 2

    @property
    def finished(self) -> bool:
        """Whether everything is proved."""
        return OPEN not in self._codes and not self.folded

    def run(self, look: Look) -> None:
        """Search until all is proved, a fold shows, or a limit is reached. An interrupted search keeps its state."""
        end = time.monotonic() + self.limits.seconds
        pending: dict[Future[BoxResults], list[tuple[float, int, Array, Array]]] = {}
        try:
            while self._waiting or pending:
                # A fold ends the search, a limit, and a pace at which all would take too many boxes.
                hopeless = self.evaluated > max(self.limits.hopeless, self.proved_volume * self.limits.boxes)
                if self.folded or time.monotonic() > end or self.evaluated >= self.limits.boxes or hopeless:
                    break
                self._step(pending)
                look(self)
        finally:
            # Batches that nobody has finished wait again.
            for future, batch in pending.items():
                future.cancel()
                self._return(batch)

    def visit(self, points: Array) -> None:
        """Note the signs of det J at points (k, n), where they are proved."""
        # A point is a box without width.
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
            # The tree below an open part of the base, each box before its halves.
            waiting, root = [root], root + 1
            while waiting:
                place = waiting.pop()
                codes.append(self._codes[place])
                if codes[-1] < PROVED:
                    waiting += [self._children[place] + 1, self._children[place]]
        return Subdivision(self.base.low, self.base.high, np.array(codes, dtype=np.uint8))

    def _step(self, pending: dict[Future[BoxResults], list[tuple[float, int, Array, Array]]]) -> None:
        """Evaluate one batch here, or give batches to the executor and take back those that are done."""
        check_remembered()
        # Without an executor, one batch is evaluated here; Ctrl-C gives it back.
        if self.executor is None:
            batch = self._take()
            try:
                results = self.check(*_stack_corners(batch))
            except KeyboardInterrupt:
                self._return(batch)
                raise
            self._apply(batch, results)
            return
        # Keep the executor busy, and take back what it has evaluated.
        while self._waiting and len(pending) < RULES.in_flight:
            batch = self._take()
            try:
                pending[self.executor.submit(self.check, *_stack_corners(batch))] = batch
            except BrokenExecutor:
                raise CertifyError("the executor cannot be used any more: one of its processes died") from None
        done = wait(pending, return_when=FIRST_COMPLETED).done
        for future in done:
            batch = pending.pop(future)
            if not worker_died(future):
                self._apply(batch, future.result())
                continue
            # Boxes whose process died are tried again; after the last attempt they stay open.
            self._deaths.update(place for _, place, _, _ in batch)
            given_up = [box for box in batch if self._deaths[box[1]] >= ATTEMPTS]
            self._return([box for box in batch if self._deaths[box[1]] < ATTEMPTS])
            if given_up:
                _log.warning("%d boxes are left unproved: worker processes died over them", len(given_up))

    def _take(self) -> list[tuple[float, int, Array, Array]]:
        # As many boxes as there are, but enough tasks for all workers of an executor.
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
        # Signs at the centres of boxes without a proof are hints: visit one point for each sign that is new.
        for sign in {-1, 1} - set(self.signs):
            there = np.flatnonzero(results.sign == sign)
            if there.size:
                self.visit((low + high)[there[:1]] / 2)
        # Proved boxes are closed, all others are halved.
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
            # Where bounds are infinite, halve the relatively widest joint: a choice that stays the same may never help.
            if joint == UNKNOWN:
                joint = max(self.check.joints, key=lambda i: float(widths[i]))
            # Boxes too small to halve, or of no use to halve, stay open.
            if joint == NEVER or widths[joint] <= self.limits.smallest:
                continue
            # The halves take the place of the box.
            top, bottom = b.copy(), a.copy()
            top[joint] = bottom[joint] = halve_interval(a[joint], b[joint])
            self._codes[place], self._children[place] = joint, len(self._codes)
            self.open_count -= 1
            self._add(np.array([a, bottom]), np.array([top, b]))

    def _add(self, low: Array, high: Array) -> None:
        # New boxes are open, and wait, the largest first.
        self.open_count += len(low)
        for volume, a, b in zip(_measure_volumes(self.base, low, high).tolist(), low, high, strict=True):
            heapq.heappush(self._waiting, (-volume, len(self._codes), a, b))
            self._codes.append(OPEN)
            self._children.append(0)


def _measure_volumes(base: Subdivision, low: Array, high: Array) -> Array:
    # As fractions of the whole.
    return np.asarray(((high - low) / (base.high - base.low)).prod(axis=1))


def _stack_corners(batch: list[tuple[float, int, Array, Array]]) -> tuple[Array, Array]:
    return np.array([box[2] for box in batch]), np.array([box[3] for box in batch])
