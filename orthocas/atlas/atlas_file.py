"""Files of atlases: the plan in the header, then blocks of cells with their charts, and one of turns.

Blocks `CELL`: the head has one record for each cell, the body the numbers of the charts among them. A block `TURN`
has an order, signs and constants of the coordinates of all charts; the last one counts.
"""

import base64
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocas.atlas.lattice import Lattice, Orbits, Outcome, Result, Symmetries, orbits
from orthocas.atlas.plan import AtlasSettings, Plan, lattice_of
from orthocas.atlas.regions import Region, Surroundings, joint_range_of
from orthocas.errors import AtlasFileError, InvalidValueError, OrthocasError
from orthocas.tasks.domains import NARROWEST
from orthocas.tasks.problem import FOREIGN, problem_from_data, problem_to_data
from orthocas.tools.archive import Stored, from_npy, to_npy
from orthocas.tools.block_file import BlockKind, Contents, append, scan
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices, frozen_array, frozen_indices, require_count
from orthocas.tools.json import part

_CELL, _TURN = b"CELL", b"TURN"
ATLAS = BlockKind("atlas", b"\x93ORTHOCASATLAS\n", 2, (_CELL, _TURN), AtlasFileError)
_MODERATE = 1e50  # products of a few such numbers do not overflow
_SAME = 1e-9  # of a tile
Records = NDArray[np.void]


@dataclass(frozen=True, eq=False)
class Stock:
    """What a file holds, without the numbers of the charts."""

    path: Path
    plan: Plan
    region: Region
    contents: Contents
    records: Records  #: of all cells, in the order in which they came
    places: Indices  #: where the numbers of each chart lie in the file, (fitted charts,)
    turns: "Turns | None"

    @property
    def charts(self) -> Indices:
        """Rows of the records that have a chart."""
        return np.flatnonzero(self.records["outcome"] == Outcome.CHART)

    @cached_property
    def orbits(self) -> Orbits:
        """The tiles of the region, and which is fitted for each."""
        plan, joints = self.plan, list(self.plan.joints)
        tiles = self.region.tiles(plan.lattice)
        return orbits(plan.lattice, tiles, plan.maps.of(plan.joints), plan.problem.domain.centre[joints])

    def numbers(self, rows: Indices) -> Array:
        """Constants and coefficients of some of the fitted charts, (rows, fitted, 1 + K).

        Raises:
            AtlasFileError: if the file is gone or damaged.
        """
        kind = chart_type(self.plan)
        found = np.empty((len(rows), *kind["numbers"].shape))
        try:
            with self.path.open("rb") as stream:
                for k, row in enumerate(rows.tolist()):
                    stream.seek(int(self.places[row]))
                    content = stream.read(kind.itemsize)
                    found[k] = _checked(self.path, content, kind, row)
        except OSError as error:
            raise AtlasFileError(f"cannot read atlas file {self.path}: {error.strerror}") from None
        return found


@dataclass(frozen=True, eq=False)
class Turns:
    """Order, signs and constants of the coordinates of every chart: xi_j = sign_j own_order_j + constant_j."""

    order: Indices  #: (charts, fitted)
    signs: Array  #: (charts, fitted), +1 or -1
    constants: Array  #: (charts, fitted)


def record_type(plan: Plan) -> np.dtype[np.void]:
    """The record of one cell."""
    k = len(plan.joints)
    return np.dtype(
        [
            ("tile", "<i8"),
            ("parent", "<i4"),  # row of the cell that was halved, -1 for tiles
            ("upper", "u1"),  # whether it is the upper half
            ("outcome", "u1"),
            ("joint", "i1"),
            ("certified", "u1"),
            ("levels", "u1", (k,)),
            ("places", "<u4", (k,)),
            ("leak_deg", "<f4"),
            ("conditioning", "<f4"),
            ("clear", "<f4"),
            ("seconds", "<f4"),
        ]
    )


def chart_type(plan: Plan) -> np.dtype[np.void]:
    """The numbers of one chart."""
    terms = plan_terms(plan)
    return np.dtype([("crc", "<u4"), ("row", "<u4"), ("numbers", "<f8", (plan.fitted, 1 + terms))])


def plan_terms(plan: Plan) -> int:
    """Number of terms K of the polynomials."""
    from_joints = len(plan.joints)
    terms = 1
    for k in range(1, plan.settings.degree + 1):
        terms = terms * (from_joints + k) // k
    return terms - 1 + len(plan.cyclic)


