"""Structure of a linear model: orders, delay and scaling."""

from typing import Self, TypeAlias

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.errors import InputError, UnfitRecordError

Delay: TypeAlias = int | tuple[int, ...]
"""Delay of all inputs in samples, or of each."""

Orders: TypeAlias = tuple[int, int, NDArray[np.int64]]


class Structure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Terms of a linear model.

        y[k] = a1 y[k-1] + ... + a_na y[k-na] + b1 u[k-d] + ... + b_nb u[k-d-nb+1] + c.

    With several inputs u[k-i] is their vector, each delayed by its own d, and b_i has one value for each. A model
    without inputs has no b.

    Attributes:
        output_lags: na, number of past outputs.
        input_lags: nb, number of past inputs.
        delay: d, samples from a move of the input to its first effect. An input held over [t_k, t_k+1) first shows
            in row k+1: delay 1. Several inputs may have one each; equal ones are stored as one number.
        inputs: number of inputs.
        outputs: 1; stored states have it.
        offset: whether there is a term c.

    Raises:
        InputError: an order or a delay below 1, another number of delays than inputs, or of outputs than 1.
    """

    output_lags: int
    input_lags: int
    delay: Delay = 1
    inputs: int = 1
    outputs: int = 1
    offset: bool = True

    def __post_init__(self) -> None:
        if isinstance(self.delay, tuple):
            if self.inputs and len(self.delay) != self.inputs:
                raise InputError(f"there must be one delay for each of {self.inputs} inputs, got {self.delay}")
            if not self.inputs or len(set(self.delay)) == 1:  # one structure has one form
                msgspec.structs.force_setattr(self, "delay", self.delay[0] if self.inputs else 1)
        sizes = {name: getattr(self, name) for name in _TITLES} | {"delay": min(self.delays, default=self.delay)}
        for name, value in sizes.items():
            least = 0 if name == "inputs" else 1
            if value < least:
                raise InputError(f"{_TITLES[name]} must be at least {least}, got {value}")
        if self.outputs != 1:
            raise InputError(f"a model has one output, got {self.outputs}: use one for each")

    @classmethod
    def of_order(cls, order: int, delay: Delay = 1, inputs: int = 1) -> Self:
        """Make a structure with equally many lags of output and input.

        Raises:
            InputError: order or delay below 1.
        """
        if order < 1:
            raise InputError(f"order must be at least 1, got {order}")
        return cls(order, order, delay, inputs)

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return self.output_lags + self.input_lags * self.inputs + int(self.offset)

    @property
    def history(self) -> int:
        """Number of rows before row k that its equation needs."""
        return max(self.output_lags, *(delay + self.input_lags - 1 for delay in self.delays), 0)

    @property
    def delays(self) -> tuple[int, ...]:
        """Delay of each input."""
        return self.delay if isinstance(self.delay, tuple) else (self.delay,) * self.inputs

    @property
    def orders(self) -> Orders:
        """Lags of the output and of the inputs, and the delays, shape (inputs,), for kernels."""
        return self.output_lags, self.input_lags, np.array(self.delays, dtype=np.int64)

    def without_offset(self) -> Self:
        """The lagged signals alone."""
        return msgspec.structs.replace(self, offset=False)

    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order; inputs are numbered only where there are several.

        b1 is of the row that is the shortest delay back, for each input.

        >>> Structure.of_order(2).parameter_names()
        ('a1', 'a2', 'b1', 'b2', 'c')
        >>> Structure.of_order(1, inputs=2).parameter_names()
        ('a1', 'b1_1', 'b1_2', 'c')
        >>> Structure.of_order(1, delay=(2, 5), inputs=2).parameter_names()
        ('a1', 'b1_1', 'b4_2', 'c')
        """
        suffixes = [""] if self.inputs == 1 else [f"_{i + 1}" for i in range(self.inputs)]
        names = [f"a{lag}" for lag in range(1, self.output_lags + 1)]
        later = [delay - min(self.delays) for delay in self.delays]
        pairs = list(zip(later, suffixes, strict=True))
        names += [f"b{lag + rows}{suffix}" for lag in range(1, self.input_lags + 1) for rows, suffix in pairs]
        return tuple([*names, "c"] if self.offset else names)


_TITLES = {
    "output_lags": "order (lags of the output)",
    "input_lags": "order (lags of the input)",
    "delay": "delay (samples)",
    "inputs": "number of inputs",
}


