"""The magnitude of an effect that shifts the input timing (`ProcessModel.time_offset`), as signals.

The states depend on the rate at which the shift grows, a row on its value. It grows no faster than time passes, for
nothing acts before it has set in: after a step the states first stand still for as long as the shift is large.
"""

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.profiles import Signal


def effective_timing(signal: Signal, time_min: Array) -> Signal:
    """Split a timing offset into its rate, which acts on the states, and its value, which acts on the outputs.

    Args:
        signal: the magnitude in minutes, shape (rows,).
        time_min: times of the rows, shape (rows,).

    Returns:
        Rate over each interval in min/min, and value at each row in min.
    """
    ahead, step = np.maximum(signal.sample_value, 0.0), np.diff(time_min)
    rise = np.diff(ahead)
    # The mean over an interval with a jump gives the time since the jump.
    with np.errstate(divide="ignore", invalid="ignore"):
        since = step * np.clip((signal.interval_mean[:-1] - ahead[:-1]) / rise, 0.0, 1.0)
    for row in np.flatnonzero(rise > since).tolist():
        later, most = row + 1, ahead[row] + since[row]
        while later < ahead.size and ahead[later] > most:
            ahead[later] = most
            later, most = later + 1, most + step[min(later, step.size - 1)]
    return Signal(np.append(np.diff(ahead) / step, 0.0), ahead)
