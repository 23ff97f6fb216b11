"""A CasADi function on NumPy arrays as they are.

A call of a `ca.Function` converts every argument and every result, which costs a hundred times the arithmetic of our
small functions. Here the function reads and writes arrays that stay where they are.
"""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from reactorwatch.process.model import Array


class ArrayFunction:
    """Fill `arguments`, call, read `results`; the next call overwrites them.

    CasADi keeps a matrix column by column, so its column is a row of the array: a matrix of shape (n, m) is an array
    of shape (m, n), and a vector of n an array of shape (1, n).

    Args:
        function: its results are made dense.

    Attributes:
        arguments: one array an argument.
        results: one array a result.
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
            self._buffer.set_arg(index, memoryview(array))  # type: ignore[call-arg,arg-type] # the stub wants a size
        for index, array in enumerate(self.results):
            self._buffer.set_res(index, memoryview(array))  # type: ignore[call-arg,arg-type] # as above

    def __call__(self) -> None:
        """Evaluate."""
        self._evaluate()


def mapped(function: ca.Function, count: int, parameters: int) -> ArrayFunction:
    """A function for `count` rows at once, all with the same parameters.

    Args:
        function: of one row.
        count: how many rows.
        parameters: which of its arguments is the same for all.
    """
    symbols = [
        ca.MX.sym(function.name_in(index), *function.sparsity_in(index).shape)
        if index == parameters
        else ca.MX.sym(function.name_in(index), function.size1_in(index), count * function.size2_in(index))
        for index in range(function.n_in())
    ]
    arguments = [ca.repmat(item, 1, count) if index == parameters else item for index, item in enumerate(symbols)]
    return ArrayFunction(ca.Function(f"{function.name()}_map", symbols, function.map(count).call(arguments)))


def over_rows(function: ArrayFunction, count: int, p: Array, values: Sequence[Array]) -> list[Array]:
    """A mapped function for any number of rows; each result has shape (rows, its rows, its columns).

    Args:
        function: of `mapped`, whose third argument is the same for all rows.
        count: rows that it takes at once.
        p: that argument.
        values: the others, each of shape (rows, its size).
    """
    rows, arguments = len(values[0]), (*function.arguments[:2], *function.arguments[3:])
    function.arguments[2][0] = p
    results = [np.empty((rows, item.shape[0] // count, item.shape[1])) for item in function.results]
    for first in range(0, rows, count):
        part = slice(first, min(first + count, rows))
        for argument, value in zip(arguments, values, strict=True):
            argument[: part.stop - first] = value[part]
        function()
        for result, found in zip(results, function.results, strict=True):
            result[part] = found.reshape(count, *result.shape[1:])[: part.stop - first]
    return [result.transpose(0, 2, 1) for result in results]
