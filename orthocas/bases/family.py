"""Parametrisations xi_theta(q): protocols of families, bases of functions, labels, and the registry."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self, TypeVar, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthocas.errors import InvalidValueError, NotSavableWarning, warn_caller
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, require_kind, require_known, require_shape

if TYPE_CHECKING:
    from orthocas.tasks.problem import Problem


class ArrayMemory:
    """Named arrays that are reused. One computation at a time may use them, because the next one overwrites them."""

    def __init__(self) -> None:
        self._arrays: dict[tuple[Any, ...], NDArray[Any]] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """The array of this name, shape and type, with arbitrary values."""
        key = (name, shape, np.dtype(dtype))
        if key not in self._arrays:
            self._arrays[key] = np.empty(shape, dtype)
        return self._arrays[key]


class Memories:
    """A pool of memories for threads."""

    def __init__(self) -> None:
        self._spare: list[ArrayMemory] = []

    @contextmanager
    def borrow(self, count: int) -> Iterator[list[ArrayMemory]]:
        """Lend `count` memories that nobody else uses meanwhile."""
        borrowed: list[ArrayMemory] = []
        # Take free memories, and create the missing ones. All return to the pool afterwards.
        for _ in range(count):
            try:
                borrowed.append(self._spare.pop())
            except IndexError:
                borrowed.append(ArrayMemory())
        try:
            yield borrowed
        finally:
            self._spare.extend(reversed(borrowed))


TURN = 2 * np.pi  #: period of coordinates that are angles [rad]
Expression = TypeVar("Expression", ca.SX, ca.MX)
Pulled = Callable[[Array, Array], Array]  #: derivatives dL/dJ_xi, array for the result -> dL/dtheta


@dataclass(frozen=True, eq=False)
class JointSpace:
    """The joints of a family, with the box that scales them, and whether each is prismatic."""

    centre: Array  #: (n,)
    half_width: Array  #: (n,), > 0
    prismatic: tuple[bool, ...]
    joint_names: tuple[str, ...]

    @classmethod
    def of(cls, problem: Problem) -> JointSpace:
        """All joints of a problem."""
        robot, domain = problem.robot, problem.domain
        return cls(domain.centre, domain.half_width, robot.tree.prismatic, robot.joint_names)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.centre)

    def restricted_to(self, joints: list[int]) -> JointSpace:
        """The space of some of the joints."""
        return JointSpace(
            self.centre[joints],
            self.half_width[joints],
            tuple(self.prismatic[i] for i in joints),
            tuple(self.joint_names[i] for i in joints),
        )


class Family(Protocol):
    """Functions xi_theta of n joints with r components and `size` explicit parameters theta."""

    @property
    def size(self) -> int:
        """Number of parameters."""

    @property
    def outputs(self) -> int:
        """Number r of components."""

    @property
    def as_matrices(self) -> bool:
        """Whether the family consists of dense products, and so needs MX graphs with samples as columns, not SX."""

    @property
    def width(self) -> int:
        """Largest number of intermediate values per sample. It limits how many samples fit into the cache."""

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi_theta(q), (r, N), for N joint positions side by side as columns (n, N); theta (size, 1)."""

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients of the components, r matrices (n, N). Column s of matrix j is dxi_j/dq at joint position s."""

    def initial(self, seed: int) -> Array:
        """A seeded starting point, (size,)."""


@runtime_checkable
class ArrayFamily(Family, Protocol):
    """A family whose gradients NumPy computes in any precision, together with derivatives of a loss of them."""

    def pullback(self, points: Array, theta: Array, memory: ArrayMemory | None = None) -> tuple[Array, Pulled]:
        """J_xi at points, and a function that computes dL/dtheta for any loss L(J_xi).

        Args:
            points: joint positions, (N, n).
            theta: parameters, (size,). All products have its type.
            memory: reused arrays, which this call overwrites. Nobody else may use them meanwhile.

        Returns:
            J_xi, (N, r, n), and the map from dL/dJ_xi (N, r, n) to dL/dtheta. The map writes to an array (size,) of
            theta's type, and returns it.
        """


@runtime_checkable
class ReorderableFamily(Family, Protocol):
    """A family whose components can be reordered."""

    def reordered(self, theta: Array, order: Sequence[int]) -> Array:
        """Parameters of the components in another order, (size,)."""


@runtime_checkable
class CombinableFamily(Family, Protocol):
    """A family that contains all linear combinations of its components."""

    def combined(self, theta: Array, B: Array) -> Array:
        """Parameters of B xi, (size,), for a matrix B (r, r)."""


@runtime_checkable
class PeriodicFamily(Family, Protocol):
    """A family with angles as components, which jump by full turns."""

    @property
    def periods(self) -> Array:
        """Periods of the components, (r,): 2 pi for angles, 0 for others."""
        ...


@runtime_checkable
class LinearFamily(Family, Protocol):
    """A family linear in its parameters: xi_theta(q) = C psi(q). theta holds the rows of C (r, K), one after the other.

    No basis function is constant, because a constant does not change J_xi. `BasisFamily` builds such a family for any
    basis.
    """

    def basis(self, q: Expression) -> Expression:
        """psi(q), (K, N), for q (n, N); K is the `width` of the family."""


@runtime_checkable
class GradedFamily(LinearFamily, Protocol):
    """A linear family whose basis contains the bases of lower degrees."""

    def embed(self, theta: Array, coarser: Self) -> Array:
        """Convert parameters of a family of lower degree to this family, (size,)."""


@runtime_checkable
class SelfDerivativeFamily(LinearFamily, Protocol):
    """A linear family that contains the derivatives of its functions, so controllers and C need no other basis."""

    def derivative_tables(self, theta: Array) -> Array:
        """C_i with d xi / d q_i = C_i (1, psi), (n, r, 1 + K)."""


@dataclass(frozen=True, eq=False)
class ClosedForm:
    """Parameters of coordinates that need no fit."""

    theta: Array  #: parameters of the family, (size,)
    origin: Array | None = None  #: joint position where xi = 0, (n,). Default: the centre of the domain
    scaled: bool = True  #: whether to scale coordinates to a mean gradient length of 1


@runtime_checkable
class Parametrisation(Protocol):
    """A choice of a family before the joints are known. It holds plain settings only."""

    @property
    def label(self) -> str:
        """Short name, as used on the command line, for example 'polynomial:4'."""

    @property
    def linear(self) -> bool:
        """Whether its families are linear in their parameters, so that `fit` uses Gauss-Newton or QuasiNewton."""

    @property
    def closed_form(self) -> Callable[[Problem], ClosedForm] | None:
        """The function that returns the parameters without a fit; None if they are fitted."""

    def for_problem(self, problem: Problem) -> Parametrisation:
        """The parametrisation for this problem; the same object if it does not depend on the problem."""

    def family(self, space: JointSpace, outputs: int) -> Family:
        """The family on the given joints, with `outputs` components."""


def require_parametrisation(value: object) -> None:
    """Raise InvalidValueError unless the value is a parametrisation."""
    if not isinstance(value, Parametrisation) or isinstance(value, type):
        raise InvalidValueError("parametrisation", repr(value), "an object such as Polynomial(degree=4)")


@runtime_checkable
class GradedParametrisation(Parametrisation, Protocol):
    """A parametrisation with a degree. Families of higher degree contain those of lower degree."""

    @property
    def degree(self) -> int:
        """Total degree."""

    def of_degree(self, degree: int) -> Self:
        """The same parametrisation with another degree."""

    def term_count(self, n: int) -> int:
        """Number of basis functions for n joints, without building them."""

    def family(self, space: JointSpace, outputs: int) -> GradedFamily:
        """The family on the given joints."""


@runtime_checkable
class CyclicParametrisation(Parametrisation, Protocol):
    """A parametrisation in which joints may have only a linear term, so that charts hold at all their positions."""

    @property
    def cyclic(self) -> Sequence[str]:
        """Names of these joints, known after `for_problem`."""


def component_gradients(xi: Expression, q: Expression) -> list[Expression]:
    """dxi_j/dq of every component j by reverse automatic differentiation, r matrices (n, N).

    Args:
        xi: expression (r, N). Its column s depends only on column s of q.
        q: symbols (n, N).
    """
    gradients = []
    for j in range(xi.shape[0]):
        seed = type(q)(*xi.shape)
        seed[j, :] = 1
        gradients.append(ca.jtimes(xi, q, seed, True))
    return gradients


@dataclass(frozen=True, eq=False)
class BasisFamily:
    """xi_theta(q) = C psi(q). theta holds the rows of C (r, K), one after the other.

    Args:
        space: the joints.
        outputs: number r of components.
        functions: psi, a function that maps SX or MX columns q (n, N) to (K, N). No component may be constant.
    """

    space: JointSpace
    outputs: int
    functions: Callable[[Any], Any]
    as_matrices: bool = False

    @cached_property
    def width(self) -> int:
        """Number of basis functions K."""
        psi = self.functions(ca.SX.sym("q", self.space.n))
        require_shape("the basis psi(q)", psi.shape, (None, 1))
        return int(psi.shape[0])

    @property
    def size(self) -> int:
        """Number of coefficients r K."""
        return self.outputs * self.width

    def basis(self, q: Expression) -> Expression:
        """psi(q), (K, N), for q (n, N)."""
        if isinstance(q, ca.SX) and q.shape[1] == 1:
            return self._of_one(q)
        values: Expression = self.functions(q)
        return values

    @cached_property
    def _of_one(self) -> ca.Function:
        """psi for one joint position, built once, because copies are faster than new expressions."""
        q = ca.SX.sym("q", self.space.n)
        return ca.Function("basis", [q], [self.functions(q)])

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi_theta(q), (r, N), for q (n, N)."""
        return ca.reshape(theta, self.width, self.outputs).T @ self.basis(q)

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients of the components, r matrices (n, N)."""
        return component_gradients(self.expression(q, theta), q)

    def initial(self, seed: int) -> Array:
        """Random coefficients, (size,)."""
        return np.random.default_rng(seed).normal(size=self.size)

    def reordered(self, theta: Array, order: Sequence[int]) -> Array:
        """The rows of C in another order, (size,)."""
        return theta.reshape(self.outputs, self.width)[list(order)].ravel()

    def combined(self, theta: Array, B: Array) -> Array:
        """Coefficients of B xi, (size,), for a matrix B (r, r)."""
        return np.asarray((B @ theta.reshape(self.outputs, self.width)).ravel())


Cyclic = tuple[str, ...] | Literal["auto"]  #: names of joints; "auto" for all cyclic joints of the problem
# Words in labels.
_CYCLIC, _WITHOUT = "cyclic", "without"


def check_joint_names(cyclic: Any, without: Any) -> tuple[Cyclic, tuple[str, ...]]:
    """Check names of joints with a linear term (or "auto"), and names of joints that coordinates do not depend on.

    Raises:
        InvalidValueError: if a name appears twice, or one is in both.
    """

    def are_different(names: Any) -> bool:
        return (
            isinstance(names, list | tuple)
            and all(isinstance(name, str) for name in names)
            and len(set(names)) == len(names)
        )

    auto = isinstance(cyclic, str) and cyclic == "auto"
    if not auto and not are_different(cyclic):
        raise InvalidValueError("cyclic", repr(cyclic)[:80], "a list of different joint names, or 'auto'")
    if not are_different(without) or (not auto and set(without) & set(cyclic)):
        raise InvalidValueError("without", repr(without)[:80], "a list of different joint names, none of them cyclic")
    return "auto" if auto else tuple(cyclic), tuple(without)


def suffix(cyclic: Cyclic, without: tuple[str, ...] = ()) -> str:
    """The end of a label: ':cyclic' for "auto", ':cyclic=NAME,NAME', and ':without=NAME,NAME'."""
    linear = "" if not cyclic else f":{_CYCLIC}" if cyclic == "auto" else f":{_CYCLIC}={','.join(cyclic)}"
    return linear + (f":{_WITHOUT}={','.join(without)}" if without else "")


def parse_suffix(text: str, before: str) -> tuple[Cyclic, tuple[str, ...]]:
    """Parse the end of a label: '', 'cyclic' or 'cyclic=NAME,NAME', then 'without=NAME,NAME'.

    Args:
        text: the end of the label.
        before: what else the label may contain before it, for messages.
    """
    cyclic: Cyclic = ()
    without: tuple[str, ...] = ()
    for part in text.split(":") if text else ():
        # Each part is a word, optionally followed by = and names.
        word, equals, names = part.partition("=")
        if word not in (_CYCLIC, _WITHOUT) or (not names if equals else word == _WITHOUT):
            wanted = f"{before}, then 'cyclic' or 'cyclic=JOINT,JOINT', then 'without=JOINT'"
            raise InvalidValueError("parametrisation", repr(text), wanted)
        if word == _CYCLIC:
            cyclic = tuple(names.split(",")) if equals else "auto"
        else:
            without = tuple(names.split(","))
    return cyclic, without


def indices(cyclic: Cyclic, space: JointSpace) -> list[int]:
    """Indices of the cyclic joints of a space, in order.

    Raises:
        InvalidValueError: if a name is not among the joints, or "auto" has not been resolved.
    """
    if cyclic == "auto":
        raise InvalidValueError("cyclic", "'auto'", "joint names, which for_problem(problem) finds")
    for name in cyclic:
        if name not in space.joint_names:
            raise InvalidValueError("cyclic", repr(name), f"one of the joints {', '.join(space.joint_names)}")
    return [k for k, name in enumerate(space.joint_names) if name in cyclic]


@dataclass(frozen=True)
class Registration:
    """A parametrisation for chart files and the command line."""

    kind: type[Parametrisation]
    parse: Callable[[str], Parametrisation] | None  #: parses the text after 'name:' on the command line


_REGISTERED: dict[str, Registration] = {}


def register_parametrisation(
    name: str, kind: type[Parametrisation], parse: Callable[[str], Parametrisation] | None = None
) -> None:
    """Register a parametrisation, so that its charts can be saved and loaded, and the command line accepts it.

    A program that loads such a chart file must register the same name first.

    Args:
        name: unique name. Labels begin with it.
        kind: a dataclass that is built from its fields. They are plain data: numbers, text, or tuples of them.
        parse: converts the text after the colon in 'name:text' to a parametrisation. Without it, the command line does
            not accept the name.

    Raises:
        InvalidValueError: if the name belongs to another class, or the class is not a dataclass.

    Example:
        >>> from dataclasses import dataclass
        >>> import orthocas as oc
        >>> from orthocas import bases
        >>> @dataclass(frozen=True)
        ... class Cubic(oc.Polynomial):
        ...     degree: int = 3
        >>> oc.register_parametrisation("cubic", Cubic, parse=lambda text: Cubic())
        >>> bases.parse_parametrisation("cubic")
        Cubic(degree=3, cyclic=(), joints=None, without=())
    """
    require_kind("name", name, str)
    before = _REGISTERED.get(name)
    if before is not None and before.kind is not kind:
        raise InvalidValueError("name", repr(name), f"another name, because {before.kind.__name__} has this one")
    if not isinstance(kind, type) or not is_dataclass(kind):
        raise InvalidValueError("kind", repr(kind), "a dataclass: chart files store its fields")
    _REGISTERED[name] = Registration(kind, parse)


def parametrisation_names() -> tuple[str, ...]:
    """Names that the command line accepts."""
    return tuple(name for name, each in _REGISTERED.items() if each.parse is not None)


def warn_unless_savable(parametrisation: Parametrisation) -> None:
    """Issue a NotSavableWarning before a fit if its chart cannot be saved."""
    try:
        parametrisation_to_data(parametrisation)
    except InvalidValueError as error:
        warn_caller(f"charts of this fit cannot be saved: {error}", NotSavableWarning)


def parametrisation_to_data(parametrisation: Parametrisation) -> dict[str, Any]:
    """Convert a parametrisation to plain data: kind and settings.

    New settings may have the metadata {"stored": "if given"}. They are left out while they are None or empty, so that
    the fingerprints of older charts stay the same.

    Raises:
        InvalidValueError: if it is not registered, or its settings are not plain data.
    """
    kind = type(parametrisation)
    if kind not in {each.kind for each in _REGISTERED.values()} or not is_dataclass(parametrisation):
        raise InvalidValueError(
            "parametrisation",
            kind.__name__,
            f"a registered class: orthocas.register_parametrisation('...', {kind.__name__})",
        )
    # A setting that is itself a parametrisation is converted too.
    parts = {part.name: getattr(parametrisation, part.name) for part in fields(parametrisation)}
    inner = {name: parametrisation_to_data(part) for name, part in parts.items() if isinstance(part, Parametrisation)}
    settings = {**asdict(parametrisation), **inner}
    for part in fields(parametrisation):
        if part.metadata.get("stored") == "if given" and parts[part.name] in (None, ()):
            del settings[part.name]
    try:
        json.dumps(settings)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"settings of {kind.__name__}", f"not plain data ({error})", "plain data") from None
    return {"parametrisation": kind.__name__, "settings": settings}


def parametrisation_from_data(data: Mapping[str, Any]) -> Parametrisation:
    """Rebuild a parametrisation from the result of `parametrisation_to_data`.

    Raises:
        UnknownNameError: if no such parametrisation is registered.
    """
    require_kind("data of a parametrisation", data, Mapping)
    kinds = {each.kind.__name__: each.kind for each in _REGISTERED.values()}
    name: str = data.get("parametrisation", "")
    settings: Any = data.get("settings")
    require_known("parametrisation", name, kinds)
    kind = kinds[name]
    require_kind("settings", settings, dict)
    names = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    # A setting may itself be a parametrisation.
    inner = {name: part for name, part in settings.items() if isinstance(part, dict) and "parametrisation" in part}
    settings = settings | {name: parametrisation_from_data(part) for name, part in inner.items()}
    if not settings.keys() <= names:
        raise InvalidValueError(f"settings of {kind.__name__}", sorted(settings), f"only names among {sorted(names)}")
    return kind(**settings)


def parse_parametrisation(label: str) -> Parametrisation:
    """Parse a label such as 'polynomial:4:joints=2', 'fourier:2:cyclic', 'mlp:64x64:raw', 'circle:mlp:32x32', 'linear'.

    Raises:
        UnknownNameError: if no parametrisation of this name is registered.
        InvalidValueError: if the text after the colon is invalid.
    """
    require_kind("parametrisation", label, str)
    name, _, text = label.partition(":")
    require_known("parametrisation", name, parametrisation_names())
    parse = _REGISTERED[name].parse
    assert parse is not None
    return parse(text)
