"""One thread that does what a page asks for, in order; of several wishes for the same thing only the last."""

import logging
import threading
import time
from collections.abc import Callable

Job = Callable[[], None]
Tick = Callable[[float], bool]  #: seconds since it began -> whether it goes on

_log = logging.getLogger(__name__)
_FRAME = 1 / 30  # [s] between ticks; browsers without a graphics card fall behind more
_QUIET = 0.25  # [s] without jobs, after which the page settles


class Loop:
    """Runs jobs, ticks of an animation, and `settle` once after a while without jobs.

    Args:
        settle: what to do when nothing was asked for during a quarter of a second.
        failed: told of an error in a job.
    """

    def __init__(self, settle: Job, failed: Callable[[Exception], None]) -> None:
        self._settle, self._failed = settle, failed
        self._jobs: dict[str, Job] = {}
        self._tick: Tick | None = None
        self._begun = 0.0
        self._wake = threading.Condition()
        self._running = False
        self._thread = threading.Thread(target=self._run, name="orthocas view", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._running = True
        self._thread.start()

    def stop(self) -> None:
        """End, after the job that is being done."""
        with self._wake:
            self._running = False
            self._wake.notify()
        if self._thread is not threading.current_thread() and self._thread.is_alive():
            self._thread.join(timeout=2.0)

    def ask(self, what: str, job: Job) -> None:
        """Ask for a job; one that was asked for under the same name and has not begun is dropped."""
        with self._wake:
            self._jobs.pop(what, None)
            self._jobs[what] = job
            self._wake.notify()

    def animate(self, tick: Tick | None) -> None:
        """Call a function up to 30 times a second until it returns False; None ends an animation."""
        with self._wake:
            self._tick, self._begun = tick, time.monotonic()
            self._wake.notify()

    def _run(self) -> None:
        settled = True
        while self._running:
            jobs, tick = self._next(settled)
            if not jobs and tick is None and not settled:
                jobs, settled = [self._settle], True
            elif jobs or tick is not None:
                settled = False
            for job in jobs:
                self._do(job)
            if tick is not None:
                self._do(lambda tick=tick: self._advance(tick))  # type: ignore[misc]

    def _next(self, settled: bool) -> tuple[list[Job], Tick | None]:
        """What to do now; waits until there is something."""
        with self._wake:
            if not self._jobs and self._running:
                self._wake.wait(_FRAME if self._tick else None if settled else _QUIET)
            jobs, self._jobs = list(self._jobs.values()), {}
            return jobs, self._tick

    def _advance(self, tick: Tick) -> None:
        """One tick of an animation."""
        if not tick(time.monotonic() - self._begun):
            with self._wake:
                self._tick = None if self._tick is tick else self._tick

    def _do(self, job: Job) -> None:
        try:
            job()
        except Exception as error:  # a page goes on after an error, and tells it
            _log.debug("a job of the view failed", exc_info=True)
            self._failed(error)
