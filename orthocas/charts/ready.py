"""Ready charts of known arms: their names, loading, and a card with the facts of each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, Self

from orthocas.charts.chart import Chart, load_file
from orthocas.tools.checks import as_path, require_known
from orthocas.tools.display import Shown, listed, number_list, percent

_DATA = files(__package__) / "data"
_CARD = ".json"


@dataclass(frozen=True)
class Model:
    """The origin of a robot model. A chart file includes the model, so its licence applies to the file."""

    robot: str  #: maker and type
    file: str  #: the robot file
    package: str  #: the package from which the file was taken, with its version
    upstream: str  #: the original source of the file
    licence: str  #: SPDX identifier of the licence; its text is in orthocas/charts/licences
    holder: str  #: holder of the copyright


@dataclass(frozen=True, eq=False, repr=False)
class Card(Shown):
    """The facts of a ready chart. Angles are in degrees, joint positions in rad or m."""

    name: str
    model: Model
    task: str
    coordinates: str  #: the parametrisation
    joints: tuple[str, ...]
    cyclic_joints: tuple[str, ...]  #: joints at all whose positions the chart is valid
    centre: tuple[float, ...]
    half_width: tuple[float, ...]
    quality: Mapping[str, Any]  #: report of the chart, as printed by `orthocas evaluate --json`
    proved_parts: int  #: number of parts of the domain in the proof that the chart does not fold; 0 for wide charts
    fingerprint: str  #: fingerprint of the chart, see `Certificate`
    commands: tuple[str, ...]  #: commands that made the chart
    branch: str = ""  #: name of the branch, for wide charts
    regular_share: float = 1.0  #: share of the branch's clear positions that lie in the domain

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read a card from the text of `to_json`."""
        data = json.loads(text)
        lists = {name: tuple(value) for name, value in data.items() if isinstance(value, list)}
        return cls(**data | lists | {"model": Model(**data["model"])})

    def to_json(self) -> str:
        """The card as JSON text."""
        return json.dumps(asdict(self), indent=1, ensure_ascii=False) + "\n"

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)

    @property
    def licence_text(self) -> str:
        """The copyright notices of all ready charts' robots, then the text of this model's licence."""
        folder = files(__package__) / "licences"
        return "\n".join((folder / f"{name}.txt").read_text("utf-8") for name in ("NOTICE", self.model.licence))

    def facts(self) -> dict[str, str]:
        """Quality, domain, proof, and where the chart comes from."""
        quality, model = self.quality, self.model
        extra = "1 extra coordinate" if quality["r"] == 1 else f"{quality['r']} extra coordinates"
        cyclic = {"cyclic": f"holds at all positions of {listed(self.cyclic_joints)}"} if self.cyclic_joints else {}
        proof = {"proof": f"no fold anywhere on the domain, {self.proved_parts} parts"}
        if self.branch:
            share = percent(self.regular_share, 2)
            proof = {
                "branch": f"{self.branch}; regular on {share} of its clear positions, and the domain is this part",
                "proof": "none in the file: the domain leaves folds out, and laws and C test it at every tick",
            }
        angles, leak, conditioning = quality["task_angle_deg"], quality["leak_deg"], quality["conditioning"]
        return {
            "card": f"{self.name}, {model.robot}, {quality['n']} joints, {extra}",
            "leak": f"rms {leak['rms']:.2f}, largest sampled {leak['max']:.1f} deg (angle in the metric)",
            "task angle": f"{_spread(angles)} (the paper's cosines)",
            "mutual angle": "none, r = 1" if quality["r"] == 1 else _spread(quality["mutual_angle_deg"]),
            "conditioning": f"mean {conditioning['mean']:.3f}, least {conditioning['min']:.3f}",
            "domain": f"half-width {number_list(self.half_width)} around {number_list(self.centre)}",
            **cyclic,
            **proof,
            "model": f"{model.file} of {model.package}; {model.licence}, {model.holder}",
            "samples": f"{quality['samples']} held out, seed {quality['seed']}",
            "coordinates": self.coordinates,
        }


def _spread(angles: Mapping[str, float]) -> str:
    """Mean and standard deviation of angles in words."""
    return f"mean {angles['mean']:.2f}, std {angles['std']:.2f} deg"


def names() -> tuple[str, ...]:
    """Names of all ready charts, such as 'panda-position'."""
    return tuple(sorted(entry.name.removesuffix(_CARD) for entry in _DATA.iterdir() if entry.name.endswith(_CARD)))


def load(path: str | Path) -> Chart:
    """Load a chart from its file, or a ready chart by its name. Loading never runs code from a file.

    Ready charts include the robot model and, except for wide charts, a proof that they do not fold.

    Args:
        path: path of a chart file, or the name of a ready chart. A file with that name takes precedence.

    Returns:
        The chart; a `GrownChart` if its coordinates are grown.

    Raises:
        UnknownNameError: if a name without folder and suffix is neither a file nor a ready chart.
        ChartFileError: if the file is missing, truncated, edited, not a chart file, or from a newer version.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import orthocas as oc
        >>> chart = oc.load("panda-position")
        >>> chart.labels
        ('x', 'y', 'z', 'xi1', 'xi2', 'xi3', 'xi4')
        >>> chart.certificate.proved
        True
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "arm.orthocas"
        ...     chart.save(path)
        ...     again = oc.load(path)
        >>> bool((again.xi(chart.domain.centre) == chart.xi(chart.domain.centre)).all())
        True
    """
    file = as_path("path", path)
    # A word without folder and suffix that is no file is taken as the name of a ready chart.
    if file.exists() or file.suffix or len(file.parts) > 1:
        return load_file(file)
    require_known("chart file or ready chart", file.name, names())
    with as_file(_DATA / f"{file.name}.orthocas") as stored:
        return load_file(stored)


def card(name: str) -> Card:
    """The card of a ready chart: quality, domain, model with its licence, and the commands that made it.

    Raises:
        UnknownNameError: if no ready chart has that name.

    Example:
        >>> import orthocas as oc
        >>> oc.charts.card("panda-position").model.licence
        'Apache-2.0'
    """
    require_known("ready chart", name, names())
    return Card.from_json((_DATA / f"{name}{_CARD}").read_text(encoding="utf-8"))
