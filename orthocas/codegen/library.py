"""Generated C as a compiled library called from Python: functions, supervised law, and timing of ticks."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.codegen.generate import GeneratedC, generate_c
from orthocas.codegen.rendering import DOUBLE, SINGLE, Precision, get_source
from orthocas.control.controller import Controller, ControlStatus, require_controller
from orthocas.control.memory import find_memory
from orthocas.control.operational_space import PDPlus
from orthocas.control.safety import Safety
from orthocas.native.libraries import find_compilers, pointer
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_float_array, as_number, as_point, require_kind, require_shape
from orthocas.tools.files import open_draft_folder
from orthocas.tools.interrupts import deferred
from orthocas.tools.processes import run_program

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
NO_DOUBLE = ("-Wdouble-promotion", "-Wfloat-conversion")  #: compiler flags for code in single precision
# As in runtime/ticks.c.
_STATES = 64
# Duration of one measurement.
_MICROSECONDS = 3e5


def compile_shared(
    generated: GeneratedC, folder: Path, flags: tuple[str, ...] = ("-O2",), compiler: str | None = None
) -> Path:
    """Compile a shared library with warnings as errors; the default compiler is the first of `find_compilers`.

    Raises:
        CompileError: if compilation fails. The message starts with the compiler's first lines.
    """
    library = folder / f"lib{generated.name}.so"
    sources = [generated.folder / f"{generated.name}{end}.c" for end in ("", "_distance")]
    compiler = find_compilers()[0] if compiler is None else compiler
    warnings = (*STRICT, *(NO_DOUBLE if generated.single_precision else ()))
    command = [
        compiler,
        *warnings,
        *flags,
        "-fPIC",
        "-shared",
        "-o",
        str(library),
        *(str(path) for path in sources if path.exists()),
        "-lm",
    ]
    run_program(command)
    return library


@dataclass(frozen=True, eq=False)
class CompiledLibrary:
    """The functions of a compiled library for NumPy arrays and matrices (n, n)."""

    path: Path
    name: str
    n: int
    single_precision: bool = False

    @property
    def precision(self) -> Precision:
        """The number type of the library."""
        return SINGLE if self.single_precision else DOUBLE

    def chart(self, q: Array) -> tuple[Array, Array, int]:
        """phi (n,), J (n, n), status."""
        phi, J = self._zeros(self.n), self._zeros(self.n, self.n)
        return phi, J, self._call("chart", [q], [phi, J])

    def check(self) -> float:
        """Largest relative difference between results of the library and the numbers stored when it was generated."""
        run = self.function("check")
        run.restype = self.precision.c_type
        return float(run())

    def curvature(self, q: Array, dq: Array, v: Array) -> tuple[Array, int]:
        """dJ/dt v (n,), status."""
        curvature = self._zeros(self.n)
        return curvature, self._call("chart_curvature", [q, dq, v], [curvature])

    def inverse(self, phi: Array, q_start: Array, *, max_iterations: int = 100) -> tuple[Array, int]:
        """q (n,), status; at most `max_iterations` evaluations of phi."""
        q = self._zeros(self.n)
        return q, self._call("inverse", [phi, q_start], [q], int(max_iterations))

    def nearest(self, phi: Array, q_start: Array, largest_step: float) -> tuple[Array, int]:
        """q (n,), status."""
        q = self._zeros(self.n)
        return q, self._call("nearest", [phi, q_start], [q], self.precision.c_type(largest_step))

    def dynamics(self, q: Array, dq: Array) -> tuple[Array, Array, Array, int]:
        """M (n, n), bias (n,), gravity (n,), status."""
        M, bias, gravity = self._zeros(self.n, self.n), self._zeros(self.n), self._zeros(self.n)
        return M, bias, gravity, self._call("dynamics", [q, dq], [M, bias, gravity])

    def link_positions(self, motor_q: Array, stiffness: Array, torque: Array | None = None) -> tuple[Array, int]:
        """q (n,) with stiffness (motor_q - q) = torque, and the status; default torque: gravity at q."""
        q, arrays = self._zeros(self.n), [motor_q, stiffness, *([] if torque is None else [torque])]
        for array in arrays:
            require_shape("an argument of link_positions", np.shape(array), (self.n,))
        places = [None if array is None else self.numbers(array) for array in (motor_q, stiffness, torque)]
        run = self.function("link_positions")
        run.argtypes = [ctypes.c_void_p] * 4
        return q, int(run(*(None if place is None else pointer(place) for place in places), pointer(q)))

    def control(self, q: Array, dq: Array, reference: Array, gains: Array) -> tuple[Array, int]:
        """Command (n,), status. Reference (3 k,) and gains hold the numbers of the C structs in order."""
        command = self._zeros(self.n)
        return command, self._call("control", [q, dq, reference, gains], [command])

    def spline(self, start: Array, target: Array, duration: float, time: float, last: Array | None = None) -> Array:
        """The reference (3 k,) at a time on the spline from a reference to rest at a target (k,).

        If that is not finite, C returns the value of the last reference (default 0), at rest.
        """
        run, number = self.function("reference_spline"), self.precision.c_type
        run.argtypes, run.restype = [*[ctypes.c_void_p] * 2, number, number, ctypes.c_void_p], ctypes.c_int
        reference = self._zeros(3 * len(target)) if last is None else self.numbers(last).copy()
        ends = [self.numbers(end) for end in (start, target)]
        run(*(end.ctypes.data for end in ends), duration, time, reference.ctypes.data)
        return reference

    @property
    def domain(self) -> tuple[Array, Array]:
        """Lower and upper bounds, (n,) each."""
        lower, upper = (self._table(f"domain_{side}", self.n) for side in ("lower", "upper"))
        return lower, upper

    def default_gains(self, count: int) -> Array:
        """The gains that the library was generated with, (count,)."""
        return self._table("default_gains", count)

    def function(self, name: str) -> Any:
        """A function of the library, by its name without the prefix."""
        return getattr(self._c, f"{self.name}_{name}")

    def address(self, name: str) -> Any:
        """Pointer to a constant of the library, by its name without the prefix."""
        return ctypes.addressof(ctypes.c_char.in_dll(self._c, f"{self.name}_{name}"))

    def _table(self, name: str, count: int) -> Array:
        return np.array((self.precision.c_type * count).in_dll(self._c, f"{self.name}_{name}"), dtype=float)

    def numbers(self, values: ArrayLike) -> Array:
        """Values as a C array of the library's number type."""
        array = np.asarray(values)
        if array.dtype == self.precision.scalar:
            return np.ascontiguousarray(array)
        with np.errstate(over="ignore"):
            return np.ascontiguousarray(array, dtype=self.precision.scalar)

    def _zeros(self, *shape: int) -> Array:
        return np.zeros(shape, dtype=self.precision.scalar)

    @cached_property
    def _c(self) -> ctypes.CDLL:
        return ctypes.CDLL(str(self.path))

    def _call(self, function: str, inputs: list[Array], outputs: list[Array], *numbers: Any) -> int:
        """Call a function with input arrays, then numbers, then output arrays; returns its status."""
        arrays = [self.numbers(array) for array in inputs]
        # C would read beyond the end of a short array. The first two arrays have one number per joint.
        for array in arrays[:2]:
            require_shape(f"an argument of {function}", array.shape[:1], (self.n,))
        places, results = ([array.ctypes.data_as(ctypes.c_void_p) for array in some] for some in (arrays, outputs))
        return int(self.function(function)(*places, *numbers, *results))