class Scaling(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Scaling of signals, (value - centre) / spread, and of parameters.

    Attributes:
        input_centres: centre of each input, in its unit.
        input_spreads: spread of each input, above 0.
        output_centres: centre of each output, in its unit.
        output_spreads: spread of each output, above 0.

    Raises:
        InputError: a spread that is not above 0, or a number that is not finite.
    """

    input_centres: tuple[float, ...]
    input_spreads: tuple[float, ...]
    output_centres: tuple[float, ...]
    output_spreads: tuple[float, ...]

    def __post_init__(self) -> None:
        for spread in (*self.input_spreads, *self.output_spreads):
            if not 0.0 < spread < np.inf:
                raise InputError(f"spread of a signal must be finite and above 0, got {spread}")
        for centre in (*self.input_centres, *self.output_centres):
            if not np.isfinite(centre):
                raise InputError(f"centre of a signal must be finite, got {centre}")

    @classmethod
    def none(cls, inputs: int = 1) -> Self:
        """Make the identity."""
        return cls((0.0,) * inputs, (1.0,) * inputs, (0.0,), (1.0,))

    @classmethod
    def of(cls, inputs: ArrayLike, outputs: ArrayLike, centred: bool = True) -> Self:
        """Scale by mean and standard deviation of the measured values; the spread of a constant signal is 1.

        Args:
            inputs: shape (rows,) or (rows, inputs); NaN where nothing was measured.
            outputs: shape (rows,) or (rows, outputs); NaN where nothing was measured.
            centred: False for a model without offset: all centres are then 0.

        Raises:
            InputError: a signal without any measured value.
        """
        moments = []
        for name, signals in (("input", as_columns(inputs, "inputs")), ("output", as_columns(outputs, "outputs"))):
            for i, column in enumerate(signals.T):
                values = column[np.isfinite(column)]
                if values.size == 0:
                    raise UnfitRecordError(f"{name} {i + 1} has no measured value")
                centre, spread = float(np.mean(values)), float(np.std(values))
                constant = spread <= 1e-12 * abs(centre)
                moments.append((name, centre if centred else 0.0, 1.0 if constant else spread))
        return cls(
            tuple(centre for name, centre, _ in moments if name == "input"),
            tuple(spread for name, _, spread in moments if name == "input"),
            tuple(centre for name, centre, _ in moments if name == "output"),
            tuple(spread for name, _, spread in moments if name == "output"),
        )

    def inputs(self, values: ArrayLike) -> NDArray[np.float64]:
        """Scale inputs along the last axis; contiguous, for kernels."""
        return np.ascontiguousarray((np.asarray(values, dtype=np.float64) - self.input_centres) / self.input_spreads)

    def outputs(self, values: ArrayLike) -> NDArray[np.float64]:
        """Scale outputs along the last axis; contiguous, for kernels."""
        return np.ascontiguousarray((np.asarray(values, dtype=np.float64) - self.output_centres) / self.output_spreads)

    def unscaling(self, structure: Structure) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Transform M p + m of parameters for scaled signals to those for the signals' own units.

        Args:
            structure: structure of the model.

        Returns:
            M, shape (parameters, parameters), and m, shape (parameters,). A covariance becomes M cov M'.

        Raises:
            InputError: a model without offset whose signals were centred.
        """
        spread, centre = self.output_spreads[0], self.output_centres[0]
        factors = spread / np.concatenate(
            [
                np.tile(self.output_spreads, structure.output_lags),
                np.tile(self.input_spreads, structure.input_lags),
            ]
        )
        centres = np.concatenate(
            [
                np.tile(self.output_centres, structure.output_lags),
                np.tile(self.input_centres, structure.input_lags),
            ]
        )
        if not structure.offset:
            if np.any(centres != 0.0) or centre != 0.0:
                raise InputError("a model without offset needs signals that are not centred: use centred=False")
            return np.diag(factors), np.zeros(structure.parameters)
        matrix = np.zeros((structure.parameters, structure.parameters))
        np.fill_diagonal(matrix, [*factors, spread])
        matrix[-1, :-1] = -factors * centres
        shift = np.zeros(structure.parameters)
        shift[-1] = centre
        return matrix, shift


def as_columns(values: ArrayLike, name: str, count: int | None = None) -> NDArray[np.float64]:
    """Signals as an array of shape (rows, signals).

    Args:
        values: shape (rows,) for one signal, or (rows, signals).
        name: name for messages.
        count: expected number of signals; None: any.

    Raises:
        InputError: another number of axes or of signals.
    """
    columns = np.asarray(values, dtype=np.float64)
    if columns.ndim == 1:
        columns = columns[:, None]
    if columns.ndim != 2 or (count is not None and columns.shape[1] != count):
        wanted = "signals" if count is None else str(count)
        raise InputError(f"{name} must have the shape (rows, {wanted}), got {columns.shape}")
    return columns
