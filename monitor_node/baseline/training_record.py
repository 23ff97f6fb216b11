"""Checks of the rows and the residuals of a training."""

from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Check
from reactorwatch.errors import InputError
from reactorwatch.identification.excitation import check_record
from reactorwatch.identification.identify import WORST_MINUS_LOG10_P
from reactorwatch.identification.residual_tests import ResidualTest, independence, whiteness
from reactorwatch.identification.structure import Structure


def check_training(
    structure: Structure, time_min: Array, inputs: Array, outputs: Array, residual: Array
) -> list[Check]:
    """Check the rows of a training and the model fitted to them.

    Args:
        structure: structure of the model.
        time_min: times in minutes, shape (rows,).
        inputs: input values, shape (rows, inputs).
        outputs: output values, shape (rows,).
        residual: one-step-ahead residuals, shape (rows,); NaN if missing.
    """
    try:
        checks = [
            Check(name=check.name, result=check.result) for check in check_record(structure, inputs, outputs, time_min)
        ]
        if checks[-1].name != "variation":
            checks.append(_residual_check(whiteness(residual, fitted=structure.output_lags)))
            if structure.inputs:
                checks.append(_residual_check(independence(residual, inputs, structure.delay, time=time_min)))
    except InputError as error:  # too few rows without a gap: no fault of the plant's, but worth reporting
        checks = [Check(name="record", result=str(error))]
    return checks


def _residual_check(test: ResidualTest) -> Check:
    left_out = f"the model leaves something out: -log10 p = {test.minus_log10_p:.1f}"
    return Check(name=test.name, result="ok" if test.minus_log10_p < WORST_MINUS_LOG10_P else left_out)
