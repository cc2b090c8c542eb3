"""C code by hand for functions whose graphs CasADi turns into slow loops, and for those that read tables (ours)."""

import re
from collections.abc import Mapping

import casadi as ca

from orthocas.codegen.work_arrays import in_order_of_generation
from orthocas.control.linear_algebra import LARGE_INVERSE

_HAND_ON = re.compile(r"(?<=\(arg1, res1, iw, w), 0\)")


def with_own_code(blocks: dict[str, str], functions: list[ca.Function], bodies: Mapping[str, str]) -> dict[str, str]:
    """C code by name, with that of inverses and of functions with given bodies replaced.

    Args:
        blocks: as in `work_arrays.compacted`.
        functions: as in `work_arrays.compacted`.
        bodies: C bodies by name of the function. If there are any, calls hand `mem` on.
    """
    changed = {name: _HAND_ON.sub(", mem)", block) for name, block in blocks.items()} if bodies else dict(blocks)
    for number, function in enumerate(in_order_of_generation(functions)):
        own = _INVERSE.replace("SIZE", str(function.size1_in(0))) if function.name() == LARGE_INVERSE else None
        body = bodies.get(function.name(), own)
        if body is not None:
            name = f"casadi_f{number}"
            changed[name] = blocks[name].split("{", 1)[0] + body
    return changed


# The sweeps of `orthocas.control.linear_algebra`, in place, on the lower triangle. It takes less of `w` than the graph.
_INVERSE = """{
  casadi_real *a = w, *column = w + SIZE * SIZE, volume = 1.0;
  casadi_int i, j, k;
  (void)iw;
  for (i = 0; i < SIZE * SIZE; ++i) a[i] = arg[0][i];
  for (k = 0; k < SIZE; ++k) {
    const casadi_real pivot = a[k * SIZE + k], scale = 1.0 / pivot;
    volume *= pivot;
    for (j = 0; j <= k; ++j) column[j] = a[k * SIZE + j];
    for (i = k + 1; i < SIZE; ++i) column[i] = a[i * SIZE + k];
    for (i = 0; i < SIZE; ++i) {
      const casadi_real share = column[i] * scale;
      for (j = 0; j <= i; ++j) a[i * SIZE + j] -= share * column[j];
    }
    for (j = 0; j < k; ++j) a[k * SIZE + j] = column[j] * scale;
    for (i = k + 1; i < SIZE; ++i) a[i * SIZE + k] = column[i] * scale;
    a[k * SIZE + k] = -scale;
  }
  if (res[0] != 0)
    for (i = 0; i < SIZE; ++i)
      for (j = 0; j <= i; ++j) res[0][i * SIZE + j] = res[0][j * SIZE + i] = -a[i * SIZE + j];
  if (res[1] != 0) res[1][0] = volume;
  return 0;
}"""
