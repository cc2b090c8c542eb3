"""Tables and pictures of the redundancy benchmark, from `benchmarks/redundancy/results`, for the page.

Writes docs/records/redundancy.json and docs/figures/redundancy_SCENARIO.png, and puts every table between the comments
`<!-- NAME -->` and `<!-- end -->` of the page, and an overview of them all into the paper in docs/joss.
"""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from redundancy.protocol import Scenario
from redundancy.runner import RESULTS, scenarios
from scipy.special import bdtr

ROOT = Path(__file__).resolve().parent.parent
PAGE, RECORD = ROOT / "docs" / "measurements" / "redundancy.md", ROOT / "docs" / "records" / "redundancy.json"
PAPER, FIGURES = ROOT / "docs" / "joss" / "paper.md", ROOT / "docs" / "figures"
GREY, BLUE, RED = "#808080", "#1f77b4", "#d62728"
CHANCE = 0.05  #: of a fair coin to decide between two methods as often for one
WIDTH, HEIGHT, BESIDE = 7.2, 0.24, 0.1  # of a picture, of a row in it [in]; of the space for failures

OVERVIEW = {  # methods in the paper's table, and their names there
    "chart, tight": "tight chart",
    "chart, wide": "wide chart",
    "pink, posture 1e-3": "pink, small posture cost",
    "pink, posture 0": "pink, no posture",
    "operational space": "projector",
    "SEW angle": "SEW angle",
    "ssik": "ssik",
}
HELD_OUT = {  # methods that ran on the arms that are held out, and their names in that table
    "arm": "whole arm",
    "chart, wide": "wide chart",
    "pink, posture 1e-3": "pink",
    "mink, posture 1e-3": "mink",
    "placo, posture 1e-6": "placo",
}


@dataclass(frozen=True)
class Row:
    """What a method did in a scenario."""

    method: str
    cases: Mapping[
        tuple[str, int], float
    ]  #: by arm and seed, of those on which it ran; infinite where it did not serve
    also: Sequence[float]  #: the second number, where it served
    ticks: Sequence[float]  #: CPU times of a tick [us], of those on which it ran
    why: str  #: there is no number, if there is none

    @property
    def values(self) -> list[float]:
        """Where it served."""
        return [value for value in self.cases.values() if np.isfinite(value)]

    def ahead_of(self, other: "Row", scenario: Scenario) -> bool:
        """Whether it did better more often than a fair coin may (sign test over arms and seeds, without ties)."""
        both = self.cases.keys() & other.cases.keys()
        pairs = [(_felt(self.cases[case], scenario), _felt(other.cases[case], scenario)) for case in both]
        better, worse = sum(a < b for a, b in pairs), sum(a > b for a, b in pairs)
        return better > worse and bool(2 * bdtr(worse, better + worse, 0.5) < CHANCE)


def _felt(value: float, scenario: Scenario) -> float:
    """A number as it matters to a user: two digits, and not below what is as good as zero."""
    return float(f"{max(value, scenario.least):.1e}")


def rows_of(result: Mapping[str, Any], seeds: Collection[int]) -> list[Row]:
    """Of a scenario's file, with some seeds."""
    found = []
    for method, row in result["methods"].items():
        cases = [case for case in row["cases"] if case["seed"] in seeds]
        ran = [case for case in cases if "value" in case or case["why"].startswith(("slower", "failed", "the start"))]
        values = {(case["arm"], case["seed"]): _value(case) for case in ran}
        also = [case["also"] for case in ran if np.isfinite(_value(case)) and case.get("also") is not None]
        whys = sorted({case["why"] for case in cases if "why" in case})
        ticks = [case["us per tick"] for case in ran if "us per tick" in case]
        found.append(Row(method, values, also, ticks, "; ".join(whys)))
    return found


def _value(case: Mapping[str, Any]) -> float:
    return float(case["value"]) if case.get("served") and case["value"] is not None else np.inf


def ranks(rows: Sequence[Row], scenario: Scenario) -> dict[str, int]:
    """One and the number of methods that are ahead. A method that served no arm has none."""
    ran = [row for row in rows if row.values]
    return {row.method: 1 + sum(other.ahead_of(row, scenario) for other in ran) for row in ran}


