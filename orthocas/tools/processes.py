"""Processes that share work: local workers, and Dask schedulers for many machines."""

import ctypes
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import contextmanager, suppress
from importlib import import_module
from multiprocessing import current_process, get_context, parent_process, resource_tracker
from multiprocessing.connection import wait
from typing import Any

from orthocas.errors import ArchiveError, CompileError, SchedulerError
from orthocas.tools.interrupts import deferred

# Constant of prctl(2).
_PR_SET_PDEATHSIG = 1
# Constants of mallopt(3).
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
# Start new interpreters, because forked ones inherit locks of threads that no longer run.
_SPAWN = get_context("spawn")
ATTEMPTS = 3  #: attempts for work whose process dies
_log = logging.getLogger(__name__)


class Processes(Executor):
    """An executor of processes with one thread each. A process that died is replaced when work is submitted to it.

    Args:
        size: number of processes.
        begin: called first in each process; it calls `begin_worker`.
        arguments: arguments of `begin`.

    Raises:
        ArchiveError: if the system's shared memory is full.
        SystemExit: in worker processes, if the script has no main guard, because importing it would start them again.
    """

    def __init__(self, size: int, begin: Callable[..., object], *arguments: object) -> None:
        if getattr(current_process(), "_inheriting", False):
            raise SystemExit(
                "orthocas: a script that starts processes needs `if __name__ == '__main__':` around its calls"
            )
        self._begin = begin, arguments
        self._pools = [self._build_pool() for _ in range(size)]
        self._pending: list[set[Future[Any]]] = [set() for _ in range(size)]

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Run `work` in the process with the least work."""
        for pending in self._pending:
            pending -= {future for future in pending if future.done()}
        slot = min(range(len(self._pools)), key=lambda k: len(self._pending[k]))
        try:
            future = self._submit_to(slot, work, *arguments, **named)
        except (BrokenExecutor, BrokenPipeError):
            # A broken pipe: the process died before it received its arguments.
            _log.warning("a worker process died, killed or out of memory: another one takes its place")
            self._pools[slot].shutdown(wait=False)
            self._pools[slot] = self._build_pool()
            future = self._submit_to(slot, work, *arguments, **named)
        self._pending[slot].add(future)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes at once. Unreturned results are lost."""
        for pool in self._pools:
            # A pool would wait for running work.
            for process in list((pool._processes or {}).values()):
                process.kill()
            pool.shutdown(wait=wait, cancel_futures=True)

    def _submit_to(self, slot: int, work: Callable[..., Any], *arguments: Any, **named: Any) -> Future[Any]:
        with starting_workers():
            return self._pools[slot].submit(work, *arguments, **named)

    def _build_pool(self) -> ProcessPoolExecutor:
        try:
            # Block SIGHUP meanwhile: multiprocessing's resource tracker inherits this, and so survives a hang-up to
            # free shared memory.
            if hasattr(signal, "SIGHUP"):
                with _block(signal.SIGHUP):
                    resource_tracker.ensure_running()
            return ProcessPoolExecutor(1, _SPAWN, *self._begin)
        except OSError as error:
            # The error names no file.
            raise ArchiveError(
                f"cannot share memory with processes: {error.strerror}, expected room in /dev/shm"
            ) from None


@contextmanager
def starting_workers() -> Iterator[None]:
    """Context in which an executor starts processes, that is, for its first calls of `submit`.

    The processes use one thread each, so that they do not compete for cores, and they ignore Ctrl-C, even during
    imports. In this process, all signals wait until the end of the context, because an interrupted start leaves an
    unknown process, or one that reports a broken input.
    """
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        with deferred(), _block(signal.SIGINT):
            yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def worker_died(future: Future[Any]) -> bool:
    """Whether the process of a finished future died, locally or at a Dask scheduler."""
    error = None if future.cancelled() else future.exception()
    return isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker"


def in_order(executor: Executor, work: Callable[..., Any], *columns: Sequence[Any]) -> Iterator[Any]:
    """Like `executor.map`, but work whose process died is repeated, up to `ATTEMPTS` times in total."""
    rows = list(zip(*columns, strict=True))
    futures = [executor.submit(work, *row) for row in rows]
    try:
        for k, row in enumerate(rows):
            # Return results in the order of the work, and repeat the work of dead processes.
            for _ in range(ATTEMPTS - 1):
                wait_for([futures[k]])
                if worker_died(futures[k]):
                    futures[k] = executor.submit(work, *row)
            yield futures[k].result()
    finally:
        for future in futures:
            future.cancel()


def begin_worker(parent: int) -> None:
    """Initialise a worker process: it ignores Ctrl-C, and ends when its parent ends for any reason.

    On Linux, the kernel ends it at once. Elsewhere, a thread waits for the parent, and ends the process as soon as
    compiled code lets it run. If the parent ended before this call, the worker ends here, after its imports.

    Args:
        parent: process id of the parent, which may have ended already.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    process = parent_process()
    if process is not None:
        wait([process.sentinel])
        os._exit(1)


@contextmanager
def _block(number: signal.Signals) -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {number})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run_program(command: Sequence[str]) -> str:
    """Run a compiler or a program, and return its output. Ctrl-C ends it with all its child processes.

    Raises:
        CompileError: if it fails or cannot start. The message has the first lines of its error output.
    """
    group, pipe = 0 if hasattr(os, "killpg") else None, subprocess.PIPE
    try:
        started = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, process_group=group)
    except OSError as error:
        raise CompileError(f"cannot start {command[0]}: {error.strerror}") from None
    with started as program:
        try:
            said, complaint = program.communicate()
        # After Ctrl-C or any other exception, end the whole process group.
        except BaseException:
            if group is not None:
                os.killpg(program.pid, signal.SIGKILL)
            program.kill()
            program.wait()
            raise
    if program.returncode != 0:
        raise CompileError(f"{' '.join(command)} failed with exit code {program.returncode}: {complaint[:500]}")
    return said


@contextmanager
def scheduler_executor(address: str) -> Iterator[Executor]:
    """An executor that runs on the workers of a Dask scheduler.

    Raises:
        SchedulerError: if Dask is not installed, or the scheduler does not answer.
    """
    try:
        distributed = import_module("distributed")
    except ImportError:
        raise SchedulerError("a scheduler needs Dask, expected the extra: pip install 'orthocas[dask]'") from None
    try:
        client = distributed.Client(address, timeout="10s")
    except (OSError, ValueError, TimeoutError) as error:
        raise SchedulerError(f"the scheduler {address} does not answer: {error}") from None
    # Mark jobs as new, because Dask's comparison of arguments by digests takes longer than sending them.
    with client:
        client.register_worker_callbacks(setup=keep_freed_memory)
        executor: Executor = client.get_executor(pure=False)
        yield executor


def keep_freed_memory() -> None:
    """Let this process keep up to a gigabyte of freed memory.

    Dask workers start with MALLOC_TRIM_THRESHOLD_ = 65536. With it, glibc returns freed arrays to the system and
    requests them again for the next arrays, which took half the processor time of a proof.
    """
    if sys.platform == "linux":
        # The C library may not be glibc.
        with suppress(AttributeError):
            library = ctypes.CDLL(None)
            library.mallopt(_M_TRIM_THRESHOLD, 2**30)
            # Arrays above this size are mapped one by one in any case.
            library.mallopt(_M_MMAP_THRESHOLD, 2**25)
