"""Which samples a monitor that goes on from a stored state had heard before it stopped.

Between the last time that the state was stored and the end, a monitor heard samples that the state does not know. They
come again if the plant still remembers them, and before them others which the state does know. A plant counts the
samples of each signal, so these are told by their numbers. A sample was heard before the stop

- if the state knows the row of its time, and this number of the signal in it; or
- if its row is older than any that the state knows, and neither its number nor its time is beyond the newest.

The first sample of a signal that is beyond ends it for that signal, and so does one with another number than the state
knows of its time: then it is another run of the plant, whose clock was set back. A sample whose row the state knows
without it was missing then, and may be taken.
"""

from monitor_node.ingest.alignment import AlignmentState


class ToldAgain:
    """Knows the samples that were heard before a stop.

    Args:
        state: of the alignment at the stop.
    """

    def __init__(self, state: AlignmentState) -> None:
        self._newest: list[tuple[int, int] | None] = [
            None if item.expected is None else (item.expected, item.newest_ns) for item in state.sequences
        ]
        waiting = {time_ns: row.numbers for time_ns, row in state.pending.items()}
        self._numbers = {time_ns: list(numbers) for time_ns, numbers in (state.left | waiting).items()}

    @property
    def is_over(self) -> bool:
        """Whether every signal has come beyond what was heard before."""
        return not any(self._newest)

    def heard(self, index: int, time_ns: int, sequence: int) -> bool:
        """Whether it was heard before.

        Args:
            index: of the signal, as in the rows.
            time_ns: of the sample.
            sequence: its number.
        """
        newest = self._newest[index]
        if newest is None:
            return False
        numbers = self._numbers.get(time_ns)
        if numbers is not None and numbers[index] is None:
            return False
        known = numbers is not None and numbers[index] == sequence
        older = numbers is None and sequence < newest[0] and time_ns <= newest[1]
        if not (known or older):
            self._newest[index] = None
        return known or older
