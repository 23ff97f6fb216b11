"""A budget for runs of filters, counted in filter steps.

What a search may cost is bounded by the work itself and not by a clock: so it stops at the same step on every machine,
and a replay gives the results of the live run bit for bit. The unit is a row that is filtered by machine code, about a
microsecond; the other kinds of work count as many units as they took rows' time when they were measured.
"""

A_RUN = 100
"""Steps for a run of a filter over a record, whatever its length: it is laid out and its results are taken apart."""

A_ROW_ALONE = 25
"""Steps for a row that is filtered by itself."""

A_WALK = 3
"""Steps for two integration steps on the way to such a row, other than the last two."""

A_BEGINNING = 250
"""Steps for a filter that begins at what is measured, and for the stop of the machine code that this is. Where nothing
is measured it waits, which costs no more than a row by itself."""

A_SEARCH = 12_000
"""Steps for a search for steady states, from which a filter begins where measurements do not give the whole state."""


class StepsSpentError(Exception):
    """A budget of filter steps is spent: the search that it was for stops here."""


class StepBudget:
    """Filter steps that may be taken yet.

    Args:
        steps: their number, at least 1.

    Attributes:
        spent: number of steps taken so far.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self.spent = 0

    def spend(self, steps: int) -> None:
        """Count steps.

        Raises:
            StepsSpentError: there are not as many left.
        """
        self.spent += steps
        if self.spent > self._steps:
            raise StepsSpentError(f"the budget of {self._steps} filter steps is spent")
