"""Generated C on an emulated Cortex-M4F (QEMU's mps2-an386): code, stack and instructions of a tick (3 min).

Ready charts with 6, 7 and 14 joints (two arms, degree 2), PD+ coupled with default gains and settings, arm-none-eabi-
gcc -O2 for -mcpu=cortex-m4 -mfpu=fpv4-sp-d16 -mfloat-abi=hard, in gcc's own dialect, which fuses products and sums
(-std=c99 does not: 10 % more instructions). Instructions are counted by SysTick under -icount shift=0, in steps of
40. The worst tick of 24 states: inside the domain and up to 5 % beyond, with speeds, each with the law alone in
command and while it takes over from the catcher, when all parts run. Code: the object file's, without the C library.
Stack: painted, of the deepest call. Iteration of the inverse map: the worst instructions of a call, divided by them.
"""

import shutil
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas.codegen import GeneratedC
from orthocas.codegen.rendering import DOUBLE, SINGLE
from orthocas.control import PDPlus
from orthocas.native.kernels import write_numbers
from orthocas.tools.checks import Array

TOOLS = ("arm-none-eabi-gcc", "qemu-system-arm")
TARGET = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-O2")
BOARD = Path(__file__).parent.parent / "examples" / "cortex_m4"
ARMS = ("ur5-position", "iiwa7-position", "iiwa7-pose")
STATES, ITERATIONS = 24, 10
LINES = ("law", "tick", "fade", "inverse")  #: that the program prints for every state
HEADER = (
    "| arm | joints | numbers | code bytes | stack bytes | instructions: law | worst tick | inverse, an iteration |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- |"
)


@dataclass(frozen=True)
class States:
    """Where the program calls: rows of joint positions, velocities, references, and starts of the inverse map."""

    q: Array
    dq: Array
    reference: Array
    start: Array

    @classmethod
    def of(cls, chart: oc.Chart, count: int, seed: int = 0) -> "States":
        """Random states inside the domain and up to 5 % beyond, the last one at its centre; rounded to float."""
        rng, n = np.random.default_rng(seed), chart.n
        box = chart.problem.domain
        q = box.centre + 1.05 * rng.uniform(-1, 1, (count, n)) * box.half_width
        q[-1] = box.centre
        dq = rng.normal(0, 0.2, (count, n))
        reference = np.hstack([chart.phi(q) + rng.normal(0, 0.01, (count, n)), rng.normal(0, 0.05, (count, 2 * n))])
        found = (q, dq, reference, q + rng.uniform(-0.2, 0.2, (count, n)))
        return cls(*(SINGLE.round(array) for array in found))

    def header(self, single: bool, iterations: int) -> str:
        """states.h."""
        kind = (SINGLE if single else DOUBLE).c_name
        count = len(self.q)
        lines = [f"#define NUMBER {kind}", f"#define STATES {count}", f"#define ITERATIONS {iterations}"]
        arrays = {"q": self.q, "dq": self.dq, "references": self.reference, "start": self.start}
        for name, rows in arrays.items():
            values = ",\n".join(f"{{{write_numbers(row)}}}" for row in rows)
            lines.append(f"static const NUMBER {name}[STATES][{rows.shape[1]}] = {{{values}}};")
        text = "\n".join(lines)
        return SINGLE.translate(text) if single else text


@dataclass(frozen=True)
class Found:
    """What the program printed."""

    loop: int  #: instructions of a loop of 200,000
    check: float  #: of the library
    status: dict[str, Array]  #: by line, (states,)
    instructions: dict[str, Array]
    stack: dict[str, Array]  #: [bytes]
    values: dict[str, Array]  #: (states, n)


def missing_tools() -> list[str]:
    """Programs that this needs and the machine lacks; Debian has them, see CONTRIBUTING.md."""
    return [tool for tool in TOOLS if shutil.which(tool) is None]


