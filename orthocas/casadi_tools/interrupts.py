"""Ctrl-C while compiled code runs: recorded at once, and raised where Python can handle it.

An exception cannot pass through CasADi's compiled code: it comes out as another exception, or is lost. So while that
code runs, SIGINT is only recorded. KeyboardInterrupt is raised when the code returns, or earlier by `check`.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_notes: list[threading.Event] = []  # one for every `deferred` of the main thread


@contextmanager
def deferred() -> Iterator[None]:
    """Hold Ctrl-C back until the end of the block. Only the main thread receives it, so other threads do nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    note = threading.Event()

    def take(number: int, frame: FrameType | None) -> None:
        note.set()

    before = signal.signal(signal.SIGINT, take)
    _notes.append(note)
    try:
        yield
    finally:
        _notes.remove(note)
        signal.signal(signal.SIGINT, before)
        if note.is_set():
            for outer in _notes:  # compiled code further out may lose the exception
                outer.set()
            raise KeyboardInterrupt  # also replaces the exception that compiled code made of it


def check() -> None:
    """Raise KeyboardInterrupt if Ctrl-C is being held back. For Python code that compiled code calls."""
    if threading.current_thread() is threading.main_thread() and any(note.is_set() for note in _notes):
        raise KeyboardInterrupt
