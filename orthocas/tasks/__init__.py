"""What is asked of a robot: tasks h(q), metrics A(q), domains, and problems that join them.

- `task` has tasks, `metric` metrics, `problem` joins them on a domain, and has them as data of files.
- `domains` has boxes and tori, `clear_box` and `corridor` domains with a condition of their own, `regular_box` the
  box that is taken by default.
- `samples` draws sample sets: the data of the loss that do not depend on the coordinates.
"""

from orthocas.tasks import clear_box, corridor  # registers their kinds of domain

__all__ = ["clear_box", "corridor"]
