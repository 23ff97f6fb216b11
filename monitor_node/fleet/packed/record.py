"""Record of a plant in a fleet, beside the numbers of its stages: pending samples, counts, newest rows."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import DTypeLike, NDArray

from monitor_node.baseline.promise import NUMBERS
from monitor_node.ingest.sampling import SPACING
from monitor_node.signal_checks.timeout import RECEIPTS

Records: TypeAlias = NDArray[np.void]
Array: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Places: TypeAlias = NDArray[np.int32]
Bytes: TypeAlias = NDArray[np.uint8]

LEVELS = 64
"""Values of an input that the kept rows tell apart by a byte; the byte is this number for any other. An input that is
held for ten rows on average has 60 in 600."""

MOST_SIGNALS = 31
"""Signals of a plant whose arrival fits the bits of `have`."""


def record_type(inputs: int, outputs: int, states: int) -> np.dtype[Any]:
    """Type of a plant's record.

    Args:
        inputs: number of inputs.
        outputs: number of monitored outputs.
        states: number of states of the model.
    """
    signals, noise = inputs + outputs, outputs + states
    f, i, u = np.float64, np.int64, np.uint64
    columns: list[tuple[str, DTypeLike, tuple[int, ...]]] = [
        # samples on their way into a row
        ("expected", i, (signals,)),  # sequence numbers
        ("unit", u, (signals,)),
        ("runs", SPACING, (signals,)),  # usual spacings of the samples
        ("heard_from_ns", i, (signals,)),
        ("values", f, (signals,)),
        ("pending_ns", i, ()),
        ("left_ns", i, ()),  # time of the row that was emitted last
        ("have", np.int32, ()),  # signals of the pending row that have arrived, a bit each
        ("left", np.int32, ()),  # number of emitted rows that are remembered
        ("shut", np.int32, ()),  # 1: from here on, samples are for the plant's own monitor
        ("odd", np.int32, ()),  # 1: so are rows
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
        ("receipts", RECEIPTS, ()),
        ("spacing_ns", i, ()),  # interval before the newest row
        # constants of the plant
        ("arl0", f, ()),
        ("width", f, (outputs,)),
        ("promise", f, (NUMBERS,)),  # see `PromiseState`; 0: there is none
        ("reach", f, (inputs,)),  # see `references.input_reach`
        ("noise", f, (noise,)),  # standard deviations, of sensors and process
        ("typical_sd", f, (outputs,)),
        # the newest rows, in a ring
        ("kept", np.int32, ()),
        ("head", np.int32, ()),  # where the next one goes
        ("unit_ns", i, ()),  # unit of the kept spacings
        ("usual_ns", i, ()),  # spacing that is kept as 0
        ("reference", i, (outputs,)),  # bits of values that outputs had, see `ring`
        ("levels", i, (inputs, LEVELS)),
        ("level_rows", np.int16, (inputs, LEVELS)),
    ]
    return np.dtype([(name, kind, shape) for name, kind, shape in columns], align=True)
