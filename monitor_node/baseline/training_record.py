"""The rows that a reference was learned from: were they fit to learn from?"""

import numpy as np
from numpy.typing import NDArray

from reactorwatch.contract.messages_pb2 import Check
from reactorwatch.errors import InputError
from reactorwatch.identification.excitation import check_record
from reactorwatch.identification.identify import WORST_MINUS_LOG10_P
from reactorwatch.identification.residual_tests import ResidualTest, independence, whiteness
from reactorwatch.identification.structure import Structure

Array = NDArray[np.float64]


def checks_of(structure: Structure, time_min: Array, inputs: Array, outputs: Array, residual: Array) -> list[Check]:
    """What can be said of the rows and of the model they gave.

    Args:
        structure: of the model.
        time_min: shape (rows,).
        inputs: shape (rows,).
        outputs: shape (rows,).
        residual: shape (rows,), of one step; NaN where there is none.
    """
    try:
        found = [
            Check(name=check.name, result=check.result) for check in check_record(structure, inputs, outputs, time_min)
        ]
        if found[-1].name != "variation":
            found.append(_tested(whiteness(residual, fitted=structure.output_lags)))
            found.append(_tested(independence(residual, inputs, structure.delay, time=time_min)))
    except InputError as error:  # too few rows without a gap: no fault of the plant's, but worth being told
        found = [Check(name="record", result=str(error))]
    return found


def _tested(test: ResidualTest) -> Check:
    left_out = f"the model leaves something out: -log10 p = {test.minus_log10_p:.1f}"
    return Check(name=test.name, result="ok" if test.minus_log10_p < WORST_MINUS_LOG10_P else left_out)
