"""The terms of the loss by name, and how to add your own."""

from orthocas.checks import require_known
from orthocas.errors import InvalidValueError
from orthocas.fitting.loss.angles import MutualTerm, TaskTerm
from orthocas.fitting.loss.length import LengthTerm
from orthocas.fitting.loss.regularity import RegularityTerm
from orthocas.fitting.loss.term import LossTerm, require_sample_data

_TERMS: dict[str, LossTerm] = {}


def register(term: LossTerm) -> None:
    """Make a term known by its name: `Weights(extra={name: weight})` then adds it to the loss.

    Raises:
        UnknownNameError: if samples cannot tell what it needs.
        InvalidValueError: if the name belongs to another term.

    Example:
        >>> from dataclasses import dataclass
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> @dataclass(frozen=True)
        ... class FirstJoint:  # the coordinates should not depend on joint 1
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
    for name in term.data:
        require_sample_data(name)
    if _TERMS.get(term.name, term) != term:
        raise InvalidValueError("name", repr(term.name), "a name that no other term has")
    _TERMS[term.name] = term


def term_of(name: str) -> LossTerm:
    """The term of that name.

    Raises:
        UnknownNameError: if there is none.
    """
    require_known("loss term", name, _TERMS)
    return _TERMS[name]


for _term in (TaskTerm(), MutualTerm(), LengthTerm(), RegularityTerm()):
    register(_term)
