"""The two heaters of docs/processes.md, which are not quite their model, or not quite measured as it assumes.

Classes: each temperature is read up to 5 s after its stamp (`skew`, one delay a sensor); the heaters move between two
rows, and a row has the power at its stamp (`moves`); each sensor follows its body with a lag of 5 to 20 s (`lag`);
the heat transfer and both heaters are 5 % off, either way (`constants`); the bodies' heat capacity is 5 % off
(`capacity`); temperatures are rounded to .25 K (`quantised`); and pairs of these.

Names accepted: a heater's power is `alpha1.deviation`, and `Q1.gain` is the same, because the equations have both only
as their product. All other causes differ in the equations: `Q1.offset` and `T1.source` add heat at any power, a room
that is colder takes heat that does not grow with the temperature, and `T1.gain` is no bias.
"""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.inexact.records import Array, Cause, Drawn, draw_moves, level_at

KINDS = ("skew", "moves", "lag", "constants", "capacity", "quantised")
PAIRS = tuple(combinations(KINDS, 2))
CAUSES = ("more loss", "less loss", "weaker heater", "stronger heater", "bias", "colder room")

NOMINAL = np.array([10.0, 23.0, 0.01, 0.0075])
"""U, Ta, alpha1 and alpha2 of the page."""

PERIOD_S, ROWS, NOISE_K = 2.0, 1200, 0.1
SETTLING_S = 1800.0
"""Time with the first powers before the first row: some fourteen time constants of a body."""

PAGE = Path(__file__).parents[2] / "docs" / "processes.md"


def process_file() -> str:
    """Text of the page's process file, as a user copies it."""
    _, _, rest = PAGE.read_text(encoding="utf-8").partition("<!-- run: file tclab.py -->\n```python\n")
    return rest.partition("```")[0]


def kinds_of(seed: int, number: int) -> tuple[str, ...]:
    """Choose the kinds of inexactness of a record: of five records three have one kind and two have a pair, in turn."""
    block, index = divmod(number, 5)
    if index < 3:
        return (KINDS[(3 * block + index) % len(KINDS)],)
    order = np.random.default_rng([seed, 2]).permutation(len(PAIRS))
    return PAIRS[int(order[(2 * block + index - 3) % len(PAIRS)])]


def draw(seed: int, number: int, sound: bool) -> Drawn:
    """Draw a record."""
    rng = np.random.default_rng([seed, int(sound), number])
    kinds, end_s = kinds_of(seed, number), PERIOD_S * ROWS
    off_by: dict[str, float] = {}

    def off(kind: str, name: str) -> float:
        if kind in kinds:
            off_by[name] = float(rng.choice((-0.05, 0.05)))
        return 1.0 + off_by.get(name, 0.0)

    plant = NOMINAL * [off("constants", "U"), 1.0, off("constants", "alpha1"), off("constants", "alpha2")]
    heat_capacity = 0.004 * 500.0 * off("capacity", "heat capacity")
    grid = None if "moves" in kinds else PERIOD_S
    moves = [draw_moves(rng, end_s, (180.0, 480.0), (10.0, 80.0), grid) for _ in range(2)]
    onset_s = float(rng.uniform(0.3, 0.7) * end_s)
    cause, faulty, bias = (None, plant, np.zeros(2)) if sound else _draw_cause(rng, seed, number, plant, onset_s)
    lags = rng.uniform(5.0, 20.0, 2) if "lag" in kinds else np.zeros(2)
    skews = rng.uniform(0.5, 5.0, 2) if "skew" in kinds else np.zeros(2)
    off_by |= {f"T{i + 1}.lag_s": float(lags[i]) for i in range(2) if lags[i]}
    off_by |= {f"T{i + 1}.skew_s": float(skews[i]) for i in range(2) if skews[i]}

    def rates(time_s: float, x: Array) -> Array:
        powers = np.array([level_at(item, time_s) for item in moves])
        heat = _heat(faulty if time_s >= onset_s else plant, x[:2], powers)
        return np.concatenate([heat / heat_capacity, (x[:2] - x[2:]) / np.where(lags > 0.0, lags, 1.0)])

    settings: Any = {"dense_output": True, "rtol": 1e-9, "atol": 1e-9, "max_step": 20.0}
    solution: Any = solve_ivp(rates, (-SETTLING_S, end_s + 10.0), [23.0] * 4, "DOP853", **settings).sol
    time_s = PERIOD_S * np.arange(ROWS, dtype=np.float64)
    columns = {"Time (sec)": time_s}
    columns |= {f"Heater {i + 1} (%)": level_at(moves[i], time_s) for i in range(2)}
    for i in range(2):
        read_s = time_s + skews[i]
        value = solution(read_s)[2 + i if lags[i] else i] + bias[i] * (read_s >= onset_s)
        value += NOISE_K * rng.standard_normal(ROWS)
        step = 0.25 if "quantised" in kinds else 0.001  # of a logger that writes millidegrees
        columns[f"Temperature {i + 1} (degC)"] = np.round(value / step) * step
    group = kinds[0] if len(kinds) == 1 else "pairs"
    inexact = {"kinds": kinds, **off_by}
    return Drawn("two_heaters", group, seed, number, process_file(), columns, PERIOD_S / 60.0, cause, inexact)


def _heat(plant: Array, T: Array, powers: Array) -> Array:
    """Heat that each body gains, W."""
    U, Ta, *alphas = plant
    K = T + 273.15
    to_room = 0.001 * (U * (T - Ta) + 5.1e-8 * (K**4 - (Ta + 273.15) ** 4))
    across = 0.0002 * (U * (T[0] - T[1]) + 5.1e-8 * (K[0] ** 4 - K[1] ** 4))
    return np.asarray(np.array(alphas) * powers - to_room + np.array([-across, across]))


def _draw_cause(
    rng: np.random.Generator, seed: int, number: int, plant: Array, onset_s: float
) -> tuple[Cause, Array, Array]:
    """Draw a cause; returns it, the plant's constants since then, and the sensors' biases since then."""
    block, index = divmod(number, len(CAUSES))
    kind = CAUSES[int(np.random.default_rng([seed, 3, block]).permutation(len(CAUSES))[index])]
    faulty, bias = plant.copy(), np.zeros(2)
    which, onset_min = int(rng.integers(2)), onset_s / 60.0
    if kind == "bias":
        bias[which] = rng.choice((-1.0, 1.0)) * rng.uniform(1.0, 3.0)
        return Cause((f"T{which + 1}.bias",), (float(bias[which]),), "degC", onset_min), faulty, bias
    if kind == "colder room":
        fall = float(rng.uniform(2.0, 5.0))
        faulty[1] -= fall
        return Cause(("Ta.deviation",), (-fall,), "degC", onset_min), faulty, bias
    sign = 1.0 if kind in ("more loss", "stronger heater") else -1.0
    names: tuple[str, ...]
    if kind.endswith("loss"):
        constant, names, size = 0, ("U.deviation",), sign * rng.uniform(0.20, 0.35)
    else:
        constant, names = 2 + which, (f"alpha{which + 1}.deviation", f"Q{which + 1}.gain")
        size = sign * rng.uniform(0.10, 0.25)
    faulty[constant] *= 1.0 + size
    return Cause(names, (size, float(size * plant[constant] / NOMINAL[constant])), "1", onset_min), faulty, bias