def gain_numbers(controller: Controller) -> Array:
    """The gains of a controller in the order of the C struct."""
    return np.concatenate(list(controller.gains.values()))


class Supervisor:
    """One supervised law: its state in C, and the functions that change it.

    Args:
        library: a compiled library with this controller.
        controller: the law.
        safety: settings that replace those of the library.
    """

    def __init__(self, library: CompiledLibrary, controller: Controller, safety: Safety | None = None) -> None:
        require_kind("library", library, CompiledLibrary)
        require_controller(controller)
        self._n, self._k, self.library = library.n, len(controller.labels), library
        # Functions of the supervised law. Functions with number arguments declare their types.
        self._functions = {
            name: library.function(name)
            for name in ("check_start", "start", "take_over", "resume", "hold", "release", "step")
        }
        self._functions["check_start"].argtypes = [ctypes.c_void_p] * 5
        self._functions["step"].argtypes = [*[ctypes.c_void_p] * 6, library.precision.c_type, ctypes.c_void_p]
        stream, pace = (library.function(f"reference_{name}") for name in ("stream", "pace"))
        stream.argtypes = [*[ctypes.c_void_p] * 3, *[library.precision.c_type] * 2]
        pace.argtypes, pace.restype = (
            [ctypes.c_void_p, ctypes.c_void_p, library.precision.c_type],
            library.precision.c_type,
        )
        self._functions |= {"stream": stream, "pace": pace}
        if safety is not None:
            require_kind("safety", safety, Safety)
        # Settings as a struct: the given ones, or those of the library.
        values = (safety or Safety.of(controller)).in_c(controller.command)
        number = library.precision.c_type
        kinds = {name: ctypes.c_int if isinstance(value, int) else number for name, value in values.items()}
        arrays = {name: number * value.size for name, value in values.items() if isinstance(value, np.ndarray)}
        settings = _build_struct("Safety", kinds | arrays)
        self._safety: Any = library.address("default_safety")
        if safety is not None:
            struct = settings(*(tuple(value) if isinstance(value, np.ndarray) else value for value in values.values()))
            self._safety = ctypes.pointer(struct)
        # The state, including the memory of the law.
        memory = find_memory(controller)
        fields = {} if memory is None else {name: number * len(value) for name, value in memory.start.items()}
        self._state = _build_state(self._n, self._k, number, settings, _build_struct("Memory", fields))()
        self._command = library.numbers(np.zeros(self._n))
        self.gains = gain_numbers(controller)  #: the gains in the order of the C struct

    def check_start(self, q: ArrayLike, torque: ArrayLike) -> tuple[Array, ControlStatus]:
        """Compare the torque that holds the arm with the model's, before `start`: torque - model (n,), status.

        Nothing moves, and no state changes. The model's torque is the law's fallback at `gains`: gravity with their
        payload, but without their limit; for velocity laws, gravity. The status is LOAD_MISMATCH if a joint differs by
        more than `Safety.start_mismatch`, so that the mounting or the tool must be different. It is NOT_FINITE, with
        zeros, if an input is not finite.

        Args:
            q: joint positions (n,).
            torque: measured or commanded torque (n,), in the convention of the command: without what the robot adds
                itself.
        """
        mismatch = self.library.numbers(np.zeros(self._n))
        inputs = [self._numbers(name, value, self._n) for name, value in (("q", q), ("torque", torque))]
        inputs += [self.library.numbers(self.gains), mismatch]
        status = self._functions["check_start"](self._safety, *map(pointer, inputs))
        return mismatch, ControlStatus(status)

    def start(self, q: ArrayLike, command: ArrayLike | None = None) -> None:
        """Start at joint positions (n,), with the command (n,) that the robot executes now; default: the fallback."""
        self._begin("start", q, command)

    def take_over(self, q: ArrayLike, command: ArrayLike) -> None:
        """Take over from another controller while the arm moves."""
        points = self._point("q", q), self._point("command", command)
        self._functions["take_over"](self._here, *map(pointer, points))

    def resume(self) -> None:
        """Request the law again."""
        self._functions["resume"](self._here)

    def hold(self, q: ArrayLike, command: ArrayLike | None = None) -> None:
        """Report that brakes hold the arm at joint positions (n,), with a command (n,) (default: the last one)."""
        self._begin("hold", q, command)

    def release(self, q: ArrayLike, command: ArrayLike | None = None) -> None:
        """Report that the brakes open. The catcher holds the arm until `resume`."""
        self._begin("release", q, command)

    def step(self, q: Array, dq: Array, reference: Array, period: float = 1e-3) -> tuple[Array, ControlStatus]:
        """Command (n,) and status of one control period.

        Args:
            q: joint positions (n,).
            dq: joint velocities (n,).
            reference: [value, velocity, acceleration], (3 k,).
            period: time since the previous call [s].
        """
        inputs = [self._numbers(name, value, self._n) for name, value in (("q", q), ("dq", dq))]
        inputs += [self._reference(reference), self.library.numbers(self.gains)]
        time, command = as_number("period", period), pointer(self._command)
        status = self._functions["step"](self._here, self._safety, *map(pointer, inputs), time, command)
        return self._command.copy(), ControlStatus(status)

    def stream(self, reference: Array, target: ArrayLike, omega: float, period: float = 1e-3) -> ControlStatus:
        """Move a reference by one tick towards a target (k,), with poles at omega [1/s]; returns the status.

        The status is OK, NEAR_BOUNDARY if the target is beyond the boundary, so that the stream stops before it, or
        NOT_FINITE.
        """
        numbers = self._reference(reference)
        goal = self._numbers("target", target, self._k)
        speed = as_number("omega", omega)
        time = as_number("period", period)
        status = self._functions["stream"](self._here, pointer(numbers), pointer(goal), speed, time)
        reference[:] = numbers
        return ControlStatus(status)

    def pace(self, reference: Array, period: float = 1e-3) -> float:
        """Limit the derivatives of a reference to what joints can follow; returns the speed of its time, 0 to 1."""
        numbers = self._reference(reference)
        pace = float(self._functions["pace"](self._here, pointer(numbers), as_number("period", period)))
        reference[:] = numbers
        return pace

    def __getattr__(self, name: str) -> Any:
        """Fields of the C state: mode, cause, weight, anchor, ...; `memory` is a dictionary of arrays."""
        if name.startswith("_"):
            raise AttributeError(name)
        value = getattr(self._state, name)
        if name == "memory":
            return {field[0]: np.array(getattr(value, field[0])) for field in value._fields_}
        return np.array(value) if isinstance(value, ctypes.Array) else value

    def _reference(self, reference: Array) -> Array:
        return self._numbers("reference", reference, 3 * self._k)

    def _begin(self, name: str, q: ArrayLike, command: ArrayLike | None) -> None:
        point, given = self._point("q", q), None if command is None else self._point("command", command)
        self._functions[name](self._here, pointer(point), None if given is None else pointer(given))

    def _numbers(self, name: str, values: ArrayLike, size: int) -> Array:
        """Numbers of the library's type; they may be NaN or infinite."""
        array = as_float_array(name, values)
        # C would read beyond the end of a short array.
        require_shape(name, array.shape, (size,))
        return self.library.numbers(array)

    def _point(self, name: str, values: ArrayLike) -> Array:
        return self.library.numbers(as_point(name, values, self._n))

    @property
    def _here(self) -> Any:
        return ctypes.byref(self._state)


