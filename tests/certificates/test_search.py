"""The search of a proof: which joint is halved where nothing is known, and what it says when it gives up."""

from dataclasses import dataclass

import numpy as np

import orthocas as oc
from orthocas.certificates.box_checks import UNKNOWN, BoxResults
from orthocas.certificates.search import Limits, Search
from orthocas.charts.certificate import Subdivision


@dataclass(frozen=True)
class SmallBoxes:
    """Proves boxes whose joints are narrow, and knows nothing of the others."""

    joints: tuple[int, ...]
    narrow: float
    choice: int = UNKNOWN

    def __call__(self, low: np.ndarray, high: np.ndarray) -> BoxResults:
        proved = ((high - low)[:, list(self.joints)] <= self.narrow).all(axis=1)
        nothing = np.zeros(len(low))
        return BoxResults(proved, proved, nothing, nothing, np.full(len(low), self.choice))


def searched(judge: SmallBoxes, **limits: float) -> Search:
    base = Subdivision.whole(np.zeros(3), np.array([1.0, 8.0, 1.0]))
    search = Search(judge, base, Limits(**limits))
    search.run(lambda _: None)
    return search


def test_joints_are_halved_in_turn_where_bounds_are_infinite() -> None:
    """A choice that stays the same would halve the first joint for ever."""
    search = searched(SmallBoxes((0, 1), 0.5))
    assert search.finished
    assert search.build_subdivision().proved_count == 16 * 16  # both down to a 16th; joint 3 is never halved


def test_boxes_too_small_to_halve_stay_open() -> None:
    search = searched(SmallBoxes((0, 1), 0.5, choice=0), smallest=2.0**-3)
    assert not search.finished
    assert (
        search.build_subdivision().open_count == search.open_count == 8
    )  # joint 1 was halved three times, then no more


def test_search_that_is_too_slow_ends_early() -> None:
    search = searched(SmallBoxes((0, 1, 2), 0.01), boxes=10_000, hopeless=600)
    assert 600 < search.evaluated < 3000


def test_a_search_that_gives_up_proves_nothing_and_says_so_first() -> None:
    """The slope of x(q1) falls to 0 at one position and rises again: det J touches 0 without a change of its sign."""
    arm = oc.Robot.planar(lengths=[1.0, 1.0], masses=[1.0, 1.0])
    touching = oc.Task.custom(arm, "touching", lambda q: (q[0] - 0.1) ** 3)
    domain = oc.Box([0.3, 0.5], [0.4, 0.4])
    flat = oc.fit(oc.Problem(arm, touching, domain=domain), oc.Given.from_function("other", 2, lambda q: q[1])).chart
    certificate = oc.certify(flat, time_limit=100)
    assert not certificate.proved
    assert not certificate.fold
    open_boxes = certificate.regular.open_count
    assert open_boxes > 0
    assert certificate.heading.startswith(f"not proved, {open_boxes:,} boxes are open; no fold on 99.")
    assert certificate.as_dict()["unproved"] == open_boxes
