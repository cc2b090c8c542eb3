"""The campaigns by name."""

from collections.abc import Callable

from fuzz import signals
from fuzz.atlases import atlases
from fuzz.calls import calls
from fuzz.certificates import certificates
from fuzz.charts import charts
from fuzz.checkpoints import checkpoints
from fuzz.child import Finding
from fuzz.commands import commands
from fuzz.libraries import libraries
from fuzz.messages import messages
from fuzz.motions import motions
from fuzz.paths import logs, paths
from fuzz.robots import robots
from fuzz.runs import runs
from fuzz.steps import steps
from fuzz.views import views

CAMPAIGNS: dict[str, Callable[[int], list[Finding]]] = {
    "atlases": atlases,
    "calls": calls,
    "certificates": certificates,
    "charts": charts,
    "checkpoints": checkpoints,
    "commands": commands,
    "libraries": libraries,
    "logs": logs,
    "messages": messages,
    "motions": motions,
    "paths": paths,
    "robots": robots,
    "runs": runs,
    "signals": signals.campaign,
    "steps": steps,
    "views": views,
}
