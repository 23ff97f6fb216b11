"""Rows, and what the monitor remembers of them while samples become rows."""

from dataclasses import dataclass
from typing import NamedTuple

from msgspec import field

from monitor_node.ingest.sampling import Interval
from reactorwatch.contract.codec import Publication
from reactorwatch.runtime.delivery.gap_tracker import GapTracker
from reactorwatch.stored_state import Memory

REMEMBERED = 4  # times the reordering: emitted rows kept to detect duplicates; step back that means a restart


class Row(NamedTuple):
    """Measured values of one time.

    Attributes:
        time_ns: sample time.
        values: one value a signal, in the order of the aligner's signals; NaN if missing.
        restarted: True for the first row of a new run of the publisher.
    """

    time_ns: int
    values: tuple[float, ...]
    restarted: bool


@dataclass(slots=True)
class MeasuredRow:
    """A row on its way through the stages of the pipeline.

    Attributes:
        time_ns: sample time.
        inputs: one value an input; NaN if missing.
        values: one value an output; NaN if missing, or if the signal checks found that it is no measurement.
        units: units of the outputs.
        interval: interval before the row.
        follows: True if the row is one sampling period after its predecessor in the same run.
        publications: publications because of the row so far.
    """

    time_ns: int
    inputs: tuple[float, ...]
    values: list[float]
    units: list[str]
    interval: Interval
    follows: bool
    publications: list[Publication]


class Counts(Memory):
    """Counts of samples and rows by what happened to them."""

    rows: int = 0
    incomplete_rows: int = 0
    late: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    lost: int = 0
    restarts: int = 0


class PendingRow(Memory):
    """A row that is not emitted yet.

    Attributes:
        values: one value a signal; NaN where not received.
        numbers: sequence number of each value; None where not received.
        missing: number of values not received.
    """

    values: list[float]
    numbers: list[int | None]
    missing: int


class AlignmentMemory(Memory):
    """Memory of an aligner.

    Attributes:
        pending: pending rows by time.
        emitted: sequence numbers of the rows emitted last, by time, oldest first; None where a sample was missing.
        newest_emitted_ns: time of the row emitted last; None before the first.
        newest_numbers: sequence numbers of that row, extrapolated where missing; None before the first.
        sequences: position in the run of each signal.
        restarted: True if the next row is the first of a new run.
        counts: counts so far.
    """

    pending: dict[int, PendingRow] = field(default_factory=dict)
    emitted: dict[int, list[int | None]] = field(default_factory=dict)
    newest_emitted_ns: int | None = None
    newest_numbers: list[int | None] = field(default_factory=list)
    sequences: list[GapTracker] = field(default_factory=list)
    restarted: bool = True
    counts: Counts = field(default_factory=Counts)
