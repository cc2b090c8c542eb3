"""Weights of the loss: one number for each term, and the kind of angles that the first two terms measure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from orthocas.checks import as_float_array, as_number, require_kind, require_known
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.metrics import Metric

ANGLES = ("paper", "metric")  #: kinds of angles in the loss
WeightNumbers = Sequence[float]  #: two to five numbers: task, mutual, regularity, length, folds


@dataclass(frozen=True)
class Weights:
    """lambda1 (task) and lambda2 (mutual) of [AS2023] eq. (24); the others are ours.

    The ratio of the first two selects a point on the Pareto front of task angles and mutual angles. At the paper's
    1000 : 1 the optimum can lose rank. The regularity term prevents the gradients of the coordinates from collapsing
    anywhere. The length term keeps their lengths even, which helps controllers. The fold term acts at the worst points
    of the domain, which a search finds between the stages of a fit, and keeps the conditioning above 0.2 there.

    Args:
        task: lambda1 > 0.
        mutual: lambda2 >= 0.
        regularity: lambda3 >= 0.
        length: lambda4 >= 0.
        folds: lambda5 >= 0. With 0 there is no search.
        extra: weights >= 0 of registered terms, by name; see `orthocas.register_loss_term`.
        angles: what the task and mutual terms measure: 'paper', the cosines of [AS2023] eq. (24) with Euclidean norms;
            'metric', cosines in the metric with an orthonormal basis of the task gradients, which do not depend on the
            choice of task coordinates. Default: 'metric' for A = M, where closed loops are better with it, and 'paper'
            otherwise; see docs/angles.md.

    Raises:
        InvalidValueError: if a weight is negative or not finite, or all weights are zero.
        UnknownNameError: if there are no such angles.

    Example:
        >>> import orthocas as oc
        >>> oc.Weights(mutual=300.0).by_name
        {'task': 1000.0, 'mutual': 300.0, 'regularity': 150.0, 'length': 0.0}
        >>> oc.Weights.of([1000.0, 1.0]).regularity
        0.0
    """

    task: float = 1000.0
    mutual: float = 30.0
    regularity: float = 150.0
    length: float = 0.0
    folds: float = 1000.0
    extra: Mapping[str, float] = field(default_factory=dict, hash=False)
    angles: str | None = None

    def __post_init__(self) -> None:
        for k, name in enumerate(("task", "mutual", "regularity", "length", "folds")):
            object.__setattr__(self, name, _weight(f"lambda{k + 1}", getattr(self, name)))
        require_kind("extra", self.extra, Mapping)
        if self.angles is not None:
            require_known("angles", self.angles, ANGLES)
        extra = {name: _weight(f"weight of {name}", value) for name, value in self.extra.items()}
        object.__setattr__(self, "extra", extra)
        if not any(self.by_name.values()):
            raise InvalidValueError("weights", "all zero", "at least one positive number")

    @classmethod
    def of(cls, weights: "Weights | WeightNumbers") -> "Weights":
        """Convert two to five numbers in the order of the fields; missing ones are 0. Weights stay as they are.

        Raises:
            ShapeError, InvalidValueError: if the numbers are invalid, or the task weight is not positive.
        """
        if not isinstance(weights, Weights):
            values = as_float_array("weights", weights)
            if values.shape not in ((2,), (3,), (4,), (5,)):
                raise ShapeError("weights", values.shape, (5,))
            weights = cls(*values.tolist(), *[0.0] * (5 - len(values)))
        if weights.task == 0:
            raise InvalidValueError("lambda1", weights.task, "a positive number")
        return weights

    def for_metric(self, metric: Metric) -> "Weights":
        """The same weights with the default angles of a metric, unless angles are given."""
        return replace(self, angles="metric" if metric.is_inertia else "paper") if self.angles is None else self

    @property
    def by_name(self) -> dict[str, float]:
        """The weights by the names of their terms, without the fold term; without angles, those of the paper."""
        kind = "metric " if self.angles == "metric" else ""
        angles = {f"{kind}task": self.task, f"{kind}mutual": self.mutual}
        return angles | {"regularity": self.regularity, "length": self.length} | dict(self.extra)


def _weight(name: str, value: float) -> float:
    if not 0 <= as_number(name, value) < float("inf"):
        raise InvalidValueError(name, value, "a finite number >= 0")
    return float(value)


DEFAULT_WEIGHTS = Weights()  #: weights of a fit by default
