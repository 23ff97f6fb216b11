"""A CasADi function that reads and writes NumPy arrays in place.

A call of a `ca.Function` converts every argument and every result, which takes a hundred times as long as the
arithmetic of a small function. For many rows at once see `compiled_function`.
"""

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array


class ArrayFunction:
    """Fill `arguments`, call, read `results`; the next call overwrites them.

    CasADi keeps a matrix column by column, so its column is a row of the array: a matrix of shape (n, m) is an array
    of shape (m, n), and a vector of n an array of shape (1, n).

    Args:
        function: the CasADi function; its results are made dense.

    Attributes:
        arguments: one array for each argument.
        results: one array for each result.
    """

    def __init__(self, function: ca.Function) -> None:
        symbols = function.mx_in()
        if not all(function.sparsity_out(index).is_dense() for index in range(function.n_out())):
            function = ca.Function(function.name(), symbols, [ca.densify(item) for item in function.call(symbols)])
        self.arguments: tuple[Array, ...] = tuple(
            np.zeros(function.size_in(index)[::-1]) for index in range(function.n_in())
        )
        self.results: tuple[Array, ...] = tuple(
            np.zeros(function.size_out(index)[::-1]) for index in range(function.n_out())
        )
        self._buffer, self._evaluate = function.buffer()
        for index, array in enumerate(self.arguments):
            self._buffer.set_arg(index, memoryview(array))  # type: ignore[call-arg,arg-type] # the stub asks for a size
        for index, array in enumerate(self.results):
            self._buffer.set_res(index, memoryview(array))  # type: ignore[call-arg,arg-type] # as above

    def __call__(self) -> None:
        """Evaluate."""
        self._evaluate()

    def call(self, *values: Array | float) -> list[Array]:
        """Evaluate with these arguments; returns copies of the results."""
        for argument, value in zip(self.arguments, values, strict=True):
            argument[:] = value
        self._evaluate()
        return [item.copy() for item in self.results]
