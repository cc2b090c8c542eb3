"""Judging mutants in a child process with limits, so that a crash is a finding and not the end.

Time is processor time: above `SECONDS` the mutant is a finding, above twice that the kernel ends the child, compiled
code or not. Memory is the resident peak beyond what the child held before the mutant: above `MEMORY` it is a finding,
and allocations beyond twice that fail, which is a finding too, whatever the code makes of the error.
"""

import multiprocessing
import re
import resource
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

from orthocas.errors import OrthocasError

SECONDS = 10.0  #: of processor time for one mutant; other work on the machine does not count
MEMORY = 2**30  #: bytes of resident memory that a mutant may take at its peak
_LONGEST = 2000  # characters of an error
_FOREIGN = re.compile(r"\w::\w|Tpl<|\.[ch](pp|xx)\b")  # types and places of C++ libraries

Judge = Callable[[int], str | None]  #: makes the mutant of a seed and says what is wrong with its treatment


@dataclass(frozen=True)
class Finding:
    """A mutant that broke the rule."""

    campaign: str
    seed: int
    what: str


class _TimeIsUp(BaseException):
    """Not an Exception, so that nobody handles it by mistake."""


def verdict(call: Callable[[], object]) -> str | None:
    """What is wrong with a call: nothing if it returns or raises an OrthocasError of one line."""
    try:
        call()
    except OrthocasError as error:
        text = str(error)
        if "\n" in text or len(text) > _LONGEST or not text.isprintable():
            return f"message of {len(text)} characters: {text[:200]!r}"
        if _FOREIGN.search(text):
            return f"C++ in a message: {text[:200]!r}"
        if any(map(_failed_allocation, _chain(error))):
            return f"takes more than {2 * MEMORY / 2**30:g} GiB: {text[:200]}"
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {str(error)[:200]} ({where.filename}:{where.lineno})"
    return None


def _failed_allocation(error: BaseException) -> bool:
    """Whether memory was refused; what we refuse ourselves, before anything is built, is an OrthocasError."""
    return "bad_alloc" in str(error) or (isinstance(error, MemoryError) and not isinstance(error, OrthocasError))


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error and those that it was raised for, also `from None`."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


class _Child:
    """A process that judges one job after the other: to start it takes seconds, for all that judges import."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, there = context.Pipe()
        self.process = context.Process(target=_work, args=(there,), daemon=True)
        self.process.start()
        there.close()


_idle: list[_Child] = []  # children that wait for the next campaign


def run(campaign: str, judge: Judge, seeds: Iterable[int], seconds: float = SECONDS) -> list[Finding]:
    """Judge the mutants of all seeds in a child; a child that dies or hangs is replaced by a new one."""
    findings, left = [], list(seeds)
    while left:
        done, found = _in_one_child(campaign, judge, left, seconds)
        findings += found
        left = left[done:]
    return findings


def _in_one_child(campaign: str, judge: Judge, seeds: list[int], seconds: float) -> tuple[int, list[Finding]]:
    """How many seeds one child got through, the one that ended it included, and its findings."""
    try:
        child = _idle.pop()
    except IndexError:
        child = _Child()
    here, process, findings = child.pipe, child.process, []
    here.send((judge, seeds, seconds))
    for done, seed in enumerate(seeds, start=1):
        try:
            waited = here.poll(20 * seconds + (60 if done == 1 else 0))  # on a busy machine; the first imports too
            what = here.recv() if waited else "hangs where Python cannot interrupt it"
        except EOFError:
            process.join()
            what = f"its process died with exit code {process.exitcode}"
            waited = False
        if what is not None:
            findings.append(Finding(campaign, seed, what))
        if not waited:
            process.kill()
            process.join()
            return done, findings
    _idle.append(child)
    return len(seeds), findings


def _work(jobs: Connection) -> None:
    """In the child: one answer for every seed of a job."""
    signal.signal(signal.SIGPROF, _time_is_up)
    while True:
        try:
            judge, seeds, seconds = jobs.recv()
        except EOFError:  # the parent has ended
            return
        for seed in seeds:
            jobs.send(_measured(judge, seed, seconds))
        for kind in (resource.RLIMIT_CPU, resource.RLIMIT_DATA):  # what the next job imports does not count
            hard = resource.getrlimit(kind)[1]
            resource.setrlimit(kind, (hard, hard))


def _measured(judge: Judge, seed: int, seconds: float) -> str | None:
    """What the judge says of a mutant, or that it takes too much time or memory."""
    _limit(seconds)
    held, start = _memory("VmRSS"), time.process_time()
    answer = _judged(judge, seed, seconds)
    used, taken = time.process_time() - start, _memory("VmHWM") - held
    if used > seconds:
        return f"takes {used:.1f} s"
    return f"takes {taken / 2**30:.1f} GiB" if taken > MEMORY else answer


def _judged(judge: Judge, seed: int, seconds: float) -> str | None:
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        return judge(seed)
    except _TimeIsUp:
        return f"takes more than {seconds:g} s"
    except BaseException as error:
        return f"the judge failed: {type(error).__name__}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _limit(seconds: float) -> None:
    """Hard limits for the next mutant, and a new start for the resident peak."""
    most = int(time.process_time() + 2 * seconds) + 2  # a second more than the timer, which a busy machine rings late
    resource.setrlimit(resource.RLIMIT_CPU, (most, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    resource.setrlimit(resource.RLIMIT_DATA, (_memory("VmData") + 2 * MEMORY, hard))  # private, not what files map
    Path("/proc/self/clear_refs").write_text("5")


def _memory(kind: str) -> int:
    """Bytes of this process, of a kind that Linux counts: VmRSS, its peak VmHWM, or VmData."""
    rows = Path("/proc/self/status").read_text().splitlines()
    return next(int(row.split()[1]) * 1024 for row in rows if row.startswith(kind + ":"))


def _time_is_up(number: int, frame: FrameType | None) -> None:
    raise _TimeIsUp
