"""CasADi nodes around NumPy functions, for the solvers that come with CasADi."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from orthocas.tools.checks import Array
from orthocas.tools.interrupts import check


class ArrayNode(ca.Callback):
    """A function of columns whose outputs are computed in NumPy.

    Exceptions, Ctrl-C included, cannot pass through the code of the solver. The node keeps an exception in `error` and
    fails this evaluation and all later ones, so that the solver soon gives up.

    Args:
        name: name of the function.
        rows: length of each input column.
        shapes: shape of each output.
        compute: maps arrays (rows,) to one array per output.
        options: options of the CasADi function.
        jacobian: derivative of the single output with respect to the single input, for solvers that need it.
        forward: directional derivative, as a function of input and direction; avoids a dense Jacobian.
    """

    def __init__(
        self,
        name: str,
        rows: Sequence[int],
        shapes: Sequence[tuple[int, int]],
        compute: Callable[..., Sequence[Any]],
        options: dict[str, Any] | None = None,
        jacobian: "ArrayNode | None" = None,
        forward: "ArrayNode | None" = None,
    ) -> None:
        ca.Callback.__init__(self)
        self._rows, self._shapes, self._compute, self._jacobian = tuple(rows), tuple(shapes), compute, jacobian
        self._forward = forward
        self.error: BaseException | None = None
        self.construct(name, options or {})

    def get_n_in(self) -> int:
        """Number of input columns."""
        return len(self._rows)

    def get_n_out(self) -> int:
        """Number of outputs."""
        return len(self._shapes)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Dense columns."""
        return ca.Sparsity.dense(self._rows[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Dense."""
        return ca.Sparsity.dense(*self._shapes[i])

    def has_eval_buffer(self) -> bool:
        """Whether to use buffers; they avoid a second copy."""
        return True

    def eval_buffer(self, arg: Sequence[Any], res: Sequence[Any]) -> int:
        """Evaluate the outputs; the return value 1 means to CasADi that the evaluation failed."""
        if self.error is not None:
            return 1
        try:
            check()
            results = self._compute(*(self._array(i, memory) for i, memory in enumerate(arg)))
            for memory, result in zip(res, results, strict=True):
                if memory is not None:
                    np.frombuffer(memory)[:] = np.asarray(result, dtype=float).ravel(order="F")
        except BaseException as error:
            self.error = error
            return 1
        return 0

    def _array(self, i: int, memory: Any) -> Array:
        """Input i as an array; CasADi passes None for zeros."""
        return np.zeros(self._rows[i]) if memory is None else np.frombuffer(memory).copy()

    def has_jacobian(self) -> bool:
        """Whether a derivative was given."""
        return self._jacobian is not None

    def get_jacobian(
        self, name: str, inames: Sequence[str], onames: Sequence[str], opts: Mapping[str, Any]
    ) -> ca.Function:
        """The derivative in CasADi's form, as a function of the inputs and an unused output."""
        if self._jacobian is None:
            raise NotImplementedError(name)
        inputs = [ca.MX.sym("x", rows) for rows in self._rows]
        unused = ca.MX.sym("y", *self._shapes[0])
        return ca.Function(name, [*inputs, unused], [self._jacobian(*inputs)], list(inames), list(onames), dict(opts))

    def has_forward(self, nfwd: int) -> bool:
        """Whether a directional derivative was given."""
        return self._forward is not None and nfwd == 1

    def get_forward(
        self, nfwd: int, name: str, inames: Sequence[str], onames: Sequence[str], opts: Mapping[str, Any]
    ) -> ca.Function:
        """The directional derivative in CasADi's form, as a function of input, an unused output and direction."""
        if self._forward is None:
            raise NotImplementedError(name)
        x, unused, direction = (ca.MX.sym(letter, self._rows[0]) for letter in "xyd")
        outputs = [self._forward(x, direction)]
        return ca.Function(name, [x, unused, direction], outputs, list(inames), list(onames), dict(opts))

    def has_jac_sparsity(self, oind: int, iind: int) -> bool:
        """Whether the sparsity of the Jacobian is known without building the Jacobian."""
        return self._forward is not None

    def get_jac_sparsity(self, oind: int, iind: int, symmetric: bool) -> ca.Sparsity:
        """An empty pattern, because a Krylov method uses only products with the Jacobian."""
        return ca.Sparsity(self._shapes[oind][0], self._rows[iind])

    def reraise(self) -> None:
        """Raise the exception that stopped an evaluation, if any."""
        if self.error is not None:
            raise self.error
