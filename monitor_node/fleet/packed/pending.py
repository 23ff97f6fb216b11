"""Conversion of the state of sequence checks and alignment to and from a record."""

from dataclasses import astuple

import numpy as np

from monitor_node.ingest.alignment import AlignmentState, Counts, PendingRow
from monitor_node.ingest.sampling import Spacing
from monitor_node.ingest.sequence_check import MEMORY as FULL_RUN
from monitor_node.ingest.sequence_check import SequenceCheck
from reactorwatch.runtime.delivery.gap_tracker import GapTracker


def is_in_order(alignment: AlignmentState) -> bool:
    """True if no sample is missing, and at most one row is pending, the newest."""
    left_ns, newest = alignment.newest_left_ns, alignment.newest_numbers
    if alignment.restarted or left_ns is None or len(alignment.pending) > 1:
        return False
    pending_ns, waiting = next(iter(alignment.pending.items()), (left_ns, None))
    if waiting is not None and pending_ns <= left_ns:
        return False
    for place, (before, numbering) in enumerate(zip(newest, alignment.sequences, strict=True)):
        number = None if waiting is None else waiting.numbers[place]
        last, last_ns = (before, left_ns) if number is None else (number, pending_ns)
        if before is None or last is None or (number is not None and number != before + 1):
            return False
        if (numbering.expected, numbering.newest_ns) != (last + 1, last_ns):
            return False
    return True


def are_runs_complete(runs: list[SequenceCheck], alignment: AlignmentState) -> bool:
    """True if no sample is held, the usual spacings are known, and the runs are as far as the rows."""
    return all(
        not run.held
        and run.spacing.count == FULL_RUN
        and run.expected is not None
        and (run.expected, run.newest_ns) == (numbering.expected, numbering.newest_ns)
        for run, numbering in zip(runs, alignment.sequences, strict=True)
    )


def write_runs(p: np.void, runs: list[SequenceCheck]) -> None:
    """Write the sequence checks, which are as far as the rows, to a record."""
    p["runs"] = [run.spacing.numbers for run in runs]


def runs_of(p: np.void) -> list[SequenceCheck]:
    """Sequence checks of the signals."""
    runs: list[SequenceCheck] = []
    for place in range(len(p["expected"])):
        newest_ns = int(p["pending_ns"] if p["have"] >> place & 1 else p["left_ns"])
        spacing = Spacing.of_numbers(p["runs"][place])
        runs.append(SequenceCheck(int(p["expected"][place]), newest_ns, spacing=spacing))
    return runs


def write_alignment(p: np.void, alignment: AlignmentState) -> None:
    """Write the state of the alignment to a record."""
    p["expected"] = [numbering.expected or 0 for numbering in alignment.sequences]
    p["left"], p["left_ns"] = len(alignment.left), alignment.newest_left_ns or 0
    p["counts"] = astuple(alignment.counts)
    for pending_ns, waiting in alignment.pending.items():
        p["pending_ns"], p["values"] = pending_ns, waiting.values
        p["have"] = sum(1 << place for place, number in enumerate(waiting.numbers) if number is not None)


def alignment_of(p: np.void, times_ns: list[int]) -> AlignmentState:
    """State of the alignment.

    Args:
        p: record of the plant.
        times_ns: times of its emitted rows, the newest last.
    """
    signals = range(len(p["expected"]))
    have = [bool(p["have"] >> signal & 1) for signal in signals]
    expected, pending_ns, left_ns = p["expected"].tolist(), int(p["pending_ns"]), int(p["left_ns"])
    newest = [number - 1 - here for number, here in zip(expected, have, strict=True)]
    kept = times_ns[-int(p["left"]) :]
    left: dict[int, list[int | None]] = {
        time_ns: [number - age for number in newest]
        for age, time_ns in zip(range(len(kept) - 1, -1, -1), kept, strict=True)
    }
    pending = {}
    if any(have):
        values = [float(value) if here else float("nan") for value, here in zip(p["values"], have, strict=True)]
        numbers = [number - 1 if here else None for number, here in zip(expected, have, strict=True)]
        pending[pending_ns] = PendingRow(values, numbers, have.count(False))
    numbering = [
        GapTracker(number, pending_ns if here else left_ns) for number, here in zip(expected, have, strict=True)
    ]
    counts = Counts(*p["counts"].tolist())
    return AlignmentState(pending, left, left_ns, list(newest), numbering, False, counts)
