"""Campaign of steps files: what is read is a reference that can be sampled, or the error names the place."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import public_objects

from fuzz.child import Finding, run
from fuzz.mutants import NUMBERS, OTHERS, TEXTS, Rng, changed_data, flipped, pick
from fuzz.sealed_files import judged
from orthocas.simulation.disturbances import Loads, read_steps

ONE_STEP = {"time": 0.5, "move": {"x": 0.1}}
ORIGINALS: tuple[dict[str, Any], ...] = (
    {"duration": 4, "steps": [ONE_STEP, {"time": 1, "to": {"xi1": 0.2}, "move": {"x": 0.05}}]},
    {"points": [{"time": 1, "move": {"x": 0.1}}, {"time": 2}, {"time": 4, "to": {"xi2": 0.02}}]},
    {
        "duration": 3,
        "steps": [ONE_STEP],
        "start": [0.5, 0.7, 0.9],
        "natural_frequency": 3,
        "damping_ratio": 0,
        "pushes": [
            {"start": 1, "duration": 0.2, "force": [10, 0, -1]},
            {"start": 2, "duration": 1, "torque": [1, 2, 3]},
            {"start": 1, "duration": 0.5, "force": [0, 5, 0], "link": "q2", "point": [0.5, 0, 0]},
            {"start": 1, "duration": 0.5, "force": [0, 5, 0], "link": 1},
        ],
    },
)


def steps(count: int) -> list[Finding]:
    """Judge so many mutants."""
    return run("steps", judge, range(count))


def judge(seed: int) -> str | None:
    """What is wrong with the treatment of a mutant."""
    return judged(_mutant, use, seed)


def use(path: Path) -> None:
    """Read a plan and sample it."""
    plan = read_steps(path, public_objects.linear())
    duration = plan.reference.duration
    for values in plan.reference.sample(np.linspace(0, duration, 50)):
        assert values.shape == (50, 3)
        assert np.isfinite(values).all(), "the reference is not finite"
    assert len(plan.reference.grid()) < 10**7
    for push in plan.pushes:
        assert Loads(public_objects.linear().problem.robot.tree, [push]).size == 6
        assert push.start < duration


def _mutant(rng: Rng) -> bytes:
    data: Any = pick(rng, ORIGINALS)
    act = rng.integers(20)
    for _ in range(int(rng.integers(1, 4))):
        data = changed_data(rng, data)
    if act < 13:
        return json.dumps(data).encode()
    if act == 13:
        return _with_extremes(rng, pick(rng, ORIGINALS))
    text = json.dumps(pick(rng, ORIGINALS)).encode()
    odd = (
        flipped(rng, text),
        text[: int(rng.integers(len(text)))],
        b"\xef\xbb\xbf" + text,
        text.decode().encode("utf-16"),
        text.replace(b'"time"', b'"time": 1, "time"', 1),
        b"[" * int(pick(rng, (10, 900, 10**5))),
        b'{"points":' * int(pick(rng, (10, 900, 10**5))),
        text.replace(b"0.1", pick(rng, (b"1e999", b"-Infinity", b"NaN", b"0x1", b"1" * 5000, b"1e-999", b"01"))),
        b'{"duration": 1, "steps": [' + b",".join([b'{"time": 0.1, "move": {"x": 1e-9}}'] * 20000) + b"]}",
        b"{" + b",".join(b'"k%d": 1' % k for k in range(10**5)) + b', "k99999": 2}',
        b" " * 2**24,
        pick(rng, (b"", b"\0", b"null", b'"', b"{}", b"[]", b"1e5", bytes(10**5))),
    )
    return bytes(odd[int(rng.integers(len(odd)))])


def _with_extremes(rng: Rng, data: Any) -> bytes:
    """All numbers at the edge of what is allowed."""
    edges = (1e-3, 1e6, 999999.0, 0.0011, 1e-300)
    text = {
        **data,
        "duration": pick(rng, edges),
        "natural_frequency": pick(rng, edges),
        "damping_ratio": pick(rng, edges),
    }
    text = text if "steps" in data else {"points": [{"time": pick(rng, edges), "move": {"x": pick(rng, (1e6, -1e6))}}]}
    text |= {} if rng.integers(3) else {pick(rng, TEXTS): pick(rng, NUMBERS + OTHERS)}
    return json.dumps(text).encode()