def built(generated: GeneratedC, states: States, folder: Path, iterations: int = ITERATIONS) -> Path:
    """The program for the board; the object file of the library is beside it."""
    (folder / "states.h").write_text(states.header(generated.single_precision, iterations))
    here = [f"-I{generated.folder}", f"-I{folder}"]
    library, program = folder / "arm.o", folder / "ticks.elf"
    _done("arm-none-eabi-gcc", *TARGET, "-c", str(generated.folder / "arm.c"), "-o", str(library))
    sources = [str(BOARD / name) for name in ("board.c", "ticks.c")]
    linked = ["-nostartfiles", "--specs=nano.specs", f"-Wl,-T,{BOARD / 'memory.ld'}", "-Wl,--gc-sections"]
    _done("arm-none-eabi-gcc", *TARGET, *here, *sources, str(library), *linked, "-o", str(program), "-lm")
    return program


def emulated(program: Path, single: bool) -> Found:
    """Run the program on the board."""
    board = ["-M", "mps2-an386", "-nographic", "-monitor", "none", "-serial", "none"]
    semihosting = ["-semihosting-config", "enable=on,target=native", "-icount", "shift=0"]
    lines = [
        line.split() for line in _done("qemu-system-arm", *board, *semihosting, "-kernel", str(program)).splitlines()
    ]
    rows = {name: [line for line in lines if line[0] == name] for name in LINES}
    columns = {name: np.array([[int(word) for word in row[2:5]] for row in rows[name]]) for name in LINES}
    return Found(
        int(lines[0][1]),
        float(_values(lines[1][1:], single)[0]),
        *({name: columns[name][:, k] for name in LINES} for k in range(3)),
        {name: np.array([_values(row[5:], single) for row in rows[name]]) for name in LINES},
    )


def _values(words: list[str], single: bool) -> list[float]:
    return [float(struct.unpack(">f" if single else ">d", bytes.fromhex(word))[0]) for word in words]


def _done(*words: str) -> str:
    """What a program prints, on either stream; QEMU's semihosting takes the standard error."""
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(words)} failed: {done.stdout[-500:]}{done.stderr[-500:]}")
    return done.stdout + done.stderr


def code_bytes(folder: Path) -> int:
    """Code and constants of the object file of the library."""
    return int(_done("arm-none-eabi-size", str(folder / "arm.o")).splitlines()[1].split()[0])


def main(quick: bool = False) -> list[str]:
    """Print the table."""
    if missing := missing_tools():
        raise ModuleNotFoundError(f"no {' and no '.join(missing)}, see CONTRIBUTING.md")
    return table(HEADER, rows(quick))


def rows(quick: bool) -> Iterator[str]:
    """A row for each arm and number type."""
    charts = {name: oc.charts.load(name) for name in (ARMS[1:2] if quick else ARMS)}
    if not quick:
        charts["two baxter arms"] = two_arms()
    for name, chart in charts.items():
        for single in (True, False):
            with TemporaryDirectory() as folder:
                generated = oc.generate_c(chart, folder, PDPlus.on_chart(chart), "arm", single_precision=single)
                found = emulated(built(generated, States.of(chart, STATES), Path(folder)), single)
                code = code_bytes(Path(folder))
            stack = max(int(bytes_.max()) for bytes_ in found.stack.values())
            worst = {line: int(counts.max()) for line, counts in found.instructions.items()}
            tick = max(worst["tick"], worst["fade"])
            kind = "float" if single else "double"
            yield (
                f"| {name} | {chart.n} | {kind} | {code} | {stack} | {worst['law']} | {tick} "
                f"| {worst['inverse'] // ITERATIONS} |"
            )


def two_arms() -> oc.Chart:
    """Two arms, the position of one hand relative to the other: 14 joints."""
    from many_joints import BAXTER, HALF_WIDTH, robot

    two = robot("baxter.urdf", "left_gripper", "right_gripper")
    task = oc.Task.relative_position(two, *two.tips)
    return oc.fit(oc.Problem(two, task, domain=oc.Box(BAXTER, HALF_WIDTH)), oc.Polynomial(2), samples=3000).chart


if __name__ == "__main__":
    run(main, __doc__)
