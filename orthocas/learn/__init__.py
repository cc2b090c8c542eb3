"""Coordinates (x, xi) in robot learning: actions of Gymnasium environments, and episodes of recorded joints."""

from orthocas.learn.actions import PhiActions, coordinates_of, joints_of

__all__ = ["PhiActions", "coordinates_of", "joints_of"]
