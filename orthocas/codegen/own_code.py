"""C code by hand for functions whose graphs CasADi turns into slow loops: inverses of large matrices (ours)."""

import casadi as ca

from orthocas.codegen.work_arrays import in_order_of_generation
from orthocas.control.linear_algebra import LARGE_INVERSE


def with_own_code(blocks: dict[str, str], functions: list[ca.Function]) -> dict[str, str]:
    """C code by name, with that of inverses replaced; arguments are those of `work_arrays.compacted`."""
    changed = dict(blocks)
    for number, function in enumerate(in_order_of_generation(functions)):
        if function.name() == LARGE_INVERSE:
            name = f"casadi_f{number}"
            head = blocks[name].split("{", 1)[0]
            changed[name] = head + _INVERSE.replace("SIZE", str(function.size1_in(0)))
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