def add_results(path: Path, plan: Plan, rows: Sequence[tuple[int, bool, Result]], first_chart: int) -> None:
    """Append results, each with the row of its parent and whether it is the upper half.

    Args:
        path: the file.
        plan: its plan.
        rows: the results.
        first_chart: number of charts that the file has already.
    """
    records = np.zeros(len(rows), record_type(plan))
    charts: list[bytes] = []
    for record, (parent, upper, result) in zip(records, rows, strict=True):
        cell = result.cell
        record["tile"], record["parent"], record["upper"] = cell.tile, parent, upper
        record["outcome"], record["joint"], record["certified"] = result.outcome, result.joint, result.certified
        record["levels"], record["places"] = cell.levels, cell.places
        for name in ("leak_deg", "conditioning", "clear", "seconds"):
            record[name] = getattr(result, name)
        if result.numbers is not None:
            charts.append(_chart_bytes(plan, result.numbers, first_chart + len(charts)))
    append(path, _CELL, records.tobytes(), b"".join(charts), ATLAS)


def add_turns(path: Path, turns: Turns) -> None:
    """Append order, signs and constants of all charts."""
    coded = ((turns.order + 1) * turns.signs).astype(np.int8)
    head = np.array(coded.shape, dtype="<u8").tobytes() + coded.tobytes() + turns.constants.astype("<f8").tobytes()
    append(path, _TURN, head, b"", ATLAS)


def read_stock(path: Path) -> Stock:
    """All of a file but the numbers of its charts.

    Raises:
        AtlasFileError: if the file is missing, damaged, of another kind, or from a newer version.
    """
    contents = scan(path, ATLAS)
    try:
        plan, region = _plan(contents.header)
        records, places = _records(path, plan, contents)
        stock = Stock(path, plan, region, contents, records, places, _turns(plan, contents))
        _require_use(stock)
        return stock
    except AtlasFileError:
        raise
    except OrthocasError as error:
        raise AtlasFileError(f"{path} is inconsistent: {error}") from None
    except FOREIGN as error:
        raise AtlasFileError(f"{path} is incomplete: {type(error).__name__} {error}") from None


def require_whole(stock: Stock) -> Stock:
    """The stock; raises AtlasFileError if the file ends within a block."""
    if stock.contents.end < stock.contents.size:
        raise AtlasFileError(
            f"{stock.path} is truncated, expected whole blocks: the command that built it goes on from there"
        )
    return stock


def header_of(plan: Plan, region: Region) -> dict[str, Any]:
    """The header of a plan's file."""
    header, arrays = problem_to_data(plan.problem)
    arrays = {
        **arrays,
        "lattice_low": plan.lattice.low,
        "lattice_width": plan.lattice.width,
        "lattice_counts": plan.lattice.counts,
        "lattice_endless": plan.lattice.endless.astype(np.uint8),
        "map_signs": plan.maps.signs,
        "map_shifts": plan.maps.shifts,
        "scale": plan.scale,
        **({"postures": region.postures} if isinstance(region, Surroundings) else {}),
    }
    return {
        **header,
        "settings": asdict(plan.settings),
        "idle": list(plan.idle),
        "cyclic": list(plan.cyclic),
        "radius": region.radius if isinstance(region, Surroundings) else 0.0,
        "arrays": {name: base64.b64encode(to_npy(array)).decode() for name, array in arrays.items()},
    }