def _build_state(
    n: int, k: int, number: Any, settings: type[ctypes.Structure], memory: type[ctypes.Structure]
) -> type[ctypes.Structure]:
    """The struct `NAME_state` of templates/robot.h.jinja."""
    # Fields in the order of the header; torque laws have a spring, a load and an observer.
    joints, quantities = number * n, number * k
    has_spring = any(field[0] == "brake_stiffness" for field in settings._fields_)
    counts = ("mode", "cause", "asked", "bad_ticks", "fresh", "stale_ticks", "same_ticks")
    names = ("q", "dq", "seen_q", "seen_dq", "command", "led", "impulse", "impulse_from", "law", "anchor", "safe")
    layout: dict[str, Any] = dict.fromkeys(counts, ctypes.c_int)
    layout |= dict.fromkeys(("weight", "brake", "unseen", "hasty", "energy"), number)
    layout |= dict.fromkeys(names, joints) | dict.fromkeys(("offset", "integral"), quantities)
    if has_spring:
        layout |= dict.fromkeys(("load", "drive", "speed"), joints) | {"inertia": number * n**2}
        layout |= dict.fromkeys(("expected", "unexplained", "momentum", "trend", "touch", "carried"), joints)
        layout |= dict.fromkeys(("apart", "gone", "same_q", "same_dq"), joints)
    # The memory of a law precedes the last reference.
    if memory._fields_:
        layout["memory"] = memory
    layout |= dict.fromkeys(("value", "velocity", "acceleration"), quantities)
    return _build_struct("State", layout | {"safety": settings, "limit": joints})


