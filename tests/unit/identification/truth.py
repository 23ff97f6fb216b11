"""Truth for the identification tests: an exact solver, and a plant with known parameters."""

from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.identification import identify as identification
from reactorwatch.identification.data import Dataset

Array = NDArray[np.float64]


def exact_least_squares(regressors: Array, outputs: Array) -> Array:
    """The least squares solution in rational arithmetic, rounded once at the end."""
    n = regressors.shape[1]
    rows = [
        [Fraction(float(value)) for value in (*row, output)] for row, output in zip(regressors, outputs, strict=True)
    ]
    equations = [[sum((row[i] * row[j] for row in rows), Fraction(0)) for j in range(n + 1)] for i in range(n)]
    for i in range(n):
        for k in range(i + 1, n):
            factor = equations[k][i] / equations[i][i]
            for j in range(i, n + 1):
                equations[k][j] -= factor * equations[i][j]
    solution = [Fraction(0)] * n
    for i in range(n - 1, -1, -1):
        known = sum((equations[i][j] * solution[j] for j in range(i + 1, n)), Fraction(0))
        solution[i] = (equations[i][n] - known) / equations[i][i]
    return np.array([float(value) for value in solution])


@dataclass(frozen=True)
class Daisy:
    """The DaISy CSTR record: times in min, coolant flow qc in l/min, concentration C in mol/l, temperature T in K."""

    time: Array
    qc: Array
    C: Array
    T: Array


@dataclass(frozen=True)
class NoisyPlant:
    """A plant whose output is measured with white noise: an output-error system.

    Attributes:
        parameters: a1, a2, b1, b2, c.
        inputs: shape (rows,).
        clean: shape (rows,), the output.
        measured: shape (rows,), the output with noise.
        noise_sd: of the noise.
    """

    parameters: Array
    inputs: Array
    clean: Array
    measured: Array
    noise_sd: float


def oscillating_plant(rows: int = 4000, noise_sd: float = 1.0, seed: int = 0) -> NoisyPlant:
    """Second order, oscillating, poles at 0.75 +- 0.37i; its input is held for five rows at a time."""
    rng = np.random.default_rng(seed)
    a1, a2, b1, b2, c = parameters = np.array([1.5, -0.7, 1.0, 0.5, 0.3])
    inputs = np.repeat(rng.standard_normal(-(-rows // 5)), 5)[:rows]
    clean = np.zeros(rows)
    for k in range(2, rows):
        clean[k] = a1 * clean[k - 1] + a2 * clean[k - 2] + b1 * inputs[k - 1] + b2 * inputs[k - 2] + c
    return NoisyPlant(parameters, inputs, clean, clean + noise_sd * rng.standard_normal(rows), noise_sd)


def identify(
    time: ArrayLike,
    inputs: ArrayLike,
    output: ArrayLike,
    name: str = "y",
    missing: Literal["refuse", "leave out"] = "refuse",
    **form: Any,
) -> identification.Identification:
    """Identify a model of arrays."""
    data = Dataset.of(time, inputs, output, output_name=name, missing=missing)
    return identification.identify(data, identification.ModelForm(**form))


@dataclass(frozen=True)
class System:
    """y = w + v, w[k] = f w[k-1] ... + b u[k-1] ... + offset, v[k] = d v[k-1] ... + e[k] + c e[k-1] ...

    Attributes:
        f: coefficients of the plant's own past.
        b: coefficients of past inputs, shape (lags, inputs).
        offset: the constant.
        d: coefficients of the past disturbance.
        c: coefficients of past e.
        noise_sd: standard deviation of e.
    """

    f: tuple[float, ...]
    b: tuple[tuple[float, ...], ...]
    offset: float
    d: tuple[float, ...]
    c: tuple[float, ...]
    noise_sd: float = 0.5

    @property
    def inputs(self) -> int:
        return len(self.b[0]) if self.b else 0

    def simulate(self, rows: int, seed: int) -> tuple[Array, Array]:
        """Inputs, shape (rows, inputs), held for three rows at a time, and the output, shape (rows,)."""
        rng = np.random.default_rng(seed)
        settle = 200
        count = rows + settle
        u = np.repeat(rng.standard_normal((count // 3 + 1, self.inputs)), 3, axis=0)[:count]
        e = self.noise_sd * rng.standard_normal(count)
        w, v = np.zeros(count), np.zeros(count)
        for k in range(3, count):
            w[k] = self.offset + sum(value * w[k - 1 - lag] for lag, value in enumerate(self.f))
            w[k] += sum(float(np.dot(row, u[k - 1 - lag])) for lag, row in enumerate(self.b))
            v[k] = e[k] + sum(value * v[k - 1 - lag] for lag, value in enumerate(self.d))
            v[k] += sum(value * e[k - 1 - lag] for lag, value in enumerate(self.c))
        return u[settle:], (w + v)[settle:]


POLES = (1.5, -0.7)
TWO_INPUTS = ((1.0, -0.6), (0.5, 0.3))

ARX = System(POLES, TWO_INPUTS, 0.3, POLES, ())
OUTPUT_ERROR = System(POLES, TWO_INPUTS, 0.3, (), ())
ARMAX = System(POLES, TWO_INPUTS, 0.3, POLES, (-0.4, 0.2))
BOX_JENKINS = System(POLES, TWO_INPUTS, 0.3, (0.9, -0.5), (0.6, 0.3))
ARMA = System(POLES, (), 0.3, POLES, (-0.4, 0.2))
AUTOREGRESSION = System(POLES, (), 0.3, POLES, ())
