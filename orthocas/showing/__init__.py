"""How objects are displayed: a few lines of text, and a small table in notebooks."""

from orthocas.showing.facts import Shown, listed, number_list

__all__ = ["Shown", "listed", "number_list"]
