"""Alignment of samples of many plants, compiled, for samples in order; others are for `SequenceCheck` and `Aligner`.

A sample that is not good, or not the next of its signal, shuts the record: it and all after it are for the plant's own
monitor.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from monitor_node.fleet.packed.record import Array, Ints, Places, Records
from monitor_node.ingest.receive_stats import HEARD_AGAIN_NS
from monitor_node.ingest.sample_limits import LARGEST_NUMBER, LARGEST_VALUE
from monitor_node.ingest.sampling import learn_spacing
from monitor_node.ingest.sequence_check import LIKE, UNLIKE, compare_spacing
from monitor_node.ingest.sequence_check import MEMORY as RUN_MEMORY
from monitor_node.signal_checks.timeout import LEARN_FROM, receive, timeout_ns
from reactorwatch.codegen.numba_kernel import jit


@jit
def _follows(p: Any, signal: int, time_ns: int) -> bool:
    """Accept the sample with the next number into the run of its signal; as `SequenceCheck.accept_next`."""
    usual, spacing_ns = p.runs[signal], float(time_ns - p.left_ns)
    found = compare_spacing(usual, spacing_ns)
    if found == LIKE:
        learn_spacing(usual, spacing_ns, RUN_MEMORY)
    return bool(found != UNLIKE)


@jit
def take_samples(
    plants: Records,
    codes: Places,
    plain: NDArray[np.bool_],
    time_ns: Ints,
    sequence: Ints,
    value: Array,
    unit: NDArray[np.uint64],
    received_ns: Ints,
    now_ns: int,
    silence_limit: float,
    least_ns: int,
    most_left: int,
    rows: Places,
    row_time_ns: Ints,
    row_values: Array,
    others: Places,
) -> tuple[int, int]:
    """Align samples to rows.

    Args:
        plants: records, shape (plants,).
        codes: slot times the number of signals plus the index of the signal, of each sample; -1: of another plant.
        plain: True for each usable sample.
        time_ns: sample times.
        sequence: sequence numbers.
        value: values.
        unit: digests of the units.
        received_ns: receive times.
        now_ns: present time.
        silence_limit: see `DataTimeout`.
        least_ns: least allowed receive time without a sample.
        most_left: number of emitted rows that are remembered.
        rows: filled with the slot of each row.
        row_time_ns: filled with its time.
        row_values: filled with its values, the inputs first.
        others: filled with the indices of samples that are not processed.

    Returns:
        Number of rows, and of samples that are not processed.
    """
    signals = row_values.shape[1]
    whole = (1 << signals) - 1
    count, left_over = 0, 0
    for k in range(codes.size):
        if codes[k] < 0:
            others[left_over] = k
            left_over += 1
            continue
        slot, signal = codes[k] // signals, codes[k] % signals
        p = plants[slot]
        bit = 1 << signal
        fits = plain[k] and not p.shut and unit[k] == p.unit[signal] and abs(value[k]) < LARGEST_VALUE
        fits = fits and sequence[k] == p.expected[signal] and not p.have & bit and time_ns[k] > p.left_ns
        fits = fits and sequence[k] < LARGEST_NUMBER and abs(time_ns[k]) < LARGEST_NUMBER
        fits = fits and (not p.have or time_ns[k] == p.pending_ns)
        if not (fits and _follows(p, signal, time_ns[k])):
            p.shut = 1
            others[left_over] = k
            left_over += 1
            continue
        p.received += 1
        if received_ns[k] and now_ns - received_ns[k] > p.lag_ns:
            p.lag_ns = now_ns - received_ns[k]
        if now_ns >= p.heard_ns + HEARD_AGAIN_NS:
            p.heard_ns = now_ns
            receive(p.receipts, now_ns, silence_limit, least_ns)
        p.expected[signal] += 1
        p.values[signal] = value[k]
        p.pending_ns = time_ns[k]
        p.have |= bit
        if p.have == whole:
            rows[count] = slot
            row_time_ns[count] = time_ns[k]
            for place in range(signals):
                row_values[count, place] = p.values[place]
            p.have = 0
            p.left_ns = time_ns[k]
            p.left = min(p.left + 1, most_left)
            p.counts[0] += 1
            count += 1
    return count, left_over


@jit
def find_deadlines(plants: Records, numbers: Records, silence_limit: float, least_ns: int) -> Ints:
    """Time by slot at which the plant's data timeout expires, as `DataTimeout.due_ns`; never where there is none."""
    due_ns = np.empty(plants.size, np.int64)
    for slot in range(plants.size):
        receipts = plants[slot].receipts
        allowed = timeout_ns(receipts, silence_limit, least_ns)
        is_known = allowed >= 0 and numbers[slot].timeouts[0].spacing.count >= LEARN_FROM
        due_ns[slot] = receipts.received_ns + allowed if is_known else np.int64(2**63 - 1)
    return due_ns
