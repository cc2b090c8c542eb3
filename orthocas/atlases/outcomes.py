"""What becomes of a cell of an atlas."""

from dataclasses import dataclass
from enum import IntEnum

from orthocas.atlases.cells import Cell
from orthocas.checks import Array


class Outcome(IntEnum):
    """What became of a cell."""

    CHART = 0  #: it has a chart of the quality asked for
    SPLIT = 1  #: its halves are cells of their own
    SINGULAR = 2  #: all or most of it is too near to singular positions
    POOR = 3  #: no chart of the quality asked for, and no split is left
    FAILED = 4  #: its workers died, or the fit raised an error


@dataclass(frozen=True, eq=False)
class Result:
    """The outcome for one cell."""

    cell: Cell
    outcome: Outcome
    joint: int = -1  #: which of the joints that boxes divide is split
    numbers: Array | None = None  #: of the chart, (fitted, 1 + K), see `BoxChart`
    leak_deg: float = float("nan")
    conditioning: float = float("nan")
    clear: float = 1.0  #: share of the samples that are clear of singular positions
    certified: bool = False
    seconds: float = 0.0