def number(value: float) -> str:
    """Two digits, and 0 for rounding."""
    if abs(value) < 1e-9:
        return "0"
    return f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e") if value < 1e-3 or value >= 1e4 else f"{value:.3g}"


def table(scenario: Scenario, result: Mapping[str, Any]) -> list[str]:
    """Header and rows in Markdown, best first; below, what served nobody."""
    seeds = result["seeds"]
    rows = rows_of(result, seeds)
    own, repeated = ranks(rows, scenario), [ranks(rows_of(result, [seed]), scenario) for seed in seeds]
    what = "mean" if scenario.percent else "median"
    columns = ["method", f"{scenario.number}, {what} where served", "worst", "served", "rank"]
    columns += [
        f"rank with seed {', '.join(map(str, seeds))} only",
        "tick [us]",
        *([scenario.also] if scenario.also else []),
    ]
    lines = [f"| {' | '.join(columns)} |"]
    for row in sorted((row for row in rows if row.values), key=lambda row: (own[row.method], _middle(row, scenario))):
        cells = [row.method, number(_middle(row, scenario)), number(max(row.values))]
        cells += [f"{len(row.values)} of {len(row.cases)}", str(own[row.method])]
        cells += [", ".join(str(found.get(row.method, "-")) for found in repeated)]
        cells += [f"{np.median(row.ticks):.0f}"]
        cells += [number(float(np.median(row.also))) if row.also else "-"] if scenario.also else []
        lines.append(f"| {' | '.join(cells)} |")
    for row in rows:
        if row.cases and not row.values:
            cells = [row.method, row.why or "served no arm", "-", f"0 of {len(row.cases)}", "-", "-", "-"]
            lines.append(f"| {' | '.join([*cells, *(['-'] if scenario.also else [])])} |")
    return lines


def _middle(row: Row, scenario: Scenario) -> float:
    """Of what it served."""
    return float((np.mean if scenario.percent else np.median)(row.values))


def overview(found: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str] = OVERVIEW) -> list[str]:
    """A row for each scenario in Markdown: numbers as in its table, and how many cases were served if not all."""
    lines = ["| " + " | ".join(["number", *columns.values()]) + " |"]
    for name, result in found.items():
        scenario = scenarios()[name]
        rows = {row.method: row for row in rows_of(result, result["seeds"])}
        numbers = [short(rows[method], scenario) if rows[method].cases else "-" for method in columns]
        lines.append(f"| {' | '.join([scenario.number, *numbers])} |")
    return lines


def short(row: Row, scenario: Scenario) -> str:
    """A cell of the overview."""
    value = number(_middle(row, scenario)) if row.values else "none"
    return value if len(row.values) == len(row.cases) else f"{value} ({len(row.values)}/{len(row.cases)})"


def not_run(result: Mapping[str, Any]) -> str:
    """The methods without a number, and why."""
    reasons: dict[str, list[str]] = {}
    for row in rows_of(result, result["seeds"]):
        if not row.cases:
            reasons.setdefault(row.why, []).append(row.method)
    told = ", ".join(f"{' and '.join(names)} ({why})" for why, names in reasons.items())
    return f"Not run: {told}." if told else "All methods ran."


