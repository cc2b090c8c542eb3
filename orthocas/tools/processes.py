"""Processes that share work: workers of this machine, and schedulers of many machines."""

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import active_children, current_process, get_context, parent_process, resource_tracker
from multiprocessing.connection import wait
from multiprocessing.synchronize import Event

from orthocas.errors import ArchiveError, SchedulerError

_PR_SET_PDEATHSIG = 1  # of prctl(2)
_PARENT = "ORTHOCAS_PARENT"  # environment variable with the process id of a worker's parent, until the worker reads it
_SPAWNED = "--multiprocessing-fork"  # on the command line of processes that multiprocessing starts
_SPAWN = get_context("spawn")  # new interpreters: forked ones inherit the locks of threads that no longer run


def worker_pool(size: int, begin: Callable[..., object], *arguments: object) -> ProcessPoolExecutor:
    """An executor whose processes call `begin(*arguments)` first; they start in blocks of `starting_workers`.

    A script without a main guard would call this in its workers again, while they import it: they end with one line.

    Raises:
        ArchiveError: if the system's shared memory is full.
    """
    if getattr(current_process(), "_inheriting", False):
        raise SystemExit("orthocas: a script that starts processes needs `if __name__ == '__main__':` around its calls")
    with _shared_memory_named():
        return ProcessPoolExecutor(size, _SPAWN, begin, arguments)


def shared_event() -> Event:
    """An event for such processes; see `worker_pool`."""
    with _shared_memory_named():
        return _SPAWN.Event()


@contextmanager
def _shared_memory_named() -> Iterator[None]:
    """Name the shared memory in errors, and let the process of multiprocessing that frees it outlive a hang-up."""
    try:
        if hasattr(signal, "SIGHUP"):
            with _blocked(signal.SIGHUP):  # which that process inherits, for ever
                resource_tracker.ensure_running()
        yield
    except OSError as error:  # which names no file
        raise ArchiveError(f"cannot share memory with processes: {error.strerror}, expected room in /dev/shm") from None


@contextmanager
def starting_workers() -> Iterator[None]:
    """For the block in which an executor starts processes, that is, around its first calls of `submit`.

    The processes use one thread each, so that they do not compete for cores. They end with this one from the moment
    when they import orthocas. Ctrl-C waits here until the end of the block; there it never comes, imports included.
    """
    given = {"OMP_NUM_THREADS": "1", _PARENT: str(os.getpid())}
    before = {name: os.environ.get(name) for name in given}
    os.environ.update(given)
    try:
        with _blocked(signal.SIGINT):
            yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def workers_killed_on_error() -> Iterator[None]:
    """Kill the processes that a block started if it raises: a pool waits for all of them, also while they import."""
    others = set(active_children())
    try:
        yield
    except BaseException:
        for process in set(active_children()) - others:
            process.kill()
        raise


def knows_parent() -> bool:
    """Whether this process may be one of `starting_workers`."""
    return _PARENT in os.environ


def end_early_with_parent() -> None:
    """End with the parent already while Python imports what a worker needs; `orthocas` calls it first of all.

    Other processes than those of `starting_workers` only forget about it, as does what they start.
    """
    parent = os.environ.pop(_PARENT)
    if _SPAWNED in sys.orig_argv:
        _end_with(int(parent))


def begin_worker(parent: int) -> None:
    """Initialise a worker process: Ctrl-C is for its parent, and it ends with it, however that comes about.

    On Linux the kernel sees to it at once. Elsewhere a thread waits for the parent, and ends the process as soon as
    compiled code lets it run.

    Args:
        parent: process id of the parent, which may have ended already.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with(parent)
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _end_with(parent: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _wait_for_parent() -> None:
    process = parent_process()
    if process is not None:
        wait([process.sentinel])
        os._exit(1)


@contextmanager
def _blocked(number: signal.Signals) -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {number})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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
    with client:
        executor: Executor = client.get_executor()
        yield executor
