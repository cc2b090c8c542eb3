"""Worker processes end with their parent, also if it is killed."""

import ctypes
import os
import signal
import sys
import threading
from multiprocessing import parent_process
from multiprocessing.connection import wait

_PR_SET_PDEATHSIG = 1  # of prctl(2)


def end_with_parent(parent: int) -> None:
    """End this process when its parent has ended, however that came about.

    On Linux the kernel sees to it at once. Elsewhere a thread waits for the parent, and ends the process as soon as
    compiled code lets it run.

    Args:
        parent: process id of the parent, which may have ended already.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def begin_worker(parent: int) -> None:
    """Initialise a worker process: Ctrl-C is for its parent, and it ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(parent)


def _wait_for_parent() -> None:
    process = parent_process()
    if process is not None:
        wait([process.sentinel])
        os._exit(1)
