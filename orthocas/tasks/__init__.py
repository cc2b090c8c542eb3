"""Tasks h(q), metrics A(q), domains, and problems that join them for a robot.

- `task` has tasks and `metric` metrics. `problem` joins them on a domain, and converts problems to file data.
- `domains` has boxes and tori, `clear_box` and `corridor` domains with an additional condition, `regular_box` the
  default box.
- `samples` draws sample sets and evaluates the data of the loss that do not depend on the coordinates.
"""

from orthocas.tasks import clear_box, corridor  # registers their kinds of domain

__all__ = ["clear_box", "corridor"]