def picture(scenario: Scenario, result: Mapping[str, Any]) -> Figure:
    """A dot for each arm and seed, a line for the median, and at the right how many were not served."""
    rows = [row for row in rows_of(result, result["seeds"]) if row.cases]
    own = ranks(rows, scenario)
    rows.sort(key=lambda row: (own.get(row.method, 99), _middle(row, scenario) if row.values else np.inf))
    with mpl.rc_context({"font.size": 8, "text.color": GREY, "axes.labelcolor": GREY, "axes.edgecolor": GREY}):
        figure = Figure(figsize=(WIDTH, 0.9 + HEIGHT * len(rows)), layout="constrained")
        axes = figure.subplots()
        floor = scenario.least / 10 if scenario.least else 1e-12
        every = [max(value, floor) for row in rows for value in row.values]
        if scenario.percent:
            axes.set_xlim(-4, 104)
        else:
            axes.set_xscale("log")
            low, high = min(every, default=1), max(every, default=1)
            axes.set_xlim(low / 1.6, (high / low) ** 1.12 * low * 1.6)
        for k, row in enumerate(rows):
            colour = BLUE if row.method.startswith(("arm", "chart", "SEW")) else GREY
            values = [value if scenario.percent else max(value, floor) for value in row.values]
            axes.plot(values, [k] * len(values), "o", color=colour, markersize=4, alpha=0.6)
            if values:
                axes.plot(
                    [max(_middle(row, scenario), floor)], [k], "|", color=colour, markersize=12, markeredgewidth=2
                )
            lost = len(row.cases) - len(row.values)
            if lost:
                axes.text(1.01, k, f"{lost} x", color=RED, transform=axes.get_yaxis_transform(), va="center")
        axes.set_yticks(range(len(rows)), [row.method for row in rows])
        axes.invert_yaxis()
        axes.tick_params(colors=GREY)
        axes.grid(axis="x", color=GREY, alpha=0.25)
        axes.set_xlabel(scenario.number + "; x: not served")
    return figure


def changes(found: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Pairs of methods of which each is ahead with one of the seeds, by scenario."""
    pairs = []
    for name, result in found.items():
        one, other = ({row.method: row for row in rows_of(result, [seed])} for seed in result["seeds"])
        ahead = {(a, b) for a in one for b in one if one[a].ahead_of(one[b], scenarios()[name])}
        pairs += [(name, a, b) for a, b in sorted(ahead) if other[b].ahead_of(other[a], scenarios()[name])]
    return pairs


def main() -> None:
    """Renew tables, pictures, the record, and the table of the paper."""
    page, known = PAGE.read_text(), scenarios()
    found, apart = (
        {
            name: json.loads((folder / f"{name}.json").read_text())
            for name in known
            if (folder / f"{name}.json").exists()
        }
        for folder in (RESULTS, RESULTS / "held_out")
    )
    record = json.loads(RECORD.read_text()) if RECORD.exists() else {"printed": []}
    record |= {"source": "measured", "command": "python benchmarks/redundancy_benchmark.py", "tables": []}
    record["results"] = str(RESULTS.relative_to(ROOT))
    for name, result in found.items():
        lines = table(known[name], result)
        record["tables"].append(lines)
        text = "\n".join([lines[0], "| --- " * lines[0].count(" | ") + "| --- |", *lines[1:], "", not_run(result)])
        page = re.sub(
            rf"(<!-- {name} -->\n).*?(<!-- end -->)", lambda m, text=text: f"{m[1]}\n{text}\n\n{m[2]}", page, flags=re.S
        )
        picture(known[name], result).savefig(FIGURES / f"redundancy_{name}.png", dpi=110, transparent=True)
    # Arms that are held out, in one table.
    lines = overview(apart, HELD_OUT)
    record["tables"].append(lines)
    text = "\n".join([lines[0], "| --- " * lines[0].count(" | ") + "| --- |", *lines[1:]])
    page = re.sub(
        r"(<!-- held out -->\n).*?(<!-- end -->)", lambda m, text=text: f"{m[1]}\n{text}\n\n{m[2]}", page, flags=re.S
    )
    lines = overview(found)
    record["tables"].append(lines)
    rule = "| :" + "- | :".join(["-" * 34, *["-" * 10] * len(OVERVIEW)]) + "- |"  # pandoc takes widths from it
    text = "\n".join([lines[0], rule, *lines[1:]])
    paper = re.sub(
        r"(<!-- overview -->\n).*?(<!-- end -->)", lambda m: f"{m[1]}\n{text}\n\n{m[2]}", PAPER.read_text(), flags=re.S
    )
    PAPER.write_text(paper)
    PAGE.write_text(page)
    RECORD.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n")
    swapped = changes(found)
    print(f"{len(swapped)} pairs change places with the seed")
    for name, a, b in swapped:
        print(f"  {name}: {a}, {b}")


if __name__ == "__main__":
    main()
