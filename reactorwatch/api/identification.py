"""Identify linear models of a record from Python."""

from collections.abc import Sequence
from typing import Any

from reactorwatch.api.records import ProcessLike, process_of
from reactorwatch.description.find import find_process
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.identification.dataset import Dataset
from reactorwatch.identification.identify import Identification, ModelForm
from reactorwatch.identification.identify import identify as identify_model
from reactorwatch.records.record import Record


def identify(
    record: Record,
    output: str,
    *,
    process: ProcessLike | None = None,
    input: str | Sequence[str] | None = None,
    validate: Record | None = None,
    settle: int = 0,
    **form: Any,
) -> Identification:
    """Fit a model of one output to the first half of a record and validate it on the second.

    Args:
        record: with columns of the inputs and the output.
        output: name of the output.
        process: decides which signals are the inputs; None: that of the record.
        input: names of the inputs, none, one or several; None: those of the process.
        validate: record to validate on; all of `record` is then fitted.
        settle: number of first held-out rows that may set the state, and are left out of the fits.
        form: `model` (`arx`, `oe`, `armax`, `bj`, `narx`), `order`, `delay` and `recursive`, like the options of the
            command.

    Raises:
        InputError: a signal is missing, the record cannot determine the model, or `form` has another name.
    """
    known = ("model", "order", "delay", "recursive")
    for name in form:
        if name not in known:
            raise InputError(describe_unknown("argument", name, known))
    if input is None:
        inputs = find_process(process_of(record, process)).inputs
    else:
        inputs = (input,) if isinstance(input, str) else tuple(input)
    held_out = None if validate is None else Dataset.of_record(validate, inputs, output)
    return identify_model(Dataset.of_record(record, inputs, output), ModelForm(**form), held_out, settle)
