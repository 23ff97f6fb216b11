"""The size of an effect that moves the clock (`ProcessModel.time_offset`), as signals.

The states feel how fast such a size grows, and a row shows how large it is. It grows no faster than the clock goes,
for what has set in cannot act before it does: of a step the states first stand still for as long as it is large.
"""

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.profiles import Signal


def felt(signal: Signal, time_min: Array) -> Signal:
    """What states and outputs have of a size.

    Args:
        signal: the size, shape (rows,).
        time_min: of the rows, shape (rows,).

    Returns:
        How fast it grows from each row to the next one, min/min, and how large it is at the row, min.
    """
    ahead, step = np.maximum(signal.at_row, 0.0), np.diff(time_min)
    rise = np.diff(ahead)
    # What jumps in a row has been there since the jump, and the mean over the row tells how long.
    with np.errstate(divide="ignore", invalid="ignore"):
        since = step * np.clip((signal.over_row[:-1] - ahead[:-1]) / rise, 0.0, 1.0)
    for row in np.flatnonzero(rise > since).tolist():
        later, most = row + 1, ahead[row] + since[row]
        while later < ahead.size and ahead[later] > most:
            ahead[later] = most
            later, most = later + 1, most + step[min(later, step.size - 1)]
    return Signal(np.append(np.diff(ahead) / step, 0.0), ahead)
