"""Where the command line begins: signals first, then the imports, which take a second."""

import os
import signal
import sys
from types import FrameType

from orthocas.tools.interrupts import INTERRUPTED


def open_closed_streams() -> None:
    """Let standard streams that are closed (`orthocas info FILE >&-`) lead nowhere.

    Otherwise the next file that is opened gets the number of one, and what libraries print goes into that file.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            place = os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
            os.set_inheritable(place, place == number)
            setattr(sys, name, open(place, "w" if number else "r", encoding="utf-8"))  # noqa: SIM115


def leave_on_ctrl_c() -> None:
    """Let Ctrl-C end the process at once, with one line, until `main` has imported what it needs.

    `orthocas` calls it first in the command line: Python imports all of `orthocas` on its way to `main`. Nothing
    is lost meanwhile, and an exception would come out of half-imported libraries as anything.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def main() -> None:
    """Run the command line."""
    from orthocas.cli import commands  # takes a second

    watched = signal.getsignal(signal.SIGINT) is _leave
    open_closed_streams()
    os.environ["MPLBACKEND"] = "agg"  # pictures go to files; a name that is none would stop matplotlib
    app = commands.app_for(sys.argv[1:])  # which imports the command
    try:
        if watched:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        code = commands.run(app)
        sys.stdout.flush()
    except KeyboardInterrupt:
        code = commands.interrupted()
    finally:
        if watched:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # while Python ends, and runs no handlers any more
    sys.exit(code)


def _leave(number: int, frame: FrameType | None) -> None:
    """End the process without any more Python."""
    os.write(2, b"orthocas: interrupted\n")
    os._exit(INTERRUPTED)
