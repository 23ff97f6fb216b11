"""Fitted state map: parameters with their covariance, and the variances of the plant and its measurements."""

from typing import Self

import msgspec
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.identification.black_box.state_map import Shape
from reactorwatch.stored_state import pack_numbers, unpack_numbers


class BlackBoxModel(msgspec.Struct, frozen=True):
    """Fitted state map. Everything but centres and spreads is of scaled signals.

    Attributes:
        outputs: number of outputs.
        inputs: number of inputs.
        lags: rows of outputs and inputs on which the next row depends.
        degree: largest degree of the polynomial.
        delay: delay of the inputs in rows.
        rows: number of rows of the fit.
        effective: number of parameters of an output that the rows determine, not the prior.
        gain: gain of the fit: 0, simulation errors; 1, errors of the next row.
        centres: means of the outputs, then of the inputs, in the signals' units.
        spreads: standard deviations of the same.
        r: variances of the measurements of each output.
        q: variances of the process from row to row, of each output.
        numbers: parameters and the lower triangle of their covariance, as doubles.
    """

    outputs: int
    inputs: int
    lags: int
    degree: int
    delay: int
    rows: int
    effective: float
    gain: float
    centres: tuple[float, ...]
    spreads: tuple[float, ...]
    r: tuple[float, ...]
    q: tuple[float, ...]
    numbers: bytes

    @classmethod
    def of(
        cls,
        shape: Shape,
        rows: int,
        effective: float,
        gain: float,
        scaling: tuple[Array, Array],
        variances: tuple[Array, Array],
        theta: Array,
        covariance: Array,
    ) -> Self:
        """Make a model of arrays.

        Args:
            shape: shape of the map.
            rows: number of rows of the fit.
            effective: see the attributes.
            gain: gain of the fit.
            scaling: centres and spreads.
            variances: r and q.
            theta: parameters, shape (outputs, terms).
            covariance: shape (parameters, parameters), of the parameters.
        """
        lower = covariance[np.tril_indices(theta.size)]
        centres, spreads, r, q = (tuple(item.tolist()) for item in (*scaling, *variances))
        numbers = pack_numbers(np.concatenate([theta.ravel(), lower]))
        sizes = (shape.outputs, shape.inputs, shape.lags, shape.degree, shape.delay)
        return cls(*sizes, rows, effective, gain, centres, spreads, r, q, numbers)

    @property
    def shape(self) -> Shape:
        """Shape of the map."""
        return Shape(self.outputs, self.inputs, self.lags, self.degree, self.delay)

    @property
    def theta(self) -> Array:
        """Parameters, shape (outputs, terms)."""
        return self._numbers[: self.shape.parameters].reshape(self.outputs, -1)

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters, shape (parameters, parameters)."""
        count = self.shape.parameters
        covariance = np.zeros((count, count))
        covariance[np.tril_indices(count)] = self._numbers[count:]
        return covariance + np.tril(covariance, -1).T

    @property
    def error_sd(self) -> Array:
        """Standard deviation of each output's one-step error with known parameters and state, in its unit."""
        return np.asarray(np.sqrt(np.add(self.r, self.q)) * np.array(self.spreads[: self.outputs]))

    @property
    def out_of_sample(self) -> float:
        """Ratio of the size of residuals out of the fit to that of residuals in it."""
        return float(np.sqrt(self.rows / max(self.rows - self.effective, 0.1 * self.rows)))

    @property
    def dynamics_sd(self) -> float:
        """Largest standard deviation of a coefficient by which an output depends on a state, of scaled signals."""
        variances = np.diag(self.covariance)  # rounding may make those of what is not determined negative
        deviations = np.sqrt(np.where(variances >= 0.0, variances, np.inf)).reshape(self.outputs, -1)
        return float(np.max(deviations[:, 1 : 1 + self.shape.states]))

    @property
    def _numbers(self) -> Array:
        count = self.shape.parameters
        numbers = unpack_numbers(self.numbers, 1)[:, 0]
        if numbers.size != count + count * (count + 1) // 2:
            raise ValueError(f"a model of {count} parameters must have a covariance of that size, got {numbers.size}")
        return numbers
