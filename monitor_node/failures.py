"""Errors of this software in the work on one plant: contained at the plant's border, counted, and reported once.

A monitor has to outlive its own errors, and one plant of a fleet those of another. So an exception in a stage is caught
where the work on a plant begins. It costs that plant the stage's memory. It is counted by stage in `Health.failures`,
and reported once for each place in the code that it comes from, with its cause.
"""

import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field

from reactorwatch.errors import InputError

LONGEST_CAUSE = 300
"""Characters of an exception's own text in a report; a value in it may be of any length."""


@dataclass
class Failures:
    """Counts of contained exceptions, and reports of those that are new.

    Attributes:
        by_stage: number of exceptions since the plant was first watched, by stage.
        notes: lines for people that are not reported yet, oldest first; the reader empties it.
        tracebacks: tracebacks of the same exceptions, oldest first; the reader empties it.
        passes: exceptions that are not contained. Of a monitor of its own these are settings that cannot be kept, which
            its user is told; in a fleet they are those of one plant.
    """

    by_stage: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    tracebacks: list[str] = field(default_factory=list)
    passes: type[Exception] | tuple[()] = InputError
    _reported: set[str] = field(default_factory=set)

    def add(self, stage: str, error: Exception, cost: str) -> None:
        """Count an exception, and report it if none came from the same place before.

        Args:
            stage: the part of the work that failed.
            error: the exception.
            cost: what the plant loses by it, as the end of a sentence.

        Raises:
            Exception: the exception, where it is one that passes.
        """
        if isinstance(error, self.passes):
            raise error
        self.by_stage[stage] = self.by_stage.get(stage, 0) + 1
        frame = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{type(error).__name__} in {frame.name}, line {frame.lineno} of {frame.filename.rsplit('/', 1)[-1]}"
        if place in self._reported:
            return
        self._reported.add(place)
        cause = " ".join(str(error).split())[:LONGEST_CAUSE]
        self.notes.append(f"error of this software in the stage {stage}: {place}: {cause}; {cost}; please report it")
        self.tracebacks.append("".join(traceback.format_exception(error)))

    def restore(self, by_stage: Mapping[str, int]) -> None:
        """Resume the counts of an earlier process."""
        self.by_stage = dict(by_stage)
