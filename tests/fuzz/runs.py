"""Campaign of trajectory files: what is loaded can be shown and drawn, or the error names the file."""

import json
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import public_objects

from fuzz.child import Finding, run
from fuzz.mutants import Rng, changed_data, entries_of, flipped, npy, packed, pick, with_tricks
from fuzz.sealed_files import bomb, changed_arrays, judged
from orthocas.control import Kinematic
from orthocas.simulation import Trajectory, simulate
from orthocas.viewer.motion import read_run


def write_originals(folder: Path) -> None:
    """Runs of a torque and of a velocity controller."""
    public_objects.trajectory().save(folder / "torque")
    law = Kinematic(public_objects.fitted().chart, 1.0)
    simulate(law, public_objects.steps(), public_objects.planar().domain.centre, step=0.1).save(folder / "velocity")


def runs(count: int) -> list[Finding]:
    """Judge so many mutants."""
    with TemporaryDirectory() as folder:
        write_originals(Path(folder))
        return run("runs", partial(judge, Path(folder)), range(count))


def judge(originals: Path, seed: int) -> str | None:
    """What is wrong with the treatment of a mutant."""
    return judged(partial(_mutant, originals), use, seed)


def use(path: Path) -> None:
    """Load a run and ask it all it tells, and show it as a motion."""
    motion = read_run(path, public_objects.planar().robot)
    assert motion.q.shape == (len(motion.times), 3)
    trajectory = Trajectory.load(path)
    with np.errstate(all="ignore"):  # huge numbers are numbers
        N, k = len(trajectory.times), len(trajectory.labels)
        assert len(f"{trajectory!r} {trajectory.facts()}") < 10**5
        assert trajectory.tracking_error.shape == (k,)
        assert trajectory.energy_balance.shape == (N,)
        assert isinstance(trajectory.storage_rise, float)
    assert trajectory.command.shape == trajectory.dq.shape == trajectory.q.shape
    assert trajectory.reference_velocity.shape == trajectory.reference_acceleration.shape == (N, k)
    assert trajectory.status.dtype.kind in "iu"


@cache
def _files(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def _mutant(originals: Path, rng: Rng) -> bytes:
    original = pick(rng, _files(originals))
    entries, act = dict(entries_of(original)), rng.integers(100)
    if act == 0:
        return bomb(original, bool(rng.integers(2)), int(pick(rng, (2**22, 2**28))))
    if act < 40:
        header = json.loads(str(np.load(original)["header"]))
        for _ in range(int(rng.integers(1, 3))):
            header = changed_data(rng, header)
        text = json.dumps(header, ensure_ascii=bool(rng.integers(2)))
        return packed({**entries, "header.npy": npy(np.array(text if text.isascii() else ascii(text)))})
    if act < 85:
        for _ in range(int(rng.integers(1, 3))):
            entries = changed_arrays(rng, entries) if rng.integers(10) else entries
        return packed(entries)
    if act < 90:
        name = pick(rng, list(entries))
        return packed({**entries, name: flipped(rng, entries[name])})
    return with_tricks(rng, entries)
