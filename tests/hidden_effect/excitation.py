"""Excitation of the plant during the recording, and the form of the record."""

from dataclasses import dataclass

import numpy as np

from tests.hidden_effect.courses import Array
from tests.hidden_effect.plant import Controller

PERIOD_MIN = 0.1
MIDDLE_L_MIN = 103.41

LOW_NOISE, MEDIUM_NOISE, HIGH_NOISE = (0.0005, 0.05), (0.002, 0.3), (0.005, 1.0)
"""Of C in mol/l and of T in K."""

NO_PROCESS_NOISE, SMALL_PROCESS_NOISE, MEDIUM_PROCESS_NOISE = (0.0, 0.0), (0.0003, 0.1), (0.001, 0.3)
"""Of C and T, each in its unit per square root of a minute."""


@dataclass(frozen=True)
class Circumstances:
    """Under which a record is made.

    Attributes:
        input: `rich` (a new flow every minute), `few` (a handful of steps), `narrow` (every minute within 1 l/min),
            or `closed` (the temperature controlled, its set point stepping or its command dithered).
        span_min: of the record.
        noise_sd: of C and T, white.
        process_sd: of C and T.
        correlation: of the sensors' noise from row to row.
        missing: share of rows that are missing; a change of the input in one of them shows a row too late.
        missing_values: share of rows in which neither C nor T was measured; qc is known.
        irregular: largest share of the period that a row comes off its time.
        resolution: of C and T, to which they are rounded; 0: not.
        outliers: share of values that are far off.
        interpolated: whether qc went from row to row in straight lines.
        start: `settled`; `middle`, near the unstable steady state; or `extinguished`.
        background: size of two constant deviations of the plant that are not hidden but make it differ from the model,
            as a share of the smallest size that is worth finding; 0: there are none.
    """

    input: str = "rich"
    span_min: float = 750.0
    noise_sd: tuple[float, float] = MEDIUM_NOISE
    process_sd: tuple[float, float] = NO_PROCESS_NOISE
    correlation: float = 0.0
    missing: float = 0.0
    missing_values: float = 0.0
    irregular: float = 0.0
    resolution: tuple[float, float] = (0.0, 0.0)
    outliers: float = 0.0
    interpolated: bool = False
    start: str = "settled"
    background: float = 0.0


NAMED_CIRCUMSTANCES: dict[str, Circumstances] = {
    "medium": Circumstances(),
    "low noise": Circumstances(noise_sd=LOW_NOISE),
    "high noise": Circumstances(noise_sd=HIGH_NOISE),
    "few steps": Circumstances(input="few"),
    "narrow": Circumstances(input="narrow"),
    "closed loop": Circumstances(input="closed"),
    "missing rows": Circumstances(missing=0.05),
    "missing values": Circumstances(missing_values=0.05),
    "150 min": Circumstances(span_min=150.0),
    "process noise": Circumstances(process_sd=SMALL_PROCESS_NOISE),
    "more process noise": Circumstances(process_sd=MEDIUM_PROCESS_NOISE),
    "correlated noise": Circumstances(correlation=0.5),
    "irregular": Circumstances(irregular=0.45),
    "quantised": Circumstances(resolution=(0.002, 0.5)),
    "outliers": Circumstances(outliers=0.01),
    "wrong branch": Circumstances(start="middle"),
    "extinguished": Circumstances(start="extinguished"),
}


@dataclass(frozen=True, eq=False)
class Handling:
    """Operation of the plant.

    Attributes:
        time_min: times of the rows, shape (rows,).
        command: command in each row, l/min; with a controller the dither.
        controller: controller, if any.
        set_point_K: its set point in each row.
    """

    time_min: Array
    command: Array
    controller: Controller | None
    set_point_K: Array | None  # noqa: N815 # K is the unit


def handling(circumstances: Circumstances, rng: np.random.Generator) -> Handling:
    """Draw what is done to the plant."""
    rows = round(circumstances.span_min / PERIOD_MIN)
    time_min: Array = PERIOD_MIN * np.arange(rows, dtype=np.float64)
    if circumstances.irregular:
        off = rng.uniform(-circumstances.irregular, circumstances.irregular, rows)
        time_min = np.round(time_min + PERIOD_MIN * (off - off[0]) * (np.arange(rows) > 0), 6)
    minute = np.floor(PERIOD_MIN * np.arange(rows) + 1e-9).astype(int)
    if circumstances.input == "closed":
        return _closed(circumstances, time_min, minute, rng)
    if circumstances.input == "few":
        steps = int(rng.integers(5, 9))
        edges = np.sort(rng.uniform(0.05, 0.95, steps)) * circumstances.span_min
        levels = rng.uniform(92.0, 109.0, steps + 1)
        return Handling(time_min, levels[np.searchsorted(edges, time_min, "right")], None, None)
    half = 1.0 if circumstances.input == "narrow" else 10.5
    middle = MIDDLE_L_MIN if circumstances.input == "narrow" else 100.5
    levels = rng.uniform(middle - half, middle + half, minute[-1] + 1)
    levels[0] = min(levels[0], MIDDLE_L_MIN)
    return Handling(time_min, levels[minute], None, None)


def _closed(circumstances: Circumstances, time_min: Array, minute: Array, rng: np.random.Generator) -> Handling:
    controller = Controller(float(np.exp(rng.uniform(np.log(1.0), np.log(6.0)))), MIDDLE_L_MIN, 70.0, 130.0)
    set_point, dither = np.full(time_min.size, 438.54), np.zeros(time_min.size)
    if rng.random() < 0.5:
        count = int(np.ceil(circumstances.span_min / 5.0))
        set_point = rng.uniform(435.0, 445.0, count)[np.minimum(minute // 5, count - 1)]
    else:
        dither = rng.uniform(-6.0, 6.0, minute[-1] + 1)[minute]
    return Handling(time_min, dither, controller, set_point)
