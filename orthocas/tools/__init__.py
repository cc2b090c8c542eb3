"""What every part uses and no part of the field: checks, files, JSON, threads, progress, and tools around CasADi.

Which evaluator of CasADi functions to use:

- `batch.Batched` maps any SX or MX function of one sample over a set of samples. Use it by default.
- `columns.BlockedFunction` does the same for an SX function of q that often meets thousands of joint positions, in
  threads. `columns.ColumnFunction` evaluates a large SX function on columns of 256 samples, for losses.
- `blas_graph.NumpyGraph` evaluates an MX graph of dense products at BLAS speed, derivatives included, for networks.
- `expressions.expand_scalars` expands a small graph into scalar operations. Controllers run fastest in this form.

`cached.cached_property` builds a value once for all threads, and never pickles or copies it. `interrupts.deferred`
holds Ctrl-C back while compiled code runs. `files` has files that appear whole or not at all, and `archive` the
container of chart files.
"""

__all__: list[str] = []
