"""Certificates: the record of a proof in a chart file, with the subdivision of the domain that it covers."""

import hashlib
import json
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from orthocas.errors import CertifyError, InvalidValueError
from orthocas.tools.checks import Array, freeze_array, require_kind, require_shape, require_text
from orthocas.tools.display import Shown, number_list, percent
from orthocas.tools.json import collect_attributes

OPEN, PROVED = 255, 254  #: codes of boxes that are not halved; a smaller code is the index of the joint that is halved
MOST_BOXES = 20_000_000  #: largest number of boxes in a subdivision
_DEEPEST = 1000  #: largest number of halves that wait at once while the tree of a file is read
ELIMINATION = "taylor-3/2"  #: J by Taylor models and elimination. The one-to-one part of taylor-3/1 was unsound.
COFACTORS = "cofactors-5/1"  #: for r = 1: det J by expansion along the row of the coordinate
METHODS = (ELIMINATION, COFACTORS)  #: methods of this version; certificates of other methods cannot be checked


@dataclass(frozen=True, eq=False)
class Subdivision:
    """A box and its subdivision into parts by repeated halving: a binary tree.

    Both halves of a box share the face between them exactly, so the parts cover the box without gaps.

    Raises:
        InvalidValueError: if the codes do not form a tree, or the corners are invalid.
    """

    low: Array  #: corner of the box, (n,)
    high: Array  #: opposite corner, (n,)
    codes: Array  #: uint8, one for each box in preorder: the joint that is halved (lower half first), PROVED or OPEN

    def __post_init__(self) -> None:
        low = freeze_array("low", self.low, (None,))
        high = freeze_array("high", self.high, low.shape)
        # one byte for each box
        codes = np.array(self.codes)
        if codes.dtype != np.uint8 or codes.ndim != 1 or not 0 < codes.size <= MOST_BOXES:
            raise InvalidValueError(
                "codes", f"{codes.dtype} of shape {codes.shape}", f"uint8 of shape (k,), 1 <= k <= {MOST_BOXES:,}"
            )
        if not (low < high).all():
            raise InvalidValueError("low", low.tolist(), f"a corner below the opposite one at {high.tolist()}")
        n = len(low)
        require_shape("codes", codes.shape, (None,))
        # codes of halved boxes must be joints
        inner = codes < PROVED
        if (codes[inner] >= n).any():
            raise InvalidValueError(
                "codes", int(codes[inner].max()), f"indices of joints below {n}, {PROVED} or {OPEN}"
            )
        # Number of boxes still to come after each code: a halved box adds two. It must be 0 at the end only.
        missing = 1 + np.cumsum(np.where(inner, 1, -1))
        if missing[-1] != 0 or (missing[:-1] <= 0).any():
            raise InvalidValueError("codes", f"{codes.size} bytes", "a complete tree, with two halves per inner box")
        if missing.max() > _DEEPEST:
            raise InvalidValueError("codes", "a tree that is too deep", f"at most {_DEEPEST} waiting halves at once")
        codes.setflags(write=False)
        for name, value in (("low", low), ("high", high), ("codes", codes)):
            object.__setattr__(self, name, value)

    @classmethod
    def whole(cls, low: Array, high: Array) -> Self:
        """The whole box as a single OPEN part."""
        return cls(low, high, np.array([OPEN], dtype=np.uint8))

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.low)

    @property
    def proved_count(self) -> int:
        """Number of parts that are proved."""
        return int((self.codes == PROVED).sum())

    @property
    def open_count(self) -> int:
        """Number of parts where nothing is proved."""
        return int((self.codes == OPEN).sum())

    @property
    def complete(self) -> bool:
        """Whether every part is proved."""
        return not (self.codes == OPEN).any()

    @property
    def share(self) -> float:
        """Share of the volume that is proved: 1 only if all of it is."""
        if self.complete:
            return 1.0
        depths, waiting = np.zeros(self.codes.size), [0]
        for k, code in enumerate(self.codes.tolist()):
            depths[k] = waiting.pop()
            if code < PROVED:
                waiting += [depths[k] + 1] * 2
        return min(float((0.5 ** depths[self.codes == PROVED]).sum()), 1 - 2**-53)

    def leaves(self, code: int) -> tuple[Array, Array]:
        """Lower and upper corners, (boxes, n) each, of the parts with a given code (PROVED or OPEN), in preorder."""
        # place of the upper half of each halved box in the codes; the lower half comes directly after the box
        upper, waiting = np.zeros(self.codes.size, dtype=np.intp), list[int]()
        for k, number in enumerate(self.codes.tolist()):
            if number < PROVED:
                waiting.append(k)
            elif waiting:
                upper[waiting.pop()] = k + 1
        parts = []
        place, low, high = np.zeros(1, dtype=int), self.low[None], self.high[None]
        # compute the corners, one level of the tree at a time
        while place.size:
            codes = self.codes[place]
            parts.append((place[codes == code], low[codes == code], high[codes == code]))
            inner = codes < PROVED
            place, joint, low, high = place[inner], codes[inner], low[inner], high[inner]
            row = np.arange(len(place))
            top, bottom = high.copy(), low.copy()
            top[row, joint] = bottom[row, joint] = halve_interval(low[row, joint], high[row, joint])
            place = np.concatenate([place + 1, upper[place]])
            low, high = np.concatenate([low, bottom]), np.concatenate([top, high])
        places, lows, highs = (np.concatenate(each) for each in zip(*parts, strict=True))
        order = np.argsort(places)
        return lows[order], highs[order]


