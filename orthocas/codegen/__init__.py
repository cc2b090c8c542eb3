"""Charts and controllers as small C libraries."""

from orthocas.codegen.generate import GeneratedC, generate_c
from orthocas.codegen.library import CompiledLibrary, compile_shared, gain_numbers
from orthocas.codegen.proof import Proof, check_c

__all__ = [
    "CompiledLibrary",
    "GeneratedC",
    "Proof",
    "check_c",
    "compile_shared",
    "gain_numbers",
    "generate_c",
]
