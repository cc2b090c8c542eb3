"""Campaign of ticks in generated C: laws on a box, a corridor and an atlas, supervised or not, get hostile numbers."""

import subprocess
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

from charts import in_a_corridor
from programs import built, path_flags
from public_objects import IN_ATLAS, atlas, fitted

import orthocas as oc
from fuzz.child import Finding
from orthocas.codegen import GeneratedC
from orthocas.control import PDPlus

_LIMIT = 150.0  # of all torques [N m]: more than gravity takes


def _law(chart: Callable[[], oc.Chart], folder: Path) -> GeneratedC:
    return oc.generate_c(chart(), folder, PDPlus.on_chart(chart(), limit=_LIMIT), "arm")


def _law_of_atlas(folder: Path) -> GeneratedC:
    return oc.generate_c(atlas(), folder, PDPlus.on_chart(atlas().chart(0), limit=_LIMIT), "arm")


_corridor = cache(in_a_corridor)
_in_a_box, _in_a_corridor = (partial(_law, chart) for chart in (lambda: fitted().chart, _corridor))
PROGRAMS: tuple[tuple[str, Callable[[Path], GeneratedC], str], ...] = (
    #: all of them say what they met, or exit with > 0
    ("a law and its inverse", _in_a_box, "random_ticks.c"),
    ("a law and its inverse in a corridor", _in_a_corridor, "random_ticks.c"),
    ("a supervised law", _in_a_box, "supervised_ticks.c"),
    ("a supervised law in a corridor", _in_a_corridor, "supervised_ticks.c"),
    ("an atlas", lambda folder: oc.generate_c(atlas(), folder, name="arm"), "atlas_calls.c"),
    ("a supervised law on an atlas", _law_of_atlas, "supervised_ticks.c"),
)


def ticks(count: int) -> list[Finding]:
    """Run so many ticks, as many in each program."""
    found, each = [], max(1, count // len(PROGRAMS))
    middle = ",".join(map(str, IN_ATLAS))
    level = "-O2" if each > 10_000 else "-O0"  # few ticks take less time than to compile them well
    flags = (
        level,
        f"-DTICKS={each}L",
        f"-DCALLS={each}L",
        f"-DLIMIT={_LIMIT}",
        "-DSINGULAR=0,0,0",
        f"-DMIDDLE={middle}",
    )
    for seed, (name, make, program) in enumerate(PROGRAMS):
        path = path_flags(_corridor().problem.domain) if make is _in_a_corridor else ()
        with TemporaryDirectory() as folder:
            compiled = built(make(Path(folder)), program, Path(folder), *flags, *path)
            done = subprocess.run([str(compiled)], capture_output=True, text=True, check=False)
        if done.returncode:
            found.append(Finding("ticks", seed, f"{name}: exit code {done.returncode} {done.stderr[:200]}"))
    return found
