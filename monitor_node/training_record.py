"""The rows that a reference was learned from, kept until it is judged: were they fit to learn from?"""

from collections import deque

import numpy as np

from monitor_node.identification.excitation import check_record
from monitor_node.identification.identify import WORST_MINUS_LOG10_P
from monitor_node.identification.residual_tests import ResidualTest, independence, whiteness
from monitor_node.identification.structure import Structure
from reactorwatch.contract.messages_pb2 import Check
from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS

MOST_ROWS = 10_000
"""Of a training that is longer, the last so many are judged; memory stays bounded."""


class TrainingRecord:
    """Rows of one input and one output, with the one-step residual of each."""

    def __init__(self) -> None:
        self._rows: deque[tuple[int, float, float, float]] = deque(maxlen=MOST_ROWS)

    def add(self, time_ns: int, input_value: float, value: float, residual: float) -> None:
        """Take a row in; NaN where something is missing."""
        if self._rows and time_ns <= self._rows[-1][0]:  # the publisher began again: the record begins anew
            self._rows.clear()
        self._rows.append((time_ns, input_value, value, residual))

    def checks(self, structure: Structure) -> list[Check]:
        """What can be said of the rows and of the model they gave; then the rows are forgotten.

        Args:
            structure: of the model.
        """
        rows = np.array(self._rows, dtype=float)
        self._rows.clear()
        time_min, u, y, residual = rows[:, 0] / MINUTE_NS, rows[:, 1], rows[:, 2], rows[:, 3]
        try:
            found = [Check(name=check.name, result=check.result) for check in check_record(structure, u, y, time_min)]
            if found[-1].name != "variation":
                found.append(_tested(whiteness(residual, fitted=structure.output_lags)))
                found.append(_tested(independence(residual, u, structure.delay, time=time_min)))
        except InputError as error:  # too few rows without a gap: no fault of the plant's, but worth being told
            found = [Check(name="record", result=str(error))]
        return found


def _tested(test: ResidualTest) -> Check:
    left_out = f"the model leaves something out: -log10 p = {test.minus_log10_p:.1f}"
    return Check(name=test.name, result="ok" if test.minus_log10_p < WORST_MINUS_LOG10_P else left_out)
