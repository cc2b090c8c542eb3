"""Parts of atlases: the charts along a path, for controllers that carry only these (ours)."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from orthocas.atlases.atlas import Atlas
from orthocas.atlases.evaluation import Evaluation
from orthocas.atlases.index import Index
from orthocas.atlases.plan import Plan
from orthocas.checks import Indices, as_number, as_point_set, frozen_indices, require_kind
from orthocas.errors import InvalidValueError
from orthocas.showing import Shown


@dataclass(frozen=True, eq=False, repr=False)
class AtlasPart(Shown):
    """Some charts of an atlas, for `orthocas.generate_c`.

    A part consists of tiles and of fitted charts: with the charts that were asked for come the images of these charts
    in the same tiles, which cost next to nothing.

    Args:
        atlas: the atlas.
        charts: numbers of charts in the atlas.

    Raises:
        InvalidValueError: if there are none, or one is no chart of the atlas.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> path = [[0.6, 0.8, 0.8], [0.7, 0.8, 0.8]]
        >>> with TemporaryDirectory() as folder:
        ...     atlas = oc.build_atlas(
        ...         problems.get("planar_3r_xy"), Path(folder) / "arm.orthocas-atlas", region=path, radius=0.2, jobs=1
        ...     )
        ...     part = oc.AtlasPart.along(atlas, path, radius=0.1)
        >>> bool((part.charts >= 0).all())
        True
    """

    atlas: Atlas
    charts: Indices  #: numbers in the atlas, ascending; in C they count from 0 on, in this order

    def __post_init__(self) -> None:
        require_kind("atlas", self.atlas, Atlas)
        given = np.unique(frozen_indices("charts", self.charts, (None,), len(self.atlas)))
        if not given.size:
            raise InvalidValueError("charts", "none", "at least one chart of the atlas")
        object.__setattr__(self, "charts", _with_images(self.index, given))

    def __len__(self) -> int:
        """Number of charts, images included."""
        return len(self.charts)

    @classmethod
    def whole(cls, atlas: Atlas) -> Self:
        """All charts of an atlas."""
        require_kind("atlas", atlas, Atlas)
        return cls(atlas, np.arange(len(atlas)))

    @classmethod
    def along(cls, atlas: Atlas, q: ArrayLike, radius: float = 0.0) -> Self:
        """The charts that joint positions run through.

        Args:
            atlas: the atlas.
            q: joint positions (N, n) [rad] or [m], in steps that are small against the boxes.
            radius: how far single joints may leave the positions [rad] or [m]; charts found there are taken as well.

        Raises:
            InvalidValueError: if the atlas has no chart at one of the positions.
        """
        require_kind("atlas", atlas, Atlas)
        points = as_point_set("q", q, atlas.problem.n)[0]
        reach = as_number("radius", radius)
        if not 0 <= reach < np.pi:
            raise InvalidValueError("radius", radius, "a number from 0 to below pi")
        found = atlas.chart_at(points)
        if (found < 0).any():
            row = int(np.argmin(found))
            raise InvalidValueError(f"q[{row}]", np.round(points[row], 3).tolist(), "a position with a chart")
        steps = reach * np.eye(atlas.problem.n) if reach else np.zeros((0, atlas.problem.n))
        around = [atlas.chart_at(points + side * step) for step in steps for side in (-1, 1)]
        charts = np.unique(np.concatenate([found, *around]))
        return cls(atlas, charts[charts >= 0])

    def facts(self) -> dict[str, str]:
        """Charts and the atlas."""
        fitted = len(np.unique(self.index.rows(self.charts)[1]))
        return {"part": f"{len(self)} charts, {fitted} of them fitted", **self.atlas.facts()}

    @property
    def plan(self) -> Plan:
        """The plan of the atlas."""
        return self.atlas._stock.plan

    @property
    def index(self) -> Index:
        """The search of the atlas."""
        return self.atlas._index

    @property
    def evaluation(self) -> Evaluation:
        """The numbers of the atlas."""
        return self.atlas._evaluation

    def certified(self, fitted: Indices) -> int:
        """How many of some fitted charts are proved not to fold."""
        stock = self.atlas._stock
        return int((stock.records["certified"][stock.charts[fitted]] > 0).sum())

    def clear_shares(self, fitted: Indices) -> Any:
        """Shares of the samples of fitted charts that are clear of singular positions, (fitted,)."""
        stock = self.atlas._stock
        return stock.records["clear"][stock.charts[fitted]]


def _with_images(index: Index, charts: Indices) -> Indices:
    """All charts of the same tiles that share their numbers with one of the given."""
    tiles, fitted = index.rows(charts)
    every = np.arange(index.count)
    all_tiles, all_fitted = index.rows(every)
    return np.asarray(every[np.isin(all_tiles, tiles) & np.isin(all_fitted, fitted)])