def halve_interval(low: Any, high: Any) -> Any:
    """The place where the interval [low, high] is halved. All users of a subdivision must round it in the same way."""
    return (low + high) / 2


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(Shown):
    """The record of a proof about the chart with this fingerprint; see `orthocas.certify`.

    On the proved parts of `regular`, det J has one sign and, if `bound` > 0, the conditioning is at least `bound`. On
    the box `injective`, phi is one-to-one: two different q never have the same phi. In certificates of older methods,
    the proof of `injective` is void, so it is dropped.
    """

    fingerprint: str  #: digest of all that defines the chart
    method: str
    bound: float  #: required lower bound of the conditioning; 0: the proof is about det J != 0 only
    regular: Subdivision  #: the domain and its parts
    conditioning: float  #: proved lower bound of the conditioning on the proved parts; 0 if none was required
    injective: Subdivision | None = None  #: a box on which phi is one-to-one, and its parts
    fold: tuple[tuple[float, ...], ...] = ()  #: two joint positions where det J differs in sign, the second in the fold
    boxes: int = 0  #: number of boxes evaluated to find the proof
    seconds: float = field(default=0.0)
    least_singular_value: float = 0.0  #: bound of a ClearBox; parts proved to lie outside it count as proved; 0: none
    least_volume: float = 0.0  #: bound of a RegularPart, whose run-time check excludes folds; 0: another domain
    clear_share: float = 0.0  #: share of the clear positions of a RegularPart's box in proved parts, from samples
    digest: str = ""  #: digest of all fields above, see `seal`

    def __post_init__(self) -> None:
        for name in ("fingerprint", "method"):
            require_text(name, getattr(self, name))
        require_kind("regular", self.regular, Subdivision)
        if not 0 <= self.bound < 1 or not 0 <= self.conditioning <= 1:
            raise InvalidValueError("bound and conditioning", (self.bound, self.conditioning), "numbers from 0 to 1")
        if self.method not in METHODS:
            object.__setattr__(self, "injective", None)

    def seal(self) -> Self:
        """The same certificate with the digest of its content, which reveals accidental changes. It is no signature."""
        return replace(self, digest=self._compute_digest())

    def remove_given_up(self, count: int) -> Self:
        """Replace the digest of a certificate from an older file, which included a number of given-up parts.

        The new digest leaves this number out, because no check covers it. If the old digest does not match, the
        certificate stays unchanged, and `require_for` refuses it.
        """
        return self.seal() if self.digest == self._compute_digest(count) else self

    def _compute_digest(self, given_up: int = 0) -> str:
        """SHA-256 of all fields except the digest. `given_up` is a number of parts that older certificates include."""
        numbers = [self.bound, self.conditioning, self.boxes, self.seconds, self.least_singular_value, given_up]
        # Certificates of other domains, and older ones, lack these numbers.
        numbers += [self.least_volume, self.clear_share] if self.least_volume else []
        points = [[float(value) for value in point] for point in self.fold]
        content = [self.fingerprint, self.method, [float(number) for number in numbers], points]
        digest = hashlib.sha256(json.dumps(content).encode())
        for tree in (self.regular, self.injective):
            parts = () if tree is None else (tree.low, tree.high, tree.codes)
            digest.update(b"".join(hashlib.sha256(part.tobytes()).digest() for part in parts) or b"none")
        return digest.hexdigest()

    def require_for(self, fingerprint: str) -> None:
        """Raise CertifyError if the certificate belongs to a chart with another fingerprint, or has been changed."""
        if self.digest and self.digest != self._compute_digest():
            raise CertifyError("the certificate is void: it has been changed since `certify` made it")
        if self.fingerprint != fingerprint:
            raise CertifyError("the certificate is void: it was made for another chart, or the chart has changed")

    @property
    def proved(self) -> bool:
        """Whether the proof covers the whole domain."""
        return self.regular.complete and not self.fold

    @property
    def share(self) -> float:
        """Share of the domain's volume on which the proof holds; for a ClearBox, of the volume of its box."""
        return 0.0 if self.fold else self.regular.share

    @property
    def unproved(self) -> tuple[Array, Array]:
        """Lower and upper corners, (boxes, n) each, of the parts where nothing is proved."""
        return self.regular.leaves(OPEN)

    def facts(self) -> dict[str, str]:
        """What is proved and what is not, the number of boxes, and the method."""
        facts = {"certificate": self._describe()}
        # what is proved beyond "no fold"
        if self.conditioning > 0:
            facts["conditioning"] = f"at least {self.conditioning:.3g} there"
        if self.injective is not None:
            half = (self.injective.high - self.injective.low) / 2
            facts["one-to-one"] = f"on the box of half-width {number_list(half)} around the centre"
        elif self.method not in METHODS:
            facts["one-to-one"] = f"void, of an older method ({self.method}): certify the chart again"
        # which part of the box the proof is about
        if self.least_singular_value > 0:
            facts["left out"] = f"where the task's relative singular value is at most {self.least_singular_value:g}"
        if self.least_volume > 0 and not self.proved:
            facts["the rest"] = f"guarded at run time: the domain leaves out volumes up to {self.least_volume:g}"
        # the largest part that is not proved
        low, high = self.unproved
        if len(low) and not self.fold:
            largest = int(np.argmax((high - low).prod(axis=1)))
            facts["largest open"] = f"at q = ({number_list((low[largest] + high[largest]) / 2)})"
        facts["boxes"] = f"{self.regular.proved_count} proved, {self.boxes} judged, {self.seconds:.3g} s"
        facts["method"] = f"{self.method}, chart {self.fingerprint[:12]}"
        return facts

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        one = self.injective
        return {
            **collect_attributes(self, "proved", "share", "bound", "conditioning", "boxes"),
            "parts": self.regular.proved_count,
            "unproved": self.regular.open_count,
            "seconds": self.seconds,
            "one_to_one_half_width": None if one is None else ((one.high - one.low) / 2).tolist(),
            **collect_attributes(self, "fold", *(("least_volume", "clear_share") if self.least_volume else ())),
            **collect_attributes(self, "method", "fingerprint"),
        }

    def _describe(self) -> str:
        """The verdict in one line."""
        if self.fold:
            at = ", ".join(f"{value:.3f}" for value in self.fold[-1])
            return f"refuted, the chart folds at q = ({at})"
        # shares are rounded down
        verdict = "no fold everywhere on the domain"
        if not self.proved:
            share, clear = percent(self.share, 4), percent(self.clear_share, 3)
            guarded = self.least_volume > 0
            where = f"{share} of the box, {clear} of what is clear (samples)" if guarded else f"{share} of the domain"
            verdict = f"not proved, {self.regular.open_count:,} boxes are open; no fold on {where}"
        return f"{verdict}, conditioning >= {self.bound:g}" if self.bound else verdict
