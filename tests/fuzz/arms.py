"""Campaign of arm files: what is loaded knows the postures of a pose, or the error names the file."""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from public_objects import arm

import orthocas as oc
from fuzz.child import Finding, run
from fuzz.mutants import Rng, pick
from fuzz.sealed_files import bomb, judged, mutant
from orthocas.errors import OrthocasError


def arms(count: int) -> list[Finding]:
    """Judge so many mutants."""
    with TemporaryDirectory() as folder:
        original = Path(folder) / "good"
        arm().save(original)
        return run("arms", partial(judge, original), range(count))


def judge(original: Path, seed: int) -> str | None:
    """What is wrong with the treatment of a mutant."""
    return judged(partial(_mutant, original), use, seed)


def use(path: Path) -> None:
    """Load an arm, and ask its charts."""
    loaded = oc.Arm.load(path)
    assert len(f"{loaded!r} {loaded.facts()}") < 10**5
    try:
        q = loaded.charts[0].problem.domain.centre
        assert np.isfinite(loaded.x(q)).all()
        assert len(loaded.find_branches(q[None])) == 1
    except OrthocasError as error:  # no file is to blame
        raise OrthocasError(f"mutant: {error}") from None


def _mutant(original: Path, rng: Rng) -> bytes:
    if rng.integers(50) == 0:
        return bomb(original, bool(rng.integers(2)), int(pick(rng, (2**22, 2**28))))
    return mutant(original, rng)
