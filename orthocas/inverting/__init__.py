"""The inverse map q(x, xi) of charts.

- `newton` solves phi(q) = phi for many rows at once, near given starts; `own_inverse` does it for grown coordinates.
- `point` solves few rows one by one, and has the functions of trackers.
- `starts` finds starts: a rough inverse, and a table of points of the domain.
- `phi_map` has phi and J with the scale of errors, `boxed` the same in a box; `solve_in_box` solves equations there.
- `in_domain` searches all of the domain, in `cells` that may hold a solution. `arm_length` tells what is out of reach.
- `inside` finds points inside the domain where there is no solution inside: any with the same task values, and by
  `nearest_xi` that with the nearest coordinates, with the quadratic programs of `box_programs`; `nearest` is Ipopt's
  way.
- `tracker` follows a stream of phi.
- `implicit` makes a CasADi function with derivatives of it.
- `methods` has the methods of charts.
- `inverse` restarts where needed and tells how each row ended; `solutions` holds the result.
"""

from orthocas.inverting.methods import InverseMethods
from orthocas.inverting.newton import Attempt, Newton
from orthocas.inverting.solutions import InverseStatus, Solutions
from orthocas.inverting.tracker import Tracker, TrackerStatus

__all__ = ["Attempt", "InverseMethods", "InverseStatus", "Newton", "Solutions", "Tracker", "TrackerStatus"]
