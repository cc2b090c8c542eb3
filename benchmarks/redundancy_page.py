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

ROOT = Path(__file__).resolve().parent.parent
PAGE, RECORD = ROOT / "docs" / "measurements" / "redundancy.md", ROOT / "docs" / "records" / "redundancy.json"
PAPER, FIGURES = ROOT / "docs" / "joss" / "paper.md", ROOT / "docs" / "figures"
GREY, BLUE, RED = "#808080", "#1f77b4", "#d62728"
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


@dataclass(frozen=True)
class Row:
    """What a method did in a scenario, with one seed."""

    method: str
    values: Sequence[float]  #: of the arms that it served
    also: Sequence[float]
    arms: int  #: on which it ran or failed
    why: str  #: there is no number, if there is none

    def middle(self, scenario: Scenario) -> float:
        """Over all arms; those that are not served count as infinite."""
        every = [*self.values, *[np.inf] * (self.arms - len(self.values))]
        return float((np.mean if scenario.percent else np.median)(every)) if every else np.inf

    def key(self, scenario: Scenario) -> tuple[float, int]:
        """Less is better: the number to two digits and not below what matters, then the arms that are not served."""
        value = max(self.middle(scenario), scenario.least)
        return float(f"{value:.1e}"), self.arms - len(self.values)


def rows_of(result: Mapping[str, Any], seed: int, arms: Collection[str] | None = None) -> list[Row]:
    """Of a scenario's file, for all arms or some."""
    found = []
    for method, row in result["methods"].items():
        cases = [case for case in row["cases"] if case["seed"] == seed and (arms is None or case["arm"] in arms)]
        ran = [case for case in cases if "value" in case or case["why"].startswith(("slower", "failed", "the start"))]
        good = [case for case in ran if case.get("served") and case["value"] is not None]
        also = [case["also"] for case in good if case.get("also") is not None]
        whys = sorted({case["why"] for case in cases if "why" in case})
        found.append(Row(method, [case["value"] for case in good], also, len(ran), "; ".join(whys)))
    return found


def ranks(rows: Sequence[Row], scenario: Scenario) -> dict[str, int]:
    """From 1, equal for equal keys. A method that served no arm has none."""
    keys = {row.method: row.key(scenario) for row in rows if row.values}
    return {name: 1 + sum(other < key for other in keys.values()) for name, key in keys.items()}


def number(value: float) -> str:
    """Two digits, and 0 for rounding."""
    if abs(value) < 1e-9:
        return "0"
    return f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e") if value < 1e-3 or value >= 1e4 else f"{value:.3g}"


def table(scenario: Scenario, result: Mapping[str, Any]) -> list[str]:
    """Header and rows in Markdown, best first; below, what did not run."""
    rows, arms = rows_of(result, result["seeds"][0]), common_arms(result)
    own = ranks(rows, scenario)
    repeated = [ranks(rows_of(result, seed, arms), scenario) for seed in result["seeds"]]
    what = "mean of the arms" if scenario.percent else "median of the arms served"
    seeds = f"ranks with seeds {', '.join(map(str, result['seeds']))} on {len(arms)} arms"
    columns = ["method", f"{scenario.number}, {what}", "worst", "arms served", "rank", seeds]
    lines = ["| " + " | ".join([*columns, *([scenario.also] if scenario.also else [])]) + " |"]
    for row in sorted((row for row in rows if row.values), key=lambda row: own[row.method]):
        middle = (np.mean if scenario.percent else np.median)(row.values)
        cells = [row.method, number(float(middle)), number(max(row.values)), f"{len(row.values)} of {row.arms}"]
        cells += [str(own[row.method]), ", ".join(str(found.get(row.method, "-")) for found in repeated)]
        cells += [number(float(np.median(row.also))) if row.also else "-"] if scenario.also else []
        lines.append(f"| {' | '.join(cells)} |")
    for row in rows:
        if not row.values and row.arms:
            cells = [
                row.method,
                row.why or "served no arm",
                "-",
                f"0 of {row.arms}",
                *["-"] * (3 if scenario.also else 2),
            ]
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def overview(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A row for each scenario in Markdown: numbers as in its table, and how many arms were served if not all."""
    lines = ["| " + " | ".join(["number", *OVERVIEW.values()]) + " |"]
    for name, result in found.items():
        scenario = scenarios()[name]
        rows = {row.method: row for row in rows_of(result, result["seeds"][0])}
        numbers = [short(rows[method], scenario) if rows[method].arms else "-" for method in OVERVIEW]
        lines.append(f"| {' | '.join([scenario.number, *numbers])} |")
    return lines


def short(row: Row, scenario: Scenario) -> str:
    """A cell of the overview."""
    value = number(float((np.mean if scenario.percent else np.median)(row.values))) if row.values else "none"
    return value if len(row.values) == row.arms else f"{value} ({len(row.values)}/{row.arms})"


def common_arms(result: Mapping[str, Any]) -> set[str]:
    """The arms that ran with every seed."""
    cases = [case for row in result["methods"].values() for case in row["cases"]]
    ran = [{case["arm"] for case in cases if case["seed"] == seed} for seed in result["seeds"]]
    return set.intersection(*ran)


def not_run(result: Mapping[str, Any]) -> str:
    """The methods without a number, and why."""
    rows = [row for row in rows_of(result, result["seeds"][0]) if not row.arms]
    reasons: dict[str, list[str]] = {}
    for row in rows:
        reasons.setdefault(row.why, []).append(row.method)
    return "Not run: " + ", ".join(f"{' and '.join(names)} ({why})" for why, names in reasons.items()) + "."


def picture(scenario: Scenario, result: Mapping[str, Any]) -> Figure:
    """A dot for each arm and a line for the median; crosses at the right for arms that were not served."""
    rows = [row for row in rows_of(result, result["seeds"][0]) if row.arms]
    own = ranks(rows, scenario)
    rows.sort(key=lambda row: own.get(row.method, 99))
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
            colour = BLUE if row.method.startswith(("chart", "SEW")) else GREY
            values = [value if scenario.percent else max(value, floor) for value in row.values]
            axes.plot(values, [k] * len(values), "o", color=colour, markersize=4, alpha=0.6)
            if values:
                middle = (np.mean if scenario.percent else np.median)(values)
                axes.plot([middle], [k], "|", color=colour, markersize=12, markeredgewidth=2)
            lost = row.arms - len(row.values)
            if lost:
                axes.text(1.01, k, "x" * lost, color=RED, transform=axes.get_yaxis_transform(), va="center")
        axes.set_yticks(range(len(rows)), [row.method for row in rows])
        axes.invert_yaxis()
        axes.tick_params(colors=GREY)
        axes.grid(axis="x", color=GREY, alpha=0.25)
        axes.set_xlabel(scenario.number + "; x: an arm not served")
    return figure


def changes(found: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Pairs of methods that change places between the seeds, by scenario."""
    pairs = []
    for name, result in found.items():
        scenario, seeds, arms = scenarios()[name], result["seeds"], common_arms(result)
        one, other = (ranks(rows_of(result, seed, arms), scenario) for seed in (seeds[0], seeds[-1]))
        both = sorted(set(one) & set(other))
        pairs += [(name, a, b) for a in both for b in both if one[a] < one[b] and other[a] > other[b]]
    return pairs


def main() -> None:
    """Renew tables, pictures, the record, and the table of the paper."""
    page, known = PAGE.read_text(), scenarios()
    found = {
        name: json.loads((RESULTS / f"{name}.json").read_text())
        for name in known
        if (RESULTS / f"{name}.json").exists()
    }
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
