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
            # takes the lowest number that is free
            place = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(place, place == number)
            setattr(sys, name, open(place, "w" if number else "r", encoding="utf-8"))  # noqa: SIM115


def leave_on_ctrl_c() -> None:
    """Let Ctrl-C end the process at once, with one line, until `main` has imported what it needs.

    Nothing is lost by that. A KeyboardInterrupt inside half-imported libraries could surface as any other error.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def _leave(number: int, frame: FrameType | None) -> None:
    """End the process without any more Python."""
    os.write(2, b"orthocas: interrupted\n")
    os._exit(INTERRUPTED)


def main() -> None:
    """Import the command that `sys.argv` names, run it, and exit with its code."""
    from orthocas.cli import commands  # takes a second

    watched = signal.getsignal(signal.SIGINT) is _leave
    open_closed_streams()
    # Pictures go to files. Another name that the variable may have would stop matplotlib.
    os.environ["MPLBACKEND"] = "agg"
    app = commands.build_app(sys.argv[1:])
    try:
        if watched:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        code = commands.run(app)
        sys.stdout.flush()
    except KeyboardInterrupt:
        code = commands.report_interrupt()
    finally:
        # While Python ends, it runs no handlers any more.
        if watched:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(code)
