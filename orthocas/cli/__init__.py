"""The command line: one module per command."""

from orthocas.cli.main import main

__all__ = ["main"]
