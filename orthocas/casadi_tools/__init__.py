"""Tools around CasADi: evaluation on many samples, expressions as data, thread safety and Ctrl-C.

Which evaluator to use:

- `batch.Batched` maps any SX or MX function of one sample over a set of samples. Use it by default.
- `blocks.BlockedFunction` does the same for an SX function of q that often meets thousands of joint positions, in
  threads. `blocks.fill` is its loop, for functions of other kinds.
- `columns.ColumnFunction` evaluates a large SX function on columns of 256 samples. It serves the loss
  and the gradients of basis functions.
- `blas_graph.NumpyGraph` evaluates an MX graph of dense products at BLAS speed, derivatives included. It serves
  networks.
- `scalar_code.scalar_code` expands a small graph into scalar operations. Controllers run fastest in this form.

Other tools:

- `tape` stores an SX expression as plain data for chart files. `user_expression` checks a user's function of q.
- `cached.cached_property` builds a value once for all threads, and never pickles or copies it.
- `interrupts.deferred` holds Ctrl-C back while compiled code runs; `interrupts.check` raises it in Python callbacks.
"""

__all__: list[str] = []
