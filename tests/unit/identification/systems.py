"""Systems with several inputs and a disturbance, simulated by a recursion written out here."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
