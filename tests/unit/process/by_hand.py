"""The reactor once more, by hand and with SciPy's solver: the truth that models and effects are held against."""

from collections.abc import Callable
from math import exp

import numpy as np
from scipy.integrate import solve_ivp

from reactorwatch.arrays import Array

Rates = Callable[[float, Array, float], list[float]]
"""dx/dt at a time, in min, of a state and a coolant flow, in l/min."""


def duty(T: float, qc: float) -> float:
    """Cooling duty in K/min."""
    return 0.01 * qc * (1 - exp(-700 / qc)) * (350 - T)


def balances(x: Array, cooling: float) -> list[float]:
    """dC/dt and dT/dt as the literature has them, the cooling duty given."""
    C, T = x[:2].tolist()
    rate = C * exp(-1e4 / T)
    return [1 - C - 7.2e10 * rate, 350 - T + 1.44e13 * rate + cooling]


def nominal(_time_min: float, x: Array, qc: float) -> list[float]:
    """The balances of the reactor as it should be."""
    return balances(x, duty(x[1], qc))


def run(rates: Rates, start: Array, time_min: Array, flows: Array) -> Array:
    """States at the times, the flow of each holding until the next."""
    states = [start]
    for begin, end, qc in zip(time_min[:-1], time_min[1:], flows[:-1], strict=True):
        found = solve_ivp(rates, (begin, end), states[-1], args=(qc,), method="DOP853", rtol=1e-11, atol=1e-12)
        states.append(found.y[:, -1])
    return np.array(states)
