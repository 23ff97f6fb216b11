"""Drop samples that were already processed before a restart.

A resumed monitor queries the history of its plant. It starts with samples that the stored state includes, followed by
those since the state was stored. A plant numbers the samples of each signal. So a sample was processed before

- if the state has the row of its time, with this sequence number of the signal; or
- if its row is older than any in the state, and neither its number nor its time is beyond the newest.

The first sample beyond the newest ends the filter for its signal. So does one with another number than the state has
for its time: then the plant was restarted with its clock set back. A sample that is missing in its row of the state was
not processed, and passes.
"""

from dataclasses import replace

from monitor_node.ingest.alignment import AlignmentState
from reactorwatch.runtime.delivery.gap_tracker import GapTracker


class ReplayFilter:
    """Filter of samples that were processed before a restart.

    Args:
        state: state of the alignment as stored.
    """

    def __init__(self, state: AlignmentState) -> None:
        self._newest: list[GapTracker | None] = [
            None if item.expected is None else replace(item) for item in state.sequences
        ]
        waiting = {time_ns: row.numbers for time_ns, row in state.pending.items()}
        self._numbers = {time_ns: list(numbers) for time_ns, numbers in (state.left | waiting).items()}

    @property
    def is_done(self) -> bool:
        """True if every signal has passed its newest processed sample."""
        return not any(self._newest)

    def is_duplicate(self, index: int, time_ns: int, sequence: int) -> bool:
        """True if a sample was processed before.

        Args:
            index: index of the signal in the rows.
            time_ns: sample time.
            sequence: sequence number.
        """
        newest = self._newest[index]
        if newest is None:
            return False
        numbers = self._numbers.get(time_ns)
        if numbers is not None and numbers[index] is None:
            return False
        known = numbers is not None and numbers[index] == sequence
        older = numbers is None and newest.is_past(sequence, time_ns)
        if not (known or older):
            self._newest[index] = None
        return known or older
