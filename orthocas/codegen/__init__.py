"""Charts and controllers as small C libraries."""

from orthocas.codegen.compiled_inverse import CompiledInverse, compile_inverse
from orthocas.codegen.generate import generate_c
from orthocas.codegen.library import CompiledLibrary, GeneratedC, compile_shared, gain_numbers
from orthocas.codegen.proof import Proof, check_c
from orthocas.codegen.supervisor import Supervisor
from orthocas.codegen.ticks import Ticks, control_tick, time_ticks

__all__ = [
    "CompiledInverse",
    "CompiledLibrary",
    "GeneratedC",
    "Proof",
    "Supervisor",
    "Ticks",
    "check_c",
    "compile_inverse",
    "compile_shared",
    "control_tick",
    "gain_numbers",
    "generate_c",
    "time_ticks",
]