def _plan(header: Mapping[str, Any]) -> tuple[Plan, Region]:
    """Plan and region of a header that may be anything."""
    coded = part(header, "arrays", dict)
    arrays: dict[str, Stored] = {name: from_npy(base64.b64decode(text, validate=True)) for name, text in coded.items()}
    problem = problem_from_data(header, arrays)
    settings = AtlasSettings(**part(header, "settings", dict))
    idle, cyclic = (
        tuple(require_count(f"{name} joint", i, least=0, most=problem.n - 1) for i in part(header, name, list))
        for name in ("idle", "cyclic")
    )
    active = tuple(i for i in range(problem.n) if i not in idle)
    joints = tuple(i for i in active if i not in cyclic)
    if len({*idle, *cyclic}) != len(idle) + len(cyclic) or not joints or problem.r <= len(idle):
        raise InvalidValueError("idle and cyclic joints", (idle, cyclic), "different ones, and others to divide")
    k = len(joints)
    maps = _maps(active, arrays)
    counts = frozen_indices("lattice_counts", arrays["lattice_counts"], (k,), 2**31)
    low, width = (frozen_array(name, arrays[name], (k,)) for name in ("lattice_low", "lattice_width"))
    endless = np.array(frozen_array("lattice_endless", arrays["lattice_endless"], (k,)) > 0)
    lattice = Lattice(low, width, counts, endless)
    _require_lattice(lattice, lattice_of(problem, joints, maps, settings))
    scale = frozen_array("scale", arrays["scale"], (problem.m,))
    if not ((scale > 1 / _MODERATE) & (scale < _MODERATE)).all():
        raise InvalidValueError("scale", scale.tolist(), f"positive numbers below {_MODERATE:g}")
    plan = Plan(problem, settings, idle, cyclic, lattice, maps, scale)
    return plan, _region(header, arrays, plan)


def _maps(joints: tuple[int, ...], arrays: Mapping[str, Stored]) -> Symmetries:
    """Symmetries in the joints that coordinates depend on, the identity first."""
    signs = frozen_array("map_signs", arrays["map_signs"], (None, len(joints)))
    shifts = frozen_array("map_shifts", arrays["map_shifts"], signs.shape)
    known = (np.abs(signs) == 1).all() and ((shifts == 0) | (shifts == np.pi)).all()
    if not (known and len(signs) and (signs[0] == 1).all() and (shifts[0] == 0).all()):
        raise InvalidValueError("maps", signs.tolist(), "the identity, then signs of 1 and -1 with shifts of 0 and pi")
    return Symmetries(joints, signs, shifts)


def _require_lattice(found: Lattice, wanted: Lattice) -> None:
    """Raise InvalidValueError unless the tiles are those of joint range, settings and symmetries."""
    if not wanted.width.min() > 2 * NARROWEST:
        raise InvalidValueError("joint range", wanted.width.tolist(), f"tiles wider than {2 * NARROWEST:g}")
    for name in ("low", "width", "counts", "endless"):
        has, wants = (np.asarray(getattr(lattice, name), dtype=float) for lattice in (found, wanted))
        if not (np.abs(has - wants) <= _SAME * wanted.width).all():
            raise InvalidValueError(f"lattice_{name}", has.tolist(), f"{wants.tolist()}, which covers the joint range")


def _region(header: Mapping[str, Any], arrays: Mapping[str, Stored], plan: Plan) -> Region:
    whole = joint_range_of(plan.problem.domain, plan.joints)
    if "postures" not in arrays:
        return whole
    radius = header.get("radius")
    if isinstance(radius, bool) or not isinstance(radius, float) or not 0 < radius < np.pi:
        raise InvalidValueError("field 'radius'", repr(radius)[:80], "a positive number below pi")
    postures = frozen_array("postures", arrays["postures"], (None, len(plan.joints)))
    if not len(postures):
        raise InvalidValueError("postures", "empty", "at least one")
    return Surroundings(whole.low, whole.high, postures, radius)


def _records(path: Path, plan: Plan, contents: Contents) -> tuple[Records, Indices]:
    """Records of all cells, and where the numbers of charts lie."""
    kind, size = record_type(plan), chart_type(plan).itemsize
    records, places = [np.zeros(0, kind)], [np.zeros(0, dtype=np.int64)]
    for block in contents.blocks:
        if block.tag == _CELL:
            found = np.frombuffer(block.head, kind)
            charts = int((found["outcome"] == Outcome.CHART).sum())
            if block.length != charts * size:
                raise AtlasFileError(f"{path} is damaged: {block.length} bytes for {charts} charts")
            records.append(found)
            places.append(block.body + size * np.arange(charts))
    all_records = np.concatenate(records)
    _require_tree(path, plan, all_records)
    return all_records, np.concatenate(places)


