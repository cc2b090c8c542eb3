"""C that Python compiles for itself: kernels from CasADi functions, and shared libraries that are kept and loaded.

`kernels` writes CasADi functions as C99 and fills templates in, and `libraries` compiles, keeps and loads.
`runtime/self_motion.c` follows the self-motion curves of a task value; `orthocas.charts` and `orthocas.arms` call it.
"""

from orthocas.native.libraries import find_compilers, keep_library, load_library

__all__ = ["find_compilers", "keep_library", "load_library"]
