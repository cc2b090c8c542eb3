"""The command line. `main` is the command `orthocas`, and what `python -m orthocas` runs."""

import os

__all__ = ["main"]


def main() -> None:
    """Run the command line. Ctrl-C at any moment ends it with one line and the exit code 130."""
    try:
        _run()
    except KeyboardInterrupt:
        os.write(2, b"orthocas: interrupted\n")
        os._exit(130)


def _run() -> None:
    # Importing this takes milliseconds, in which Ctrl-C may come.
    from orthocas.cli import entry

    entry.open_closed_streams()
    entry.leave_on_ctrl_c()
    entry.main()
