"""Polynomial state map: x[k+1] = f(x[k], u[k]), with the newest outputs as the state.

The signals of a row are the outputs of the last `lags` rows, the newest first, then as many lagged inputs. Each output
of the next row is a linear combination of products of these signals, up to a degree. Signals are scaled by mean and
spread of the training.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit

Products = NDArray[np.int64]
"""Indices of the factors of each term among the signals, shape (terms, degree); -1 where there is none."""


@dataclass(frozen=True)
class Shape:
    """Shape of a state map.

    Attributes:
        outputs: number of outputs.
        inputs: number of inputs.
        lags: rows of outputs, and of inputs, on which the next row depends.
        degree: largest number of factors of a product.
        delay: delay of the inputs in rows; with 1 they act on the next row.
    """

    outputs: int
    inputs: int
    lags: int
    degree: int
    delay: int = 1

    @property
    def states(self) -> int:
        """Number of states."""
        return self.outputs * self.lags

    @property
    def signals(self) -> int:
        """Number of factors that a product can have."""
        return (self.outputs + self.inputs) * self.lags

    @property
    def past(self) -> int:
        """Number of rows of which the inputs are needed."""
        return self.lags + self.delay - 1

    @property
    def terms(self) -> int:
        """Number of terms of an output."""
        return len(self.products())

    @property
    def parameters(self) -> int:
        """Number of parameters of all outputs."""
        return self.outputs * self.terms

    def products(self) -> Products:
        """All products, the constant first, then by degree: those of a lower degree are the first of a higher one."""
        chosen = [
            product
            for degree in range(self.degree + 1)
            for product in combinations_with_replacement(range(self.signals), degree)
        ]
        table = np.full((len(chosen), self.degree), -1)
        for row, product in zip(table, chosen, strict=True):
            row[: len(product)] = product
        return table


def lagged_inputs(shape: Shape, inputs: Array) -> Array:
    """Inputs on which the row after each row depends, newest first, shape (rows, inputs lags); NaN where unknown."""
    rows = len(inputs)
    lagged = np.full((rows, shape.inputs * shape.lags), np.nan)
    for lag in range(shape.lags):
        shift = shape.delay - 1 + lag
        lagged[shift:, lag * shape.inputs : (lag + 1) * shape.inputs] = inputs[: rows - shift]
    return lagged


@jit
def predict_outputs(
    theta: NDArray[np.float64],
    signals: NDArray[np.float64],
    products: NDArray[np.int64],
    values: NDArray[np.float64],
    slopes: NDArray[np.float64],
    outputs: NDArray[np.float64],
    jacobian: NDArray[np.float64],
) -> None:
    """Outputs of the next row and their derivatives by the states.

    Args:
        theta: parameters, shape (outputs, terms).
        signals: scaled signals, the states first.
        products: see `Products`.
        values: filled with the products, shape (terms,).
        slopes: filled with their derivatives by the states, shape (terms, states).
        outputs: filled, shape (outputs,).
        jacobian: filled, shape (outputs, states).
    """
    terms, degree = products.shape
    states = slopes.shape[1]
    for term in range(terms):
        value = 1.0
        for i in range(degree):
            if products[term, i] >= 0:
                value *= signals[products[term, i]]
        values[term] = value
        for state in range(states):
            slopes[term, state] = 0.0
        for i in range(degree):
            factor = products[term, i]
            if 0 <= factor < states:
                others = 1.0
                for k in range(degree):
                    if k != i and products[term, k] >= 0:
                        others *= signals[products[term, k]]
                slopes[term, factor] += others
    for j in range(theta.shape[0]):
        total = 0.0
        for term in range(terms):
            total += theta[j, term] * values[term]
        outputs[j] = total
        for i in range(states):
            total = 0.0
            for term in range(terms):
                total += theta[j, term] * slopes[term, i]
            jacobian[j, i] = total
