"""Values that an object builds on first use: once for all threads, and never pickled or copied with the object.

CasADi functions with Python nodes, buffers, and compiled libraries can neither be pickled nor copied. They follow from
the object's data, so a copy builds its own on first use.
"""

from collections.abc import Callable, Hashable
from threading import RLock
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar, overload

__all__ = ["BuiltOnUse", "building", "cached_property"]

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)

_PLACE = "_built"
building = RLock()
"""Held while CasADi functions are built: CVODES integrators crash if another thread builds at the same time.

One lock for all, because values are built from other cached values, in any order. Nothing may be evaluated in threads
under it.
"""


class _Store(dict[str, Any]):
    """The cached values of one object. It is pickled and deep-copied as an empty store."""

    def __reduce__(self) -> tuple[type["_Store"], tuple[()]]:
        return _Store, ()


class _CachedProperty(Generic[T]):
    """Like `functools.cached_property`, but thread-safe in every version of Python, and never pickled or copied."""

    def __init__(self, build: Callable[[Any], T]) -> None:
        self._build, self._name = build, build.__name__
        self.__doc__ = build.__doc__

    @overload
    def __get__(self, instance: None, owner: type) -> Self: ...

    @overload
    def __get__(self, instance: object, owner: type | None = None) -> T: ...

    def __get__(self, instance: object | None, owner: type | None = None) -> Self | T:
        if instance is None:
            return self
        store = instance.__dict__.get(_PLACE)
        if store is None or self._name not in store:
            # The first thread builds the value while the others wait.
            with building:
                store = instance.__dict__.setdefault(_PLACE, _Store())
                if self._name not in store:
                    store[self._name] = self._build(instance)
        value: T = store[self._name]
        return value


if TYPE_CHECKING:
    # Type checkers see a property, also in protocols.
    from builtins import property as cached_property
else:
    cached_property = _CachedProperty


class BuiltOnUse(Generic[K, T]):
    """Values by name, each built on first use, once for all threads. Hold it in a `cached_property`."""

    def __init__(self, build: Callable[[K], T]) -> None:
        self._build = build
        self._values: dict[K, T] = {}

    def __getitem__(self, name: K) -> T:
        if name not in self._values:
            with building:
                if name not in self._values:
                    self._values[name] = self._build(name)
        return self._values[name]
