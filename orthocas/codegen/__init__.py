"""Charts and controllers as small C libraries."""

from orthocas.codegen.atlas_proof import check_c_of_atlas
from orthocas.codegen.chart_reference import ChartReference
from orthocas.codegen.compiled_inverse import CompiledInverse, compile_inverse
from orthocas.codegen.generate import generate_c
from orthocas.codegen.generated import GeneratedC
from orthocas.codegen.library import CompiledLibrary, compile_shared, gain_numbers
from orthocas.codegen.proof import Proof, check_c
from orthocas.codegen.supervisor import Supervisor
from orthocas.codegen.ticks import Ticks, control_tick, time_ticks

__all__ = [
    "ChartReference",
    "CompiledInverse",
    "CompiledLibrary",
    "GeneratedC",
    "Proof",
    "Supervisor",
    "Ticks",
    "check_c",
    "check_c_of_atlas",
    "compile_inverse",
    "compile_shared",
    "control_tick",
    "gain_numbers",
    "generate_c",
    "time_ticks",
]
