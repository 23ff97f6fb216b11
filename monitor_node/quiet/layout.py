"""The form of a plant's record: all that changes from row to row, as numbers in one line of an array."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import DTypeLike, NDArray

from monitor_node.signal_checks.stuck import MOVEMENT_STEPS
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.prewhitening import LARGEST_ORDER

Records: TypeAlias = NDArray[np.void]
Array: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Places: TypeAlias = NDArray[np.int32]
Bytes: TypeAlias = NDArray[np.uint8]

LEVELS = 64
"""Values of the input that the kept rows tell apart by a byte; the byte is this number for any other. An input that is
held for ten rows on average has 60 in 600."""


def record_type(outputs: int, states: int, alarms: int) -> np.dtype[Any]:
    """The form of a plant's record.

    Args:
        outputs: how many are watched.
        states: of its model.
        alarms: how many its charts can raise.
    """
    signals, memory, noise = outputs + 1, states + states**2, outputs + states
    f, i, u = np.float64, np.int64, np.uint64
    columns: list[tuple[str, DTypeLike, tuple[int, ...]]] = [
        # samples on their way into a row
        ("expected", i, (signals,)),  # sequence numbers
        ("unit", u, (signals,)),
        ("run_spacing_ns", f, (signals,)),
        ("run_deviation_ns", f, (signals,)),
        ("heard_from_ns", i, (signals,)),
        ("values", f, (signals,)),
        ("pending_ns", i, ()),
        ("left_ns", i, ()),  # time of the row that left last
        ("have", np.int32, ()),  # which signals of the pending row have come, a bit each
        ("left", np.int32, ()),  # rows that left and are remembered
        ("shut", np.int32, ()),  # from here on, samples are for the plant's own monitor
        ("odd", np.int32, ()),  # likewise, rows
        # counts and times
        ("received", i, ()),
        ("published", i, ()),
        ("ticked", np.int32, ()),
        ("stalls", np.int32, ()),
        ("not_stored", i, ()),
        ("counts", i, (7,)),
        ("rows_watched", i, ()),
        ("first_ns", i, ()),
        ("watching_since_ns", i, ()),
        ("began_ns", i, ()),
        ("start_ns", i, ()),
        ("lag_ns", i, ()),
        ("heard_ns", i, ()),
        ("health_due_ns", i, ()),
        ("kpi_minute", i, ()),
        ("arl0", f, ()),
        # how rows and samples come
        ("last_ns", i, ()),
        ("period_ns", f, ()),
        ("spacing_ns", i, ()),
        ("received_ns", i, ()),
        ("counted_ns", i, ()),
        ("receipt_mean", f, ()),
        ("receipt_deviation", f, ()),
        ("receipt_count", np.int32, ()),
        ("silence_count", np.int32, (signals + 1,)),
        ("silence_mean", f, (signals + 1,)),
        ("silence_deviation", f, (signals + 1,)),
        # the filter
        ("time_min", f, ()),
        ("input", f, ()),
        ("reach", f, ()),  # see `references.input_reach`
        ("memory", f, (memory,)),
        ("noise", f, (noise,)),  # standard deviations, of sensors and process
        ("variance", f, (noise,)),
        ("typical_sd", f, (outputs,)),
        # prewhitening
        ("order", np.int32, (outputs,)),
        ("learned_rows", np.int32, (outputs,)),
        ("constant", f, (outputs,)),
        ("coefficients", f, (outputs, LARGEST_ORDER)),
        ("sigma", f, (outputs,)),
        ("sigma_variance", f, (outputs,)),
        ("passed_variance", f, (outputs,)),
        ("past", f, (outputs, LARGEST_ORDER)),
        # spikes and stuck sensors; a limit that is infinite is none
        ("spike_limit", f, (outputs,)),
        ("equal_limit", f, (outputs,)),
        ("quietest", f, (outputs,)),
        ("last", f, (outputs,)),
        ("repeats", i, (outputs,)),
        ("steps", f, (outputs, MOVEMENT_STEPS)),  # oldest first
        ("stepped", np.int32, (outputs,)),
        # charts, as the columns of a bank without what comes in and goes out, and their alarms
        ("shewhart", f, (Shewhart.numbers, outputs)),
        ("width", f, (outputs,)),
        ("ewma", f, (Ewma.numbers, outputs)),
        ("cusum", f, (Cusum.numbers, outputs)),
        ("average", f, (outputs,)),
        ("mean", f, (outputs,)),
        ("covariance", f, (outputs, outputs)),
        ("whitening", f, (outputs, outputs)),
        ("mewma_limit", f, ()),
        ("recent", np.int32, (alarms,)),
        ("in_a_row", np.int32, (alarms,)),
        ("above", np.int32, (alarms,)),
        # the newest rows, in a ring
        ("kept", np.int32, ()),
        ("head", np.int32, ()),  # where the next one goes
        ("unit_ns", i, ()),  # that spacings are kept in
        ("usual_ns", i, ()),  # spacing that is kept as 0
        ("reference", i, (outputs,)),  # see `ring.Kept`
        ("levels", i, (LEVELS,)),
        ("level_rows", np.int32, (LEVELS,)),
    ]
    return np.dtype([(name, kind, shape) for name, kind, shape in columns], align=True)
