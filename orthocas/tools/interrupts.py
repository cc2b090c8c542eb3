"""Signals while compiled code runs: recorded at once, and raised where Python can handle them.

An exception cannot pass through CasADi's compiled code: it comes out as another exception, or is lost. So while that
code runs, a signal is only recorded. When the code returns, or earlier where `check` is called, Ctrl-C becomes
KeyboardInterrupt, and the signals of `ended_in_order` become SystemExit.

Some of CasADi's Python swallows exceptions of all kinds (`except: pass` in `vertcat` and others). A command line or
a fit that remembers signals (`remembered`, `ended_in_order`) ends as interrupted all the same.
"""

# what `signal` wraps: its wrappers look for enums, which takes most of the time of `deferred`
import _signal  # type: ignore[import-not-found]
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

INTERRUPTED = 130  #: exit code of commands after Ctrl-C, as shells have it
_ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class _Note:
    """The signal that came during one `deferred` of the main thread."""

    number: int | None = None

    def take(self, number: int, frame: FrameType | None) -> None:
        """The handler meanwhile; the first signal counts."""
        self.number = self.number or number


_notes: list[_Note] = []
_memories: list[_Note] = []  # of `remembered`
_ends: list[_Note] = []  # of `ended_in_order`


@contextmanager
def deferred() -> Iterator[None]:
    """Hold signals back until the end of the block. Only the main thread gets them, so other threads do nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    note = _Note()
    # Others are not held; asking takes its time.
    numbers = (signal.SIGINT, *_ENDING) if _ends else (signal.SIGINT,)
    handlers = {number: _signal.getsignal(number) for number in numbers}
    before = {number: handler for number, handler in handlers.items() if _held(number, handler)}
    for number in before:
        _signal.signal(number, note.take)
    _notes.append(note)
    try:
        yield
    finally:
        _notes.remove(note)
        for number, handler in before.items():
            _signal.signal(number, handler)
        if note.number is not None:
            # Compiled code around this one may not pass the exception on.
            for outer in _notes:
                outer.number = outer.number or note.number
            # Also instead of what compiled code made of it.
            _raise(note.number)


def check() -> None:
    """Raise what is being held back; for code that compiled code calls."""
    if threading.current_thread() is threading.main_thread():
        for note in _notes:
            if note.number is not None:
                _raise(note.number)


@contextmanager
def ended_in_order() -> Iterator[Callable[[], int]]:
    """Turn SIGTERM and SIGHUP into SystemExit with 128 + their number, so that drafts go away; for command lines.

    Signals that the program ignores stay ignored, as under nohup. The value is a function that returns that exit code
    if one has come, even if its exception got lost, else 0. Python says nothing of exceptions of signals that it loses
    itself, in callbacks of weak references.
    """
    # Handlers of the program's own stay.
    memory = _Note()
    _ends.append(memory)
    before = {number: signal.getsignal(number) for number in _ENDING}
    for number, handler in before.items():
        if handler is signal.SIG_DFL:
            signal.signal(number, _end)
    # Exceptions of signals that Python loses are remembered, and need no complaint.
    complain = sys.unraisablehook

    def complain_of_others(lost: Any) -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt | SystemExit):
            complain(lost)

    sys.unraisablehook = complain_of_others
    try:
        yield lambda: 0 if memory.number is None else 128 + memory.number
    finally:
        sys.unraisablehook = complain
        _ends.remove(memory)
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def remembered() -> Iterator[Callable[[], bool]]:
    """A function that returns whether Ctrl-C has come during the block, even if its exception got lost.

    Where something other than Python's own handler is in charge, it reports only what compiled code held back. Other
    threads than the main one get no signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    # Python's own handler would raise an exception that compiled code may swallow; ours also notes it.
    memory, before = _Note(), signal.getsignal(signal.SIGINT)
    _memories.append(memory)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda number, frame: _raise(number))
    try:
        yield lambda: memory.number is not None
    finally:
        _memories.remove(memory)
        signal.signal(signal.SIGINT, before)


def check_remembered() -> None:
    """Raise what came during the innermost `ended_in_order` or `remembered` block and got lost; for long loops."""
    if threading.current_thread() is threading.main_thread():
        for memories in (_ends, _memories):
            if memories and (number := memories[-1].number) is not None:
                _raise(number)


def _end(number: int, frame: FrameType | None) -> NoReturn:
    for each in _ENDING:
        # The end is not to be disturbed.
        signal.signal(each, signal.SIG_IGN)
    _raise(number)


def _held(number: int, handler: object) -> bool:
    """Whether a signal would raise something: Ctrl-C unless it is ignored, others inside `ended_in_order`."""
    ours = handler is _end or isinstance(getattr(handler, "__self__", None), _Note)
    return callable(handler) if number == signal.SIGINT else ours


def _raise(number: int) -> NoReturn:
    if number == signal.SIGINT:
        for memory in _memories:
            memory.number = number
        raise KeyboardInterrupt
    for memory in _ends:
        memory.number = number
    raise SystemExit(128 + number)
