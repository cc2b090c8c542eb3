"""Entry point of the command line: handles signals first, then imports, which take a second."""

import os
import signal
import sys
from types import FrameType

from orthocas.tools.interrupts import INTERRUPTED


def open_closed_streams() -> None:
    """Redirect closed standard streams (`orthocas info FILE >&-`) to the null device.

    Otherwise the next file to be opened would get the number of a standard stream, and output of libraries would go
    there.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            # os.open takes the lowest free number.
            place = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(place, place == number)
            setattr(sys, name, open(place, "w" if number else "r", encoding="utf-8"))  # noqa: SIM115


def leave_on_ctrl_c() -> None:
    """Let Ctrl-C end the process at once with one line, until `main` has finished its imports.

    No results are lost by then. A KeyboardInterrupt inside half-imported libraries could surface as any other error.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def _leave(number: int, frame: FrameType | None) -> None:
    """End the process without running further Python code."""
    os.write(2, b"orthocas: interrupted\n")
    os._exit(INTERRUPTED)


def main() -> None:
    """Import the command that `sys.argv` names, run it, and exit with its code."""
    # This import takes a second.
    from orthocas.cli import commands

    watched = signal.getsignal(signal.SIGINT) is _leave
    open_closed_streams()
    # Pictures go to files. An unknown backend in this variable would stop matplotlib.
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
        # Python runs no handlers while it ends.
        if watched:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(code)
