"""Dense MX graphs at BLAS speed: NumPy evaluates matrix products and tanh of a finished graph.

CasADi multiplies dense matrices with a triple loop, and its derivatives do not keep replaced kernels. So CasADi builds
the whole graph with derivatives, and the products are replaced at the end.
"""

from collections.abc import Callable, Sequence
from threading import local
from typing import Any

import casadi as ca
import numpy as np

from orthocas.tools.checks import Array
from orthocas.tools.interrupts import deferred


class DenseNode(ca.Callback):
    """A node of an MX graph with dense matrices, evaluated in Python; subclasses have `eval_buffer`."""

    def __init__(self, name: str, inputs: Sequence[tuple[int, int]], outputs: Sequence[tuple[int, int]]) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs = tuple(inputs), tuple(outputs)
        self.construct(name, {})

    def get_n_in(self) -> int:
        """Number of input matrices."""
        return len(self._inputs)

    def get_n_out(self) -> int:
        """Number of output matrices."""
        return len(self._outputs)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Dense."""
        return ca.Sparsity.dense(*self._inputs[i])

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Dense."""
        return ca.Sparsity.dense(*self._outputs[i])

    def has_eval_buffer(self) -> bool:
        """Make CasADi pass buffers, so that nothing is copied."""
        return True


class NumpyNode(DenseNode):
    """A node with one output that NumPy evaluates in place. It has no derivatives."""

    def eval_buffer(self, arg: Sequence[Any], res: Sequence[Any]) -> int:
        """Evaluate the node. CasADi stores matrices column by column, so NumPy sees them transposed."""
        inputs = [np.frombuffer(memory).reshape(shape[::-1]) for memory, shape in zip(arg, self._inputs, strict=True)]
        self.compute(inputs, np.frombuffer(res[0]).reshape(self._outputs[0][::-1]))
        return 0

    def compute(self, transposed: list[Array], result: Array) -> None:
        """Write the transposed output, given the transposed inputs."""
        raise NotImplementedError


class Product(NumpyNode):
    """op(A) op(B), where op transposes or does nothing."""

    def __init__(self, a: tuple[int, int], b: tuple[int, int], flip_a: bool, flip_b: bool) -> None:
        self._flips = flip_a, flip_b
        NumpyNode.__init__(self, "product", (a, b), [(a[1] if flip_a else a[0], b[0] if flip_b else b[1])])

    def compute(self, transposed: list[Array], result: Array) -> None:
        """(op(A) op(B))^T = op(B)^T op(A)^T."""
        a, b = transposed
        np.matmul(b.T if self._flips[1] else b, a.T if self._flips[0] else a, out=result)


class Tanh(NumpyNode):
    """tanh of every entry."""

    def __init__(self, shape: tuple[int, int]) -> None:
        NumpyNode.__init__(self, "tanh", [shape], [shape])

    def compute(self, transposed: list[Array], result: Array) -> None:
        """Evaluate tanh of all entries."""
        np.tanh(transposed[0], out=result)


class NumpyGraph:
    """A CasADi function of MX symbols whose dense products and tanh NumPy evaluates.

    Args:
        name: name of the function.
        inputs: MX symbols.
        outputs: expressions of these symbols; derivatives are allowed.

    Attributes:
        function: the CasADi function. It is valid only while this object exists, which owns its nodes.
    """

    def __init__(self, name: str, inputs: Sequence[ca.MX], outputs: Sequence[ca.MX]) -> None:
        self._nodes: list[NumpyNode] = []
        # CasADi calls the nodes for their shapes, and would swallow Ctrl-C during these calls.
        with deferred():
            self.function = ca.Function(name, list(inputs), self._rewrite(inputs, ca.cse(list(outputs))))
        self._memory = local()

    def __call__(self, *inputs: Array) -> list[Array]:
        """Evaluate without copies. Inputs and outputs are transposed matrices, contiguous and of the right size.

        Large graphs need large scratch memory, which each thread keeps between calls.
        """
        # Create this thread's memory at its first call.
        if not hasattr(self._memory, "buffer"):
            self._memory.buffer, self._memory.evaluate = self.function.buffer()
        buffer, evaluate = self._memory.buffer, self._memory.evaluate
        for i, array in enumerate(inputs):
            buffer.set_arg(i, array.data)
        results = [np.empty(self.function.size_out(i)[::-1]) for i in range(self.function.n_out())]
        for i, array in enumerate(results):
            buffer.set_res(i, array.data)
        with deferred():
            evaluate()
        return results

    def build_block_function(self) -> Callable[[Array], Array]:
        """A function of this graph's single input with its own memory. It returns the same array at every call."""
        # The type stubs of set_arg and set_res require a size, which the methods do not take.
        buffer: Any
        buffer, evaluate = self.function.buffer()
        values, result = (np.empty(size[::-1]) for size in (self.function.size_in(0), self.function.size_out(0)))
        buffer.set_arg(0, values.data)

        def run(block: Array) -> Array:
            values[...] = block.T
            # The closure also keeps the buffer alive, which `evaluate` does not.
            buffer.set_res(0, result.data)
            with deferred():
                evaluate()
            return result.T

        return run

    def _rewrite(self, inputs: Sequence[ca.MX], outputs: list[ca.MX]) -> list[ca.MX]:
        """Cut the graph at its expensive nodes, and reconnect the pieces through NumPy nodes."""
        plain = ca.Function("plain", list(inputs), outputs)
        heavy = [
            plain.instruction_MX(k)
            for k in range(plain.n_instructions())
            if plain.instruction_id(k) in (ca.OP_MTIMES, ca.OP_TANH)
        ]
        if not heavy:
            return outputs
        cuts = [ca.MX.sym("cut", *node.shape) for node in heavy]
        # Operands of each node without transposition, and whether each was transposed.
        operands = []
        for node in heavy:
            deps = [node.dep(i) for i in range(node.n_dep())]
            operands.append([(x.dep(0), True) if x.op() == ca.OP_TRANSPOSE else (x, False) for x in deps])
        pieces = iter(ca.graph_substitute([x for xs in operands for x, _ in xs] + outputs, heavy, cuts))
        # Replace products z + x y (operands z, x, y) and tanh by NumPy nodes.
        definitions = []
        for node, xs in zip(heavy, operands, strict=True):
            flips, parts = [flipped for _, flipped in xs], [next(pieces) for _ in xs]
            first = parts[0].T if flips[0] else parts[0]
            if node.op() == ca.OP_TANH:
                new: NumpyNode = Tanh(node.shape)
                result: ca.MX = new(first)
            else:
                new = Product(parts[1].shape, parts[2].shape, flips[1], flips[2])
                result = new(*parts[1:])
                result = result if parts[0].is_zero() else first + result
            self._nodes.append(new)
            definitions.append(result)
        _, rewritten = ca.substitute_inplace(cuts, definitions, list(pieces))
        return list(rewritten)