def _build_struct(name: str, layout: dict[str, Any]) -> type[ctypes.Structure]:
    """A C struct with these fields, in order."""
    return type(name, (ctypes.Structure,), {"_fields_": list(layout.items())})


@dataclass(frozen=True)
class Ticks:
    """Computing times of one controller [us]."""

    median: float
    p99: float
    worst: float  #: worst time, with interrupts and other activity of the machine
    slowest_state: float  #: best time of the slowest of 64 states, without other activity of the machine


def control_tick(chart: Chart) -> float:
    """Time of one call of decoupled PD+ on a chart in generated C [us]: the best time of the slowest of 64 states.

    Raises:
        CompileError: if there is no C compiler.
    """
    with open_draft_folder() as folder:
        # CasADi may lose Ctrl-C while it builds functions.
        with deferred():
            law = PDPlus(chart, 50.0, coupling="decoupled")
            generated = generate_c(chart, folder, law, "tick")
        library = CompiledLibrary(compile_shared(generated, folder), "tick", chart.n)
        about = time_ticks([(law, library)], 200)[0].median
        calls = int(np.clip(_MICROSECONDS / about, 1_000, 100_000))
        return time_ticks([(law, library)], calls)[0].slowest_state


def time_ticks(cases: Sequence[tuple[Controller, CompiledLibrary]], calls: int = 100_000) -> list[Ticks]:
    """Time compiled controllers of one robot and number type, with their own gains, on 64 states inside the domain.

    Raises:
        CompileError: if there is no C compiler, or the timing program cannot be built or run.
    """
    first = cases[0][1]
    with open_draft_folder() as folder:
        data, program = folder / "states", folder / "ticks"
        # For each law: its states, then its gains.
        parts = [part.ravel() for law, _ in cases for part in (_sample_states(law), gain_numbers(law))]
        first.numbers(np.concatenate(parts)).tofile(data)
        (folder / "ticks.c").write_text(get_source("ticks.c"))
        number = f"-DNUMBER={first.precision.c_name}"
        run_program([find_compilers()[0], "-O2", number, str(folder / "ticks.c"), "-o", str(program), "-ldl"])
        arguments = [str(program), str(data), str(calls), str(cases[0][0].problem.n)]
        for law, library in cases:
            sizes = (3 * len(law.labels), len(gain_numbers(law)))
            arguments += [str(library.path), f"{library.name}_control", *map(str, sizes)]
        lines = run_program(arguments).splitlines()
    return [Ticks(*map(float, line.split())) for line in lines]


def _sample_states(law: Controller) -> Array:
    """States inside the domain with references nearby, (64, 2 n + 3 k)."""
    rng, domain, n, k = np.random.default_rng(0), law.problem.domain, law.problem.n, len(law.labels)
    # A position near the centre of the box may violate a condition of the domain; the home never does.
    q = domain.centre + 0.4 * domain.half_width * rng.uniform(-1, 1, (_STATES, n))
    q[~domain.contains(q)] = domain.home
    reference = np.array([law.measured(point).full().ravel() for point in q]) + 0.01 * rng.normal(size=(_STATES, k))
    return np.hstack([q, rng.normal(size=(_STATES, n)), reference, rng.normal(size=(_STATES, 2 * k))])
