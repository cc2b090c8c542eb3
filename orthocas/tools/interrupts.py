"""Signals during compiled code: recorded first, and raised when Python can handle them.

An exception cannot pass through CasADi's compiled code: it becomes another exception, or is lost. So a signal during
that code is only recorded. When the code returns, or when `check` is called, Ctrl-C becomes KeyboardInterrupt, and the
signals of `ended_in_order` become SystemExit.

Some of CasADi's Python code swallows exceptions of all kinds (`except: pass` in `vertcat` and others). A command line
or a fit that remembers signals (`remembered`, `ended_in_order`) still ends as interrupted.
"""

# Use the C module behind `signal`, whose wrappers convert to enums and would take most of the time of `deferred`.
import _signal  # type: ignore[import-not-found]
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

INTERRUPTED = 130  #: exit code of commands after Ctrl-C, as in shells
_ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class _Note:
    """The signal received during one `deferred` context of the main thread."""

    number: int | None = None

    def take(self, number: int, frame: FrameType | None) -> None:
        """Signal handler that records the first signal."""
        self.number = self.number or number


_notes: list[_Note] = []
# Notes of active `remembered` contexts.
_memories: list[_Note] = []
# Notes of active `ended_in_order` contexts.
_ends: list[_Note] = []


@contextmanager
def deferred() -> Iterator[None]:
    """Delay signals until the end of the context. Only the main thread gets signals, so others do nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    note = _Note()
    # Ask only for handlers of signals that are delayed, because this takes time.
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
            # Inform outer contexts too, because their compiled code may lose the exception.
            for outer in _notes:
                outer.number = outer.number or note.number
            # Raise the signal even if compiled code has raised another error.
            _raise(note.number)


def check() -> None:
    """Raise a delayed signal; for Python code that compiled code calls."""
    if threading.current_thread() is threading.main_thread():
        for note in _notes:
            if note.number is not None:
                _raise(note.number)


@contextmanager
def ended_in_order() -> Iterator[Callable[[], int]]:
    """Turn SIGTERM and SIGHUP into SystemExit with code 128 + number, so that drafts are removed; for command lines.

    Signals that the program ignores stay ignored, as under nohup. The context yields a function that returns this exit
    code if a signal was received (even if its exception was lost), otherwise 0. Python's complaints about exceptions of
    signals lost in callbacks of weak references are suppressed.
    """
    # Keep handlers that the program has installed.
    memory = _Note()
    _ends.append(memory)
    before = {number: signal.getsignal(number) for number in _ENDING}
    for number, handler in before.items():
        if handler is signal.SIG_DFL:
            signal.signal(number, _end)
    # Exceptions of signals that Python loses are remembered, so suppress the complaint.
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
    """Yield a function that returns whether Ctrl-C was received in this context, even if its exception was lost.

    If another handler than Python's default is installed, only signals delayed by compiled code are known. Threads
    other than the main one receive no signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    # Python's default handler raises an exception that compiled code may swallow, so install one that also records it.
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
    """Raise a lost signal of the innermost `ended_in_order` or `remembered` context; for long loops."""
    if threading.current_thread() is threading.main_thread():
        for memories in (_ends, _memories):
            if memories and (number := memories[-1].number) is not None:
                _raise(number)


def _end(number: int, frame: FrameType | None) -> NoReturn:
    for each in _ENDING:
        # Ignore further signals while the program ends.
        signal.signal(each, signal.SIG_IGN)
    _raise(number)


def _held(number: int, handler: object) -> bool:
    """Whether a signal would raise an exception: Ctrl-C unless ignored, others inside `ended_in_order`."""
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
