"""Errors of this software in the work on one plant: contained at the plant's border, counted, and reported once.

A monitor must survive its own errors, and a plant of a fleet those of another. So an exception in a stage is caught
where the work on a plant starts. It costs that plant the stage's state. It is counted by stage in `Health.failures`,
and reported once for each line of code that raises it, with its cause.
"""

import traceback
from dataclasses import dataclass, field

from reactorwatch.errors import InputError

LONGEST_CAUSE = 300
"""Characters of an exception's own text in a report; a value in it may be of any length."""


@dataclass
class Failures:
    """Counts of contained exceptions, and reports of those that are new.

    Attributes:
        by_stage: number of exceptions since the plant was first watched, by stage.
        notes: notes to log, oldest first; the caller empties the list.
        tracebacks: tracebacks of the same exceptions, oldest first; the caller empties the list.
        passes: exceptions that are not contained. In the monitor of one plant these are impossible settings, which its
            user must see; in a fleet they concern one plant, and are contained.
    """

    by_stage: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    tracebacks: list[str] = field(default_factory=list)
    passes: type[Exception] | tuple[()] = InputError
    _reported: set[str] = field(default_factory=set)

    def add(self, stage: str, error: Exception, cost: str) -> None:
        """Count an exception, and report it if it is the first from its line of code.

        Args:
            stage: the part of the work that failed.
            error: the exception.
            cost: consequence for the plant, as the end of a sentence.

        Raises:
            Exception: the exception, if it passes.
        """
        if isinstance(error, self.passes):
            raise error
        self.by_stage[stage] = self.by_stage.get(stage, 0) + 1
        frame = traceback.extract_tb(error.__traceback__)[-1]
        origin = f"{type(error).__name__} in {frame.name}, line {frame.lineno} of {frame.filename.rsplit('/', 1)[-1]}"
        if origin in self._reported:
            return
        self._reported.add(origin)
        cause = " ".join(str(error).split())[:LONGEST_CAUSE]
        self.notes.append(f"error of this software in the stage {stage}: {origin}: {cause}; {cost}; please report it")
        self.tracebacks.append("".join(traceback.format_exception(error)))
