"""The inverse map q(x, xi) of charts.

- `newton` solves phi(q) = phi for many rows at once, near given starts; `own_inverse` does it for grown coordinates.
- `point` solves few rows one by one, and has the functions of trackers.
- `starts` finds starts: a rough inverse, and a table of points of the domain.
- `nearest` finds the nearest coordinates inside the domain where there is no solution inside.
- `tracker` follows a stream of phi.
- `implicit` makes a CasADi function with derivatives of it.
- `inverse` restarts where needed and tells how each row ended; `solutions` holds the result.
"""

from orthocas.inverting.implicit import inverse_function
from orthocas.inverting.inverse import Inverse
from orthocas.inverting.nearest import Nearest
from orthocas.inverting.newton import Attempt, LocalSolver, Newton, PhiMap
from orthocas.inverting.own_inverse import OwnInverse
from orthocas.inverting.point import FewRows, PointFunctions
from orthocas.inverting.solutions import InverseStatus, Solutions
from orthocas.inverting.tracker import Tracker, TrackerStatus

__all__ = [
    "Attempt",
    "FewRows",
    "Inverse",
    "InverseStatus",
    "LocalSolver",
    "Nearest",
    "Newton",
    "OwnInverse",
    "PhiMap",
    "PointFunctions",
    "Solutions",
    "Tracker",
    "TrackerStatus",
    "inverse_function",
]
