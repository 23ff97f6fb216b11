"""The reactor by hand and with SciPy's solver, which the plant is compared with, and rows of a plant."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from plant_node.core import Plant, Row

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reactor:
    """Amounts and heat as they are, with a volume that may move: balances of V C and V T, not of C and T.

    Attributes:
        q: inflow, l/min.
        level_gain: of the level controller about 100 l and 100 l/min, 1/min; 0: constant volume.
        coolant_share: of the commanded coolant flow that flows.
    """

    q: float = 100.0
    level_gain: float = 0.0
    coolant_share: float = 1.0

    def after(self, state: Sequence[float] | Array, qc: float, span_min: float) -> Array:
        """(C, T, V) after a time at a constant coolant flow, in mol/l, K and l."""
        C, T, V = state
        run = solve_ivp(self._rates, (0, span_min), [V * C, V * T, V], "DOP853", args=(qc,), rtol=1e-11, atol=1e-9)
        amount, heat, volume = run.y[:, -1]
        return np.array([amount / volume, heat / volume, volume])

    def _rates(self, _: float, y: Array, qc: float) -> list[float]:
        amount, heat, V = y
        C, T = amount / V, heat / V
        out = max(100.0 + self.level_gain * (V - 100.0), 0.0) if self.level_gain else self.q
        real = qc * self.coolant_share
        # K2 = 0.01 /l belongs to 100 l: the heat taken away does not depend on the volume.
        cooling = 0.01 * 100.0 * real * (1 - np.exp(-700.0 / real)) * (350.0 - T)
        converted = V * C * np.exp(-1e4 / T)
        return [
            self.q * 1.0 - out * C - 7.2e10 * converted,
            self.q * 350.0 - out * T + 1.44e13 * converted + cooling,
            self.q - out,
        ]


def coolant_for(temperature_K: float) -> float:
    """The real coolant flow in l/min at which the reactor rests at a temperature: its balances solved for qc."""
    rate = np.exp(-1e4 / temperature_K)
    C = 1.0 / (1.0 + 7.2e10 * rate)
    heat = 350.0 - temperature_K + 1.44e13 * C * rate

    def surplus(qc: float) -> float:
        return float(heat + 0.01 * qc * (1 - np.exp(-700.0 / qc)) * (350.0 - temperature_K))

    return float(brentq(surplus, 1.0, 400.0, xtol=1e-12))


def resting(qc: float) -> Array:
    """(C, T, V) at the hottest steady state at a real coolant flow between 80 and 120 l/min."""
    T = float(brentq(lambda T: coolant_for(T) - qc, 428.0, 470.0, xtol=1e-10))
    return np.array([1.0 / (1.0 + 7.2e10 * np.exp(-1e4 / T)), T, 100.0])


QUIET = {"C": 0.0, "T": 0.0, "qc": 0.0}


def rows(of: Plant, count: int) -> list[Row]:
    return [of.next_row() for _ in range(count)]


def column(found: list[Row], signal: str) -> NDArray[np.float64]:
    return np.array([row.readings[signal] for row in found])
