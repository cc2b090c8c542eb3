"""The ready charts by name: files of charts and of their cards in the folder data."""

from importlib.resources import as_file, files

from orthocas.chart import Chart
from orthocas.charts.card import Card
from orthocas.checks import require_known

_DATA = files(__package__) / "data"
_CARD = ".json"


def names() -> tuple[str, ...]:
    """Names of all ready charts, such as 'panda-position'."""
    return tuple(sorted(entry.name.removesuffix(_CARD) for entry in _DATA.iterdir() if entry.name.endswith(_CARD)))


def load(name: str) -> Chart:
    """A ready chart. It includes the robot's model, and a proof that the chart does not fold.

    Raises:
        UnknownNameError: if there is no chart of that name.

    Example:
        >>> import orthocas as oc
        >>> chart = oc.charts.load("panda-position")
        >>> chart.labels
        ('x', 'y', 'z', 'xi1', 'xi2', 'xi3', 'xi4')
        >>> chart.certificate.proved
        True
    """
    require_known("ready chart", name, names())
    with as_file(_DATA / f"{name}.orthocas") as path:
        return Chart.load(path)


def card(name: str) -> Card:
    """The card of a ready chart: quality, domain, model with its licence, and the commands that made it.

    Raises:
        UnknownNameError: if there is no chart of that name.

    Example:
        >>> import orthocas as oc
        >>> oc.charts.card("panda-position").model.licence
        'Apache-2.0'
    """
    require_known("ready chart", name, names())
    return Card.from_json((_DATA / f"{name}{_CARD}").read_text(encoding="utf-8"))
