"""Reproductions of the figures of [AS2023], with numbers that are printed and tested."""

from .chosen_fit import ChosenFit
from .drawing import Drawing, save
from .registry import FIGURES, Recipe, reproduce
from .scene import Scene

__all__ = ["FIGURES", "ChosenFit", "Drawing", "Recipe", "Scene", "reproduce", "save"]
