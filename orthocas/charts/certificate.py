"""What a proof leaves behind in a chart file: the certificate, and the subdivision of the domain."""

import hashlib
import json
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from orthocas.errors import CertifyError, InvalidValueError
from orthocas.tools.checks import Array, freeze_array, require_kind, require_shape, require_text
from orthocas.tools.display import Shown, number_list, percent
from orthocas.tools.json import collect_attributes

OPEN, PROVED = 255, 254  #: codes of boxes that are not halved; others are the joint that is
MOST_BOXES = 20_000_000  #: of a subdivision
_DEEPEST = 1000  #: open halves at once, of a tree in a file
ELIMINATION = "taylor-3/2"  #: J by Taylor models and elimination. The one-to-one part of taylor-3/1 was unsound.
COFACTORS = "cofactors-5/1"  #: det J of charts with one coordinate, by its expansion along the row of that coordinate
METHODS = (ELIMINATION, COFACTORS)  #: of this version; certificates of other methods cannot be checked


@dataclass(frozen=True, eq=False)
class Subdivision:
    """A box and its parts. Halves share the face between them exactly, so the parts cover the box.

    Raises:
        InvalidValueError: if the codes are no tree.
    """

    low: Array  #: corner of the box, (n,)
    high: Array  #: opposite corner, (n,)
    codes: Array  #: uint8, in preorder: the joint whose interval is halved (lower half first), PROVED or OPEN

    def __post_init__(self) -> None:
        low = freeze_array("low", self.low, (None,))
        high = freeze_array("high", self.high, low.shape)
        # one byte for each box: the joint that is halved, or how it ended
        codes = np.array(self.codes)
        if codes.dtype != np.uint8 or codes.ndim != 1 or not 0 < codes.size <= MOST_BOXES:
            raise InvalidValueError("codes", f"{codes.dtype} of shape {codes.shape}", "bytes of a tree of boxes")
        if not (low < high).all():
            raise InvalidValueError("low", low.tolist(), "a corner below the opposite one")
        n = len(low)
        require_shape("codes", codes.shape, (None,))
        # boxes that are halved name one of the joints
        inner = codes < PROVED
        if (codes[inner] >= n).any():
            raise InvalidValueError(
                "codes", int(codes[inner].max()), f"numbers of joints below {n}, {PROVED} or {OPEN}"
            )
        # in the order of the codes, each halved box brings two: the tree ends with the last code, not before
        missing = 1 + np.cumsum(np.where(inner, 1, -1))
        if missing[-1] != 0 or (missing[:-1] <= 0).any():
            raise InvalidValueError("codes", f"{codes.size} bytes", "a tree of boxes")
        if missing.max() > _DEEPEST:
            raise InvalidValueError("codes", "a tree that is too deep", f"at most {_DEEPEST} open halves at once")
        codes.setflags(write=False)
        for name, value in (("low", low), ("high", high), ("codes", codes)):
            object.__setattr__(self, name, value)

    @classmethod
    def whole(cls, low: Array, high: Array) -> Self:
        """The box in one part, not proved."""
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
        """Whether all parts are proved."""
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
        """Corners (boxes, n) of the parts with a code, in preorder."""
        # where the upper half of each part that is halved stands; the lower half follows it
        upper, waiting = np.zeros(self.codes.size, dtype=np.intp), list[int]()
        for k, number in enumerate(self.codes.tolist()):
            if number < PROVED:
                waiting.append(k)
            elif waiting:
                upper[waiting.pop()] = k + 1
        parts = []
        place, low, high = np.zeros(1, dtype=int), self.low[None], self.high[None]
        # One level of the tree at a time.
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
    """The numbers between two corners where boxes are halved."""
    return (low + high) / 2


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(Shown):
    """A proof about the chart with this fingerprint; see `orthocas.certify`.

    The parts of `regular` that are proved cover a share of the domain on which det J has one sign and, if `bound` is
    above 0, the conditioning is at least `bound`. On the box `injective`, two different q never share phi. Certificates
    of other methods have no such box: theirs is void.
    """

    fingerprint: str  #: of all that defines J
    method: str
    bound: float  #: of the conditioning; 0: det J != 0 only
    regular: Subdivision  #: the domain and its parts
    conditioning: float  #: proven lower bound of the conditioning on the proved share; 0 if none was asked for
    injective: Subdivision | None = None  #: a box on which phi is one-to-one, and its parts
    fold: tuple[tuple[float, ...], ...] = ()  #: two joint positions where det J differs in sign, the second in the fold
    boxes: int = 0  #: evaluated to find the proof
    seconds: float = field(default=0.0)
    least_singular_value: float = 0.0  #: of a ClearBox; parts proved to lie outside it count as proved. 0: no ClearBox
    least_volume: float = 0.0  #: of a RegularPart, which keeps folds out of what is not proved. 0: another domain
    clear_share: float = 0.0  #: of the clear positions of a RegularPart's box, the share in proved parts, from samples
    digest: str = ""  #: of all of the above, see `seal`

    def __post_init__(self) -> None:
        for name in ("fingerprint", "method"):
            require_text(name, getattr(self, name))
        require_kind("regular", self.regular, Subdivision)
        if not 0 <= self.bound < 1 or not 0 <= self.conditioning <= 1:
            raise InvalidValueError("bound and conditioning", (self.bound, self.conditioning), "numbers from 0 to 1")
        if self.method not in METHODS:
            object.__setattr__(self, "injective", None)

    def seal(self) -> Self:
        """The same certificate with the digest of its content, which shows accidental changes. It is no signature."""
        return replace(self, digest=self._compute_digest())

    def remove_given_up(self, count: int) -> Self:
        """This certificate without a number of parts that were given up, which older files have and no check covers."""
        return self.seal() if self.digest == self._compute_digest(count) else self

    def _compute_digest(self, given_up: int = 0) -> str:
        """SHA-256 of all numbers and texts but the digest; older certificates also count parts that were given up."""
        numbers = [self.bound, self.conditioning, self.boxes, self.seconds, self.least_singular_value, given_up]
        # Older certificates have no such numbers.
        numbers += [self.least_volume, self.clear_share] if self.least_volume else []
        points = [[float(value) for value in point] for point in self.fold]
        content = [self.fingerprint, self.method, [float(number) for number in numbers], points]
        digest = hashlib.sha256(json.dumps(content).encode())
        for tree in (self.regular, self.injective):
            parts = () if tree is None else (tree.low, tree.high, tree.codes)
            digest.update(b"".join(hashlib.sha256(part.tobytes()).digest() for part in parts) or b"none")
        return digest.hexdigest()

    def require_for(self, fingerprint: str) -> None:
        """Raise CertifyError if the certificate is not that of the chart with this fingerprint, or has been changed."""
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
        """Share of the domain's volume that is proved, of the whole box for a ClearBox."""
        return 0.0 if self.fold else self.regular.share

    @property
    def unproved(self) -> tuple[Array, Array]:
        """Corners (boxes, n) of the parts where nothing is proved."""
        return self.regular.leaves(OPEN)

    def facts(self) -> dict[str, str]:
        """What is proved, of how many boxes, and what is not."""
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
        # where a proof would have to go on
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
        if self.fold:
            at = ", ".join(f"{value:.3f}" for value in self.fold[-1])
            return f"refuted, the chart folds at q = ({at})"
        # the verdict, with shares rounded down
        verdict = "no fold everywhere on the domain"
        if not self.proved:
            share, clear = percent(self.share, 4), percent(self.clear_share, 3)
            guarded = self.least_volume > 0
            where = f"{share} of the box, {clear} of what is clear (samples)" if guarded else f"{share} of the domain"
            verdict = f"not proved, {self.regular.open_count:,} boxes are open; no fold on {where}"
        return f"{verdict}, conditioning >= {self.bound:g}" if self.bound else verdict
