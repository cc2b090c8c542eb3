"""Charts and controllers as small C libraries."""

from orthocas.codegen.check import AgreementCheck, check_c
from orthocas.codegen.compiled_inverse import CompiledInverse, compile_inverse
from orthocas.codegen.generate import GeneratedC, generate_c
from orthocas.codegen.library import (
    CompiledLibrary,
    Supervisor,
    Ticks,
    compile_shared,
    control_tick,
    gain_numbers,
    time_ticks,
)

__all__ = [
    "AgreementCheck",
    "CompiledInverse",
    "CompiledLibrary",
    "GeneratedC",
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
