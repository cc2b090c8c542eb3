"""The registry of loss terms, to which you can add your own."""

from orthocas.checks import require_known
from orthocas.errors import InvalidValueError
from orthocas.fitting.loss.angles import MutualTerm, TaskTerm
from orthocas.fitting.loss.length import LengthTerm
from orthocas.fitting.loss.metric_angles import MetricMutualTerm, MetricTaskTerm
from orthocas.fitting.loss.regularity import FOLD_TERM, RegularityTerm
from orthocas.fitting.loss.term import LossTerm, require_sample_data

_TERMS: dict[str, LossTerm] = {}


def register(term: LossTerm) -> None:
    """Register a loss term. `Weights(extra={name: weight})` then adds it to the loss.

    Raises:
        UnknownNameError: if the term needs data that samples do not have.
        InvalidValueError: if the name belongs to another term.

    Example:
        >>> from dataclasses import dataclass
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> @dataclass(frozen=True)
        ... class FirstJoint:  # coordinates should depend little on joint 1
        ...     name: str = "first joint"
        ...     data: tuple[str, ...] = ()
        ...     hinge: bool = False
        ...
        ...     def residuals(self, coordinate_jacobian, data, sizes):
        ...         return coordinate_jacobian[:, 0]
        >>> oc.register_loss_term(FirstJoint())
        >>> weights = oc.Weights(extra={"first joint": 100.0})
        >>> fit = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), weights=weights, samples=300)
        >>> fit.status.value
        'converged'
    """
    if isinstance(term, type) or not isinstance(term, LossTerm):
        raise InvalidValueError("term", f"a {type(term).__name__}", "an object with the members of LossTerm")
    for name in term.data:
        require_sample_data(name)
    if _TERMS.get(term.name, term) != term:
        raise InvalidValueError("name", repr(term.name), "a name that no other term uses")
    _TERMS[term.name] = term


def term_of(name: str) -> LossTerm:
    """The term with this name.

    Raises:
        UnknownNameError: if there is no such term.
    """
    require_known("loss term", name, _TERMS)
    return _TERMS[name]


_OURS = (MetricTaskTerm(), MetricMutualTerm(), LengthTerm(), RegularityTerm(), FOLD_TERM)
for _term in (TaskTerm(), MutualTerm(), *_OURS):
    register(_term)
