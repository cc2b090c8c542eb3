"""All campaigns by name: functions of the number of mutants that return what they found."""

from collections.abc import Callable

from fuzz.calls import calls
from fuzz.child import Finding
from fuzz.commands import commands
from fuzz.robots import robots

CAMPAIGNS: dict[str, Callable[[int], list[Finding]]] = {
    "calls": calls,
    "commands": commands,
    "robots": robots,
}
