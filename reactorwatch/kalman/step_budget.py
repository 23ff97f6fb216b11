"""A budget of filter steps for a search.

The cost of a search is bounded by its work and not by a clock: so it stops at the same step on every machine, and a
replay gives the results of the live run bit for bit. The unit is a row filtered by machine code, about a microsecond;
other work counts as many units as it took rows' time when it was measured.
"""

STEPS_PER_RUN = 100
"""Steps for a run of a filter over a record of any length: its set-up and its results."""

STEPS_PER_EVALUATION = 200
"""Steps for an evaluation of a hypothesis besides the run of its filter, and one for ten rows: signals and layout."""

STEPS_PER_LINEARISATION = 300
"""Steps for a linearisation of a filter about its run, besides three for two rows."""

STEPS_PER_COVARIANCE = 350
"""Steps for the covariance of a hypothesis's parameters."""

STEPS_PER_ROW = 25
"""Steps for a row that is filtered by itself."""

STEPS_PER_PREDICTION = 3
"""Steps for two integration steps before the last two of an interval."""

STEPS_PER_START = 250
"""Steps for a start of the filter, which also stops the machine code. A row without a measurement, at which the filter
waits, costs no more than any row by itself."""

STEPS_PER_SEARCH = 12_000
"""Steps for a search for steady states, from which a filter starts where measurements do not determine the state."""


class BudgetExceededError(Exception):
    """The budget of filter steps is spent; the search ends here."""


class StepBudget:
    """A number of filter steps.

    Args:
        steps: number of steps, at least 1.

    Attributes:
        spent: number of steps taken so far.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self.spent = 0

    def spend(self, steps: int) -> None:
        """Count steps.

        Raises:
            BudgetExceededError: the budget would be exceeded; then nothing is counted, as nothing is done.
        """
        if self.spent + steps > self._steps:
            raise BudgetExceededError(f"the budget of {self._steps} filter steps is spent")
        self.spent += steps
