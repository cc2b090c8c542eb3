"""Settings by one budget for all: three each, tried on two arms and two scenarios, with a seed of its own."""

import json
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from typing import Any

from redundancy.arms import TUNED_ON, Arm
from redundancy.runner import SCHEMA, SETTINGS, built, case, methods, scenarios

SEED, SCENARIOS = 100, ("jumps", "drift")


def tried(arm_name: str, number: int, only: Sequence[str] = ()) -> list[tuple[str, int, list[float]]]:
    """Of an arm, with the settings of that number: for every method, lines that are lost [%] and drift [rad]."""
    warnings.simplefilter("ignore")
    arm, known, found = Arm(arm_name), scenarios(), []
    for method in methods(only=only):
        if number >= len(method.grid):
            continue
        settings = method.grid[number]
        build = built(method, arm, settings)
        kept = [case(known[name], arm, build, SEED, False) for name in SCENARIOS]
        found.append((method.name, number, [_cost(one) for one in kept]))
    return found


def _cost(kept: dict[str, Any]) -> float:
    served = kept.get("served") and kept["value"] is not None
    return float(kept["value"]) if served else float("inf")


def _best(costs: dict[int, list[list[float]]]) -> int:
    """Fewest lines lost over the arms, then least drift, then the setting of the documentation."""
    sums = {number: [sum(column) for column in zip(*rows, strict=True)] for number, rows in costs.items()}
    return min(sums, key=lambda number: (round(sums[number][0], 6), round(sums[number][1], 3), number))


def main(only: Sequence[str] = ()) -> None:
    """Try, choose, and keep the choice; other methods keep theirs."""
    cases = list(product(TUNED_ON, range(3), [only]))
    with ProcessPoolExecutor(2) as pool:
        found = [one for kept in pool.map(tried, *zip(*cases, strict=True)) for one in kept]
    before = json.loads(SETTINGS.read_text()) if only else {"chosen": {}, "tried": {}}
    chosen, all_costs = before["chosen"], before["tried"]
    for method in methods(only=only):
        costs = {number: [c for name, k, c in found if name == method.name and k == number] for number in range(3)}
        costs = {number: rows for number, rows in costs.items() if rows}
        chosen[method.name] = dict(method.grid[_best(costs)])
        all_costs[method.name] = [{"settings": dict(method.grid[k]), "lost and drift": _plain(costs[k])} for k in costs]
    content = {
        "schema": SCHEMA,
        "seed": SEED,
        "arms": TUNED_ON,
        "scenarios": SCENARIOS,
        "chosen": chosen,
        "tried": all_costs,
    }
    SETTINGS.write_text(json.dumps(content, indent=1) + "\n")


def _plain(rows: list[list[float]]) -> list[list[float | None]]:
    return [[value if value < float("inf") else None for value in row] for row in rows]


if __name__ == "__main__":
    main()