def _require_tree(path: Path, plan: Plan, records: Records) -> None:
    """Raise AtlasFileError unless all cells are tiles, or halves of cells that came before and were split."""
    rows, k = np.arange(len(records)), len(plan.joints)
    parent, tile, joint = (records[name].astype(np.int64) for name in ("parent", "tile", "joint"))
    sound = (parent >= -1) & (parent < rows) & (tile >= 0) & (tile < plan.lattice.size)
    sound &= (joint >= -(records["outcome"] != Outcome.SPLIT).astype(int)) & (joint < k) & (records["upper"] <= 1)
    inner = np.flatnonzero(sound & (parent >= 0))
    above = records[parent[inner]]
    levels, places = (above[name].astype(np.int64) for name in ("levels", "places"))
    halved = above["joint"].astype(int)[:, None] == np.arange(k)
    same = (records["levels"][inner] == levels + halved) & (
        records["places"][inner] == np.where(halved, 2 * places + records["upper"][inner, None], places)
    )
    sound[inner] &= (above["outcome"] == Outcome.SPLIT) & (tile[inner] == above["tile"]) & same.all(axis=1)
    outer = parent < 0
    sound[outer] &= ~records["levels"][outer].any(axis=1) & ~records["places"][outer].any(axis=1)
    sound &= records["levels"].sum(axis=1, dtype=np.int64) <= plan.settings.splits
    sound &= _numbers_make_sense(records)
    if not sound.all():
        raise AtlasFileError(f"{path} is damaged: record {int(np.argmin(sound))} of its cells makes no sense")


def _require_use(stock: Stock) -> None:
    """Raise AtlasFileError unless all cells are of tiles that are fitted for the region, and none comes twice."""
    records = stock.records
    outer = records["parent"] < 0
    halves = 2 * records["parent"][~outer].astype(np.int64) + records["upper"][~outer]
    again = len(records) - len(np.unique(records["tile"][outer])) - len(np.unique(halves))
    if again or not np.isin(records["tile"], stock.orbits.fitted).all():
        raise AtlasFileError(f"{stock.path} is damaged: cells that come twice, or of tiles outside its region")


def _numbers_make_sense(records: Records) -> NDArray[np.bool_]:
    """Whether seconds are none or more, and leak, conditioning and share of charts are in their ranges, (cells,)."""
    ranges = {"leak_deg": 90.0, "conditioning": 1.0, "clear": 1.0}
    inside = [(records[name] >= 0) & (records[name] <= most * (1 + 1e-6)) for name, most in ranges.items()]
    timed = (records["seconds"] >= 0) & np.isfinite(records["seconds"])
    return np.asarray(timed & (np.all(inside, axis=0) | (records["outcome"] != Outcome.CHART)))


def _turns(plan: Plan, contents: Contents) -> Turns | None:
    heads = [block.head for block in contents.blocks if block.tag == _TURN]
    if not heads:
        return None
    head, r = heads[-1], plan.fitted
    charts = (len(head) - 16) // (9 * r)
    if len(head) != 16 + 9 * r * charts:
        raise InvalidValueError("turns of charts", f"{len(head)} bytes", f"9 for each of {r} coordinates")
    coded = np.frombuffer(head, np.int8, charts * r, 16).reshape(charts, r)
    constants = frozen_array("constants", np.frombuffer(head, "<f8", charts * r, 16 + charts * r), (None,))
    order = frozen_indices("order", np.abs(coded.astype(int)) - 1, (charts, r), r)
    if (np.sort(order, axis=1) != np.arange(r)).any() or (np.abs(constants) >= _MODERATE).any():
        raise InvalidValueError("turns of charts", "a coordinate twice, or a huge constant", "an order and constants")
    return Turns(order, np.sign(coded).astype(float), constants.reshape(charts, r))


def _chart_bytes(plan: Plan, numbers: Array, row: int) -> bytes:
    kind = chart_type(plan)
    record = np.zeros((), kind)
    record["row"], record["numbers"] = row, numbers
    record["crc"] = zlib.crc32(record.tobytes()[4:])
    return record.tobytes()


def _checked(path: Path, content: bytes, kind: np.dtype[np.void], row: int) -> Array:
    if len(content) == kind.itemsize:
        record = np.frombuffer(content, kind)[0]
        if record["crc"] == zlib.crc32(content[4:]) and record["row"] == row:
            numbers = np.asarray(record["numbers"])
            if not (np.abs(numbers) < _MODERATE).all():
                raise AtlasFileError(f"{path} is damaged: numbers of chart {row} are not finite, or huge")
            return numbers
    raise AtlasFileError(f"{path} is damaged: chart {row} does not match its checksum")
