"""Judging mutants in a child process with limits, so that a crash is a finding and not the end."""

import multiprocessing
import resource
import signal
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import FrameType

from orthocas.errors import OrthocasError

SECONDS = 10.0  #: of processor time for one mutant; other work on the machine does not count
MEMORY = 2**30  #: bytes that a child may take beyond what it has after its imports
_LONGEST = 2000  # characters of an error

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
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {str(error)[:200]} ({where.filename}:{where.lineno})"
    return None


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
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    child = context.Process(target=_work, args=(judge, seeds, seconds, there), daemon=True)
    child.start()
    there.close()
    findings = []
    for done, seed in enumerate(seeds, start=1):
        try:
            waited = here.poll(5 * seconds + (60 if done == 1 else 0))  # the first waits for imports too
            what = here.recv() if waited else "hangs where Python cannot interrupt it"
        except EOFError:
            child.join()
            what = f"its process died with exit code {child.exitcode}"
            waited = False
        if what is not None:
            findings.append(Finding(campaign, seed, what))
        if not waited:
            child.kill()
            child.join()
            return done, findings
    child.join()
    return len(seeds), findings


def _work(judge: Judge, seeds: list[int], seconds: float, answers: Connection) -> None:
    """In the child: one answer for every seed."""
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    _limit_memory(used + MEMORY)
    signal.signal(signal.SIGPROF, _time_is_up)
    for seed in seeds:
        signal.setitimer(signal.ITIMER_PROF, seconds)
        try:
            answer = judge(seed)
        except _TimeIsUp:
            answer = f"takes more than {seconds:g} s"
        except BaseException as error:
            answer = f"the judge failed: {type(error).__name__}: {str(error)[:200]}"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        answers.send(answer)


def _limit_memory(most: int) -> None:
    """Bound the data segment: private memory, not what libraries map."""
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    resource.setrlimit(resource.RLIMIT_DATA, (most + 2**30, hard))


def _time_is_up(number: int, frame: FrameType | None) -> None:
    raise _TimeIsUp
