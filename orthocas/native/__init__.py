"""C that orthocas compiles for its own use: kernels from CasADi functions, and shared libraries that are stored.

`kernels` writes CasADi functions as C99 and fills in templates; `libraries` compiles, stores and loads libraries.
`runtime/self_motion.c` follows the self-motion curves of a task value; `orthocas.charts` and `orthocas.arms` call it.
"""

from orthocas.native.libraries import find_compilers, keep_library, load_library

__all__ = ["find_compilers", "keep_library", "load_library"]
