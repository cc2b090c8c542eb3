"""All campaigns by name: functions of the number of mutants that return what they found."""

from collections.abc import Callable

from fuzz.charts import charts
from fuzz.checkpoints import checkpoints
from fuzz.child import Finding
from fuzz.runs import runs
from fuzz.steps import steps

CAMPAIGNS: dict[str, Callable[[int], list[Finding]]] = {
    "charts": charts,
    "checkpoints": checkpoints,
    "runs": runs,
    "steps": steps,
}
