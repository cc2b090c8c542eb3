"""Processes of this machine, each in a pool of its own: if one dies, only its own work is lost (ours)."""

import os
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from typing import Any

from orthocas.atlases.jobs import keep_plan
from orthocas.comparing.workers import begin_worker, starting_workers, worker_pool


class Processes(Executor):
    """An executor of single processes with one thread each. One that died is replaced when work is submitted to it.

    Args:
        size: number of processes.
        plan: what `keep_plan` keeps in each.
    """

    def __init__(self, size: int, plan: bytes) -> None:
        self._plan = plan
        self._pools = [self._pool() for _ in range(size)]
        self._pending: list[set[Future[Any]]] = [set() for _ in range(size)]

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Run `work` in the process with the least to do."""
        for pending in self._pending:
            pending -= {future for future in pending if future.done()}
        slot = min(range(len(self._pools)), key=lambda k: len(self._pending[k]))
        try:
            future = self._started(slot, work, *arguments, **named)
        except BrokenExecutor:
            self._pools[slot].shutdown(wait=False)
            self._pools[slot] = self._pool()
            future = self._started(slot, work, *arguments, **named)
        self._pending[slot].add(future)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes at once: what they have not handed over runs again the next time."""
        for pool in self._pools:
            for process in list((pool._processes or {}).values()):  # a pool would wait for running work
                process.kill()
            pool.shutdown(wait=wait, cancel_futures=True)

    def _started(self, slot: int, work: Callable[..., Any], *arguments: Any, **named: Any) -> Future[Any]:
        with starting_workers():
            return self._pools[slot].submit(work, *arguments, **named)

    def _pool(self) -> ProcessPoolExecutor:
        return worker_pool(1, _begin, os.getpid(), self._plan)


def _begin(parent: int, plan: bytes) -> None:
    begin_worker(parent)
    keep_plan(plan)
