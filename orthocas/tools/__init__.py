"""General tools: checks, files, JSON, threads, progress, and helpers for CasADi.

How to choose an evaluator of CasADi functions:

- `batch.Batched` maps any SX or MX function of one sample over a set of samples. It is the default.
- `columns.BlockedFunction` does the same for an SX function of q that often gets thousands of joint positions, in
  threads. `columns.ColumnFunction` evaluates a large SX function on columns of 256 samples, for losses.
- `blas_graph.NumpyGraph` evaluates an MX graph of dense products at BLAS speed, derivatives included, for networks.
- `expressions.expand_scalars` expands a small graph into scalar operations. Controllers run fastest in this form.

`cached.cached_property` builds a value once for all threads, and never pickles or copies it. `interrupts.deferred`
delays Ctrl-C while compiled code runs. `files` writes files that appear complete or not at all. `archive` is the
container of chart files.
"""

__all__: list[str] = []
