"""Two tanks, the first of which drains into the second, and their levels by the exact solution."""

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from reactorwatch.process.model import Output, ProcessModel, new_clock, parameter, variable
from reactorwatch.records.record import Record

PERIOD_MIN, OUTLET_1_PER_MIN = 0.1, 0.2
KEPT = 0.95
"""Part of a flow's deviation that is left a row later."""


def two_tanks() -> ProcessModel:
    """A tank that drains into a second one, each with a flow of its own."""
    flows = [variable(f"F{i}", "m3/min", (0.0, 4.0), 0.5, f"flow to tank {i}") for i in (1, 2)]
    levels = [variable(f"h{i}", "m", (0.0, 20.0), 1.0, f"level {i}", balance=f"tank{i}") for i in (1, 2)]
    outlets = [parameter(f"k{i}", OUTLET_1_PER_MIN, "m2/min", (0.0, 1.0), f"outlet {i}") for i in (1, 2)]
    (f1, f2), (h1, h2), (k1, k2) = ([item.symbol for item in items] for items in (flows, levels, outlets))
    rates = (f1 - k1 * h1, f2 + 0.5 * k1 * h1 - k2 * h2)
    outputs = tuple(Output(item.name, "m", item.symbol) for item in levels)
    return ProcessModel("two_tanks", tuple(levels), tuple(flows), tuple(outlets), rates, outputs, new_clock())


def record_of_two_tanks(seed: int, rows: int = 1000, wander: tuple[float, float] = (0.012, 0.012)) -> Record:
    """Levels with noise of 0.01 m, while flows wander unseen about what is recorded of them, by so many m3/min."""
    rng = np.random.default_rng(seed)
    flows = np.repeat(rng.uniform(0.5, 1.5, (rows // 50, 2)), 50, axis=0)
    gain = np.sqrt(1.0 - KEPT**2)
    deviations = wander * lfilter([gain], [1.0, -KEPT], rng.standard_normal((rows, 2)), axis=0)
    a = OUTLET_1_PER_MIN * np.array([[-1.0, 0.0], [0.5, -1.0]])
    step = expm(PERIOD_MIN * a)
    held, levels = np.linalg.solve(a, step - np.eye(2)), [np.array([5.0, 7.5])]
    for flow in (flows + deviations)[:-1]:
        levels.append(step @ levels[-1] + held @ flow)
    shown = np.array(levels) + 0.01 * rng.standard_normal((rows, 2))
    columns = {"F1": flows[:, 0], "F2": flows[:, 1], "h1": shown[:, 0], "h2": shown[:, 1]}
    return Record(PERIOD_MIN * np.arange(rows, dtype=np.float64), columns, "two tanks")
