"""The command line: one module per command."""

from orthocas.cli.entry import main

__all__ = ["main"]
