"""Campaign of ticks in generated C: laws on a box and a corridor, supervised or not, get hostile numbers."""

import subprocess
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

from charts import in_a_corridor
from programs import built, path_flags
from public_objects import fitted

import orthocas as oc
from fuzz.child import Finding
from orthocas.codegen import GeneratedC
from orthocas.control import PDPlus

_LIMIT = 150.0  # of all torques [N m]: more than gravity takes


def _law(chart: Callable[[], oc.Chart], folder: Path) -> GeneratedC:
    return oc.generate_c(chart(), folder, PDPlus.on_chart(chart(), limit=_LIMIT), "arm")


_corridor = cache(in_a_corridor)
_in_a_box, _in_a_corridor = (partial(_law, chart) for chart in (lambda: fitted().chart, _corridor))
PROGRAMS: tuple[tuple[str, Callable[[Path], GeneratedC], str], ...] = (
    #: all of them say what they met, or exit with > 0
    ("a law and its inverse", _in_a_box, "random_ticks.c"),
    ("a law and its inverse in a corridor", _in_a_corridor, "random_ticks.c"),
    ("a supervised law", _in_a_box, "supervised_ticks.c"),
    ("a supervised law in a corridor", _in_a_corridor, "supervised_ticks.c"),
)


def ticks(count: int) -> list[Finding]:
    """Run so many ticks, as many in each program."""
    found, each = [], max(1, count // len(PROGRAMS))
    level = "-O2" if each > 10_000 else "-O0"  # few ticks take less time than to compile them well
    flags = (level, f"-DTICKS={each}L", f"-DLIMIT={_LIMIT}", "-DSINGULAR=0,0,0")
    for seed, (name, make, program) in enumerate(PROGRAMS):
        path = path_flags(_corridor().problem.domain) if make is _in_a_corridor else ()
        with TemporaryDirectory() as folder:
            compiled = built(make(Path(folder)), program, Path(folder), *flags, *path)
            done = subprocess.run([str(compiled)], capture_output=True, text=True, check=False)
        if done.returncode:
            found.append(Finding("ticks", seed, f"{name}: exit code {done.returncode} {done.stderr[:200]}"))
    return found
