"""The result of a comparison, as a table, CSV and JSON."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from orthocas.fitting.grid import CellResult
from orthocas.tools.display import Shown
from orthocas.tools.files import published
from orthocas.tools.json import plain, to_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Summary:
    """One parametrisation and solver over all seeds: medians, and the relative spread of both angles."""

    parametrisation: str
    solver: str
    seeds: int
    failed: int
    error: str  #: error of the first failed seed
    parameters: int
    seconds: float
    task_std_deg: float
    mutual_std_deg: float
    leak_rms_deg: float  #: in the metric; the two above are the paper's
    conditioning_p01: float
    folded_samples: int
    control_tick_us: float  #: duration of a decoupled PD+ tick as generated C
    task_spread: float  #: (largest - smallest) / median
    mutual_spread: float


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """All fits of a grid."""

    results: tuple[CellResult, ...]
    interrupted: bool = False  #: whether Ctrl-C stopped it before all fits were done

    def summaries(self) -> list[Summary]:
        """One summary per parametrisation and solver, best task angle first, failed ones last."""
        groups: dict[tuple[str, str], list[CellResult]] = {}
        for result in self.results:
            groups.setdefault((result.parametrisation, result.solver), []).append(result)
        summaries = [_summary(results) for results in groups.values()]
        return sorted(summaries, key=lambda s: (math.isnan(s.task_std_deg), s.task_std_deg))

    def write(self, folder: Path, force: bool = False) -> None:
        """Write comparison.csv (one line per fit) and comparison.json (with histories).

        They replace files of these names that orthocas wrote there, and with `force` any others.

        Raises:
            ArchiveError: if there are others, or symbolic links.
        """
        names = [field.name for field in fields(CellResult) if field.name != "history"]
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, names)
        writer.writeheader()
        for result in self.results:
            writer.writerow({name: getattr(result, name) for name in names})
        with published(folder, listed=True, force=force) as drafts:
            (drafts / "comparison.csv").write_text(text.getvalue(), newline="")
            (drafts / "comparison.json").write_text(to_json(self.as_dict(), indent=1))

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON. NaN becomes None."""
        return {
            "summaries": [plain(asdict(summary)) for summary in self.summaries()],
            "fits": [plain(asdict(result)) for result in self.results],
        }

    def facts(self) -> dict[str, str]:
        """The summaries, best task angle first."""
        failed = sum(result.failed for result in self.results)
        ended = ", interrupted" if self.interrupted else ""
        return {
            "comparison": f"{len(self.results)} fits, {failed} failed{ended}",
            **{f"{s.parametrisation}, {s.solver}": _in_words(s) for s in self.summaries()},
        }

    def plot(self) -> "Figure":
        """Errors of all fits over what they cost, as a matplotlib figure; see `orthocas.plotting.front_figure`."""
        from orthocas.fitting.comparison_figures import front_figure  # with matplotlib, which takes long to import

        return front_figure(self)

    def rows(self) -> list[list[str]]:
        """The rows of a readable table, with the header first."""
        head = ["parametrisation", "solver", "parameters", "task std", "mutual std", "leak rms", "cond 1 %", "folded"]
        head += ["seconds", "control tick"]
        return [head, *(_row(summary) for summary in self.summaries())]


def _summary(results: Sequence[CellResult]) -> Summary:
    good = [result for result in results if not result.failed]
    first = (good or results)[0]

    def middle(name: str) -> float:
        values = [float(getattr(result, name)) for result in good]
        return median(values) if values else math.nan

    def spread(name: str) -> float:
        values = [float(getattr(result, name)) for result in good]
        return (max(values) - min(values)) / middle(name) if values and middle(name) else math.nan

    return Summary(
        parametrisation=first.parametrisation,
        solver=first.solver,
        seeds=len(results),
        failed=len(results) - len(good),
        error=next((result.error for result in results if result.failed), ""),
        parameters=first.parameters,
        seconds=middle("seconds"),
        task_std_deg=middle("task_std_deg"),
        mutual_std_deg=middle("mutual_std_deg"),
        leak_rms_deg=middle("leak_rms_deg"),
        conditioning_p01=middle("conditioning_p01"),
        folded_samples=max((result.folded_samples for result in good), default=0),
        control_tick_us=middle("control_tick_us"),
        task_spread=spread("task_std_deg"),
        mutual_spread=spread("mutual_std_deg"),
    )


def _in_words(s: Summary) -> str:
    if s.failed == s.seeds:
        return f"failed: {s.error}"
    angles = f"task std {s.task_std_deg:.3f}, mutual std {s.mutual_std_deg:.3f}, leak rms {s.leak_rms_deg:.3f} deg"
    return f"{angles}, {s.seconds:.2f} s"


def _row(s: Summary) -> list[str]:
    if s.failed == s.seeds:
        return [s.parametrisation, s.solver, f"failed: {s.error}"]
    several = s.seeds - s.failed > 1

    def angle(value: float, spread: float) -> str:
        if math.isnan(value):
            return "-"
        return f"{value:.3f} ±{50 * spread:.1f} %" if several else f"{value:.3f}"

    return [
        s.parametrisation,
        s.solver + (f" ({s.failed} of {s.seeds} failed)" if s.failed else ""),
        str(s.parameters),
        angle(s.task_std_deg, s.task_spread),
        angle(s.mutual_std_deg, s.mutual_spread),
        f"{s.leak_rms_deg:.3f}",
        f"{s.conditioning_p01:.3f}",
        str(s.folded_samples),
        f"{s.seconds:.2f}",
        "-" if math.isnan(s.control_tick_us) else f"{s.control_tick_us:.3g} us",
    ]
