"""Campaign of checkpoints: a fit resumes from what it finds and ends with numbers, or says what is wrong."""

from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import orthocas as oc
from fuzz.child import Finding, run
from fuzz.mutants import Rng, pick
from fuzz.sealed_files import bomb, judged, mutant
from orthocas import solvers
from orthocas.errors import CheckpointError, OrthocasError
from orthocas.fitting import checkpoint
from orthocas.tools.progress import Progress


class KilledError(Exception):
    """The end of a fit that leaves a checkpoint."""


@cache
def problem() -> oc.Problem:
    """A small one."""
    return oc.problems.get("planar_3r_x")


FITS: dict[str, dict[str, Any]] = {
    "gauss_newton": {"parametrisation": oc.Polynomial(3), "samples": 60},
    "adam": {"parametrisation": oc.MLP((3,)), "solver": solvers.Adam(epochs=6, steps=2), "samples": 60},
    "lbfgs": {"parametrisation": oc.MLP((3,)), "solver": solvers.LBFGS(max_iterations=20), "samples": 60},
    "quasi_newton": {"parametrisation": oc.Polynomial(2), "solver": solvers.QuasiNewton(20), "samples": 60},
    "flow": {"parametrisation": oc.Polynomial(1), "solver": solvers.GradientFlow(max_iterations=5), "samples": 60},
}


def write_originals(folder: Path) -> None:
    """A finished fit and a killed one of each solver."""
    for name, settings in FITS.items():
        oc.fit(problem(), **settings, checkpoint=folder / f"{name}.done")
        with suppress(KilledError):
            oc.fit(problem(), **settings, checkpoint=folder / f"{name}.killed", monitor=_kill_late)


def _kill_late(progress: Progress) -> None:
    checkpoint._SECONDS = 0.0  # keep every state
    if progress.fraction > 0.3:
        raise KilledError


def checkpoints(count: int) -> list[Finding]:
    """Judge so many mutants."""
    with TemporaryDirectory() as folder:
        write_originals(Path(folder))
        return run("checkpoints", partial(judge, Path(folder)), range(count))


def judge(originals: Path, seed: int) -> str | None:
    """What is wrong with the treatment of a mutant."""
    original = pick(np.random.default_rng(seed), sorted(originals.iterdir()))
    return judged(partial(_mutant, original), partial(use, original.stem), seed)


def use(name: str, path: Path) -> None:
    """Resume the fit; a file that is refused stays as it is."""
    before = path.read_bytes()
    try:
        found = oc.fit(problem(), **FITS[name], checkpoint=path)
    except CheckpointError:
        assert path.read_bytes() == before, "a refused checkpoint is changed"
        raise
    except OrthocasError as error:  # where the numbers in the file lead to
        raise OrthocasError(f"mutant: {error}") from None
    assert np.isfinite(found.chart.phi(problem().domain.centre)).all()
    assert np.isfinite(found.chart.jacobian(problem().domain.centre)).all()
    assert len(repr(found.facts())) < 10**5
    assert len(found.stages[-1].result.theta) == found.chart.coordinates.size


def _mutant(original: Path, rng: Rng) -> bytes:
    if rng.integers(100) == 0:
        return bomb(original, bool(rng.integers(2)), int(pick(rng, (2**22, 2**28))))
    return mutant(original, rng)
