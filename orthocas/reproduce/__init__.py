"""Reproductions of the figures of [AS2023], with numbers that are printed and tested."""

from orthocas.reproduce.chosen_fit import ChosenFit
from orthocas.reproduce.drawing import Drawing, save
from orthocas.reproduce.registry import FIGURES, Recipe, reproduce
from orthocas.reproduce.scene import Scene

__all__ = ["FIGURES", "ChosenFit", "Drawing", "Recipe", "Scene", "reproduce", "save"]
