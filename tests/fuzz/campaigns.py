"""All campaigns by name: functions of the number of mutants that return what they found."""

from collections.abc import Callable

from fuzz import signals
from fuzz.child import Finding

CAMPAIGNS: dict[str, Callable[[int], list[Finding]]] = {
    "signals": signals.campaign,
}
