"""What a user does to an atlas in a view: a session that goes on in the next chart."""

from typing import TYPE_CHECKING

import numpy as np

from orthocas.errors import InvalidValueError
from orthocas.tools.checks import Array, as_point
from orthocas.viewer.session import MOST_STEPS, Session

if TYPE_CHECKING:
    from orthocas.atlas.atlas import Atlas

_MOST_HAND_OVERS = 20  # towards one wish


class AtlasSession(Session):
    """A session in the charts of an atlas.

    A chart is left where its box ends, if the atlas has another chart there. Boxes overlap, so charts do not alternate
    at a boundary. Then the coordinates wished for become those of the joint position in the next chart, and what was
    wished for the task stays. Orientations are compared with that at the first joint position.

    Args:
        atlas: an atlas.
        q: where to begin, (n,); default: the middle of the chart that is nearest to the middle of the joint range.

    Raises:
        InvalidValueError: if the atlas has no chart at q, or none at all.
    """

    beyond = 0.1

    def __init__(self, atlas: "Atlas", q: Array | None = None) -> None:
        home = _middle(atlas) if q is None else as_point("q", q, atlas.problem.n)
        self.atlas, self.number = atlas.with_reference(home), int(atlas.chart_at(home))
        if self.number < 0:
            raise InvalidValueError("q", np.round(home, 3).tolist(), "a position with a chart")
        super().__init__(self.atlas.chart(self.number, near=home), home)

    @property
    def place(self) -> str:
        """The chart of the moment."""
        return f"chart {self.number} of {len(self.atlas)}"

    def follow(self, most_steps: int = MOST_STEPS) -> bool:
        """Move towards the wish, from chart to chart. Returns whether q has moved."""
        x, moved = self._wished[: self.chart.m], False
        for _ in range(_MOST_HAND_OVERS):
            self.stop = ""
            went = super().follow(most_steps)
            moved |= went
            if not (went and self.stop and self._handed_over()):
                break
            self._wished = np.concatenate([x, self._wished[self.chart.m :]])
        return moved

    def _handed_over(self) -> bool:
        """Go on in another chart, if there is one at q."""
        number = int(self.atlas.chart_at(self.q))
        if number in (-1, self.number):
            return False
        self._enter(number, self.q)
        return True

    def _place(self, q: Array) -> None:
        self._enter(int(self.atlas.chart_at(q, self.number)), q)

    def _enter(self, number: int, q: Array) -> None:
        self.number = number
        self._use(self.atlas.chart(number, near=q), q)


def _middle(atlas: "Atlas") -> Array:
    """The middle of the chart that is nearest to the middle of the joint range."""
    if not len(atlas):
        raise InvalidValueError("atlas", "one without charts", "one that is built")
    joints, domain = list(atlas.plan.joints), atlas.problem.domain
    centres, _ = atlas.index.image_centres(np.arange(len(atlas)))
    low, high = ((domain.centre + side * domain.half_width)[joints] for side in (-1, 1))
    away = np.abs((centres - domain.centre[joints]) / domain.half_width[joints]).max(axis=1)
    away[((centres < low) | (centres > high)).any(axis=1)] = np.inf
    q = domain.centre.copy()
    q[joints] = centres[int(np.argmin(away))]
    return np.asarray(q)
