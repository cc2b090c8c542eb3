"""Campaign of ticks in generated C: a law and its inverse, a supervised law and an atlas get hostile numbers."""

import subprocess
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from programs import built
from public_objects import IN_ATLAS, atlas, fitted

import orthocas as oc
from fuzz.child import Finding
from orthocas.codegen import GeneratedC
from orthocas.control import PDPlus

_LIMIT = 150.0  # of all torques [N m]: more than gravity takes


def _law(folder: Path) -> GeneratedC:
    law = PDPlus.on_chart(fitted().chart, limit=_LIMIT)
    return oc.generate_c(law.chart, folder, law, "arm")


def _law_of_atlas(folder: Path) -> GeneratedC:
    return oc.generate_c(atlas(), folder, PDPlus.on_chart(atlas().chart(0), limit=_LIMIT), "arm")


PROGRAMS: tuple[
    tuple[str, Callable[[Path], GeneratedC], str], ...
] = (  #: all of them say what they met, or exit with > 0
    ("a law and its inverse", _law, "random_ticks.c"),
    ("a supervised law", _law, "supervised_ticks.c"),
    ("an atlas", lambda folder: oc.generate_c(atlas(), folder, name="arm"), "atlas_calls.c"),
    ("a supervised law on an atlas", _law_of_atlas, "supervised_ticks.c"),
)


def ticks(count: int) -> list[Finding]:
    """Run so many ticks, a fourth of them in each program."""
    found, each = [], max(1, count // len(PROGRAMS))
    middle = ",".join(map(str, IN_ATLAS))
    flags = (f"-DTICKS={each}L", f"-DCALLS={each}L", f"-DLIMIT={_LIMIT}", "-DSINGULAR=0,0,0", f"-DMIDDLE={middle}")
    for seed, (name, make, program) in enumerate(PROGRAMS):
        with TemporaryDirectory() as folder:
            compiled = built(make(Path(folder)), program, Path(folder), "-O2", *flags)
            done = subprocess.run([str(compiled)], capture_output=True, text=True, check=False)
        if done.returncode:
            found.append(Finding("ticks", seed, f"{name}: exit code {done.returncode} {done.stderr[:200]}"))
    return found
