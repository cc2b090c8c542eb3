"""Growing of exact coordinates: flows along the task gradients, charts of the base leaf, and their combination."""

from orthocas.growing.flow import Arrival, Moved, TaskFlow
from orthocas.growing.grown import GrownCoordinates
from orthocas.growing.leaf import LeafChart
from orthocas.growing.leaves import leaf_from_arrays
from orthocas.growing.sundials import SundialsFlow

__all__ = ["Arrival", "GrownCoordinates", "LeafChart", "Moved", "SundialsFlow", "TaskFlow", "leaf_from_arrays"]
