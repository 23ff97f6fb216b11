"""Identify linear models of a record from Python."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from reactorwatch.api.records import ProcessLike, process_of
from reactorwatch.api.views import identification as view
from reactorwatch.api.views.page import write_page
from reactorwatch.description.find import find_process
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.identification.dataset import Dataset
from reactorwatch.identification.identify import HeldOutRun, Identification, ModelForm, identify_and_run
from reactorwatch.records.record import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


class IdentificationResult(Identification, frozen=True, kw_only=True):
    """An `Identification` with its run on the held-out rows.

    Attributes:
        run: measured, predicted and simulated output on the held-out rows.
        record: the record that was fitted.
    """

    run: HeldOutRun
    record: Record

    def __repr__(self) -> str:
        return f"<{self.model} of order {self.order} for {self.output}: free run {self.fit.free_run:.2f} %>"

    def _repr_html_(self) -> str:
        return view.identification_html(self)

    def to_dict(self) -> dict[str, Any]:
        """The object that `reactorwatch identify --json` prints."""
        names = Identification.__struct_fields__
        found: dict[str, Any] = msgspec.to_builtins(Identification(**{name: getattr(self, name) for name in names}))
        return found

    def to_frame(self) -> "DataFrame":
        """Held-out rows: the output measured, predicted one step ahead and simulated.

        Raises:
            InputError: pandas is not installed.
        """
        return view.held_out_frame(self, self.run)

    def plot(self) -> "Figure":
        """Plot the held-out rows with the simulation and the one-step-ahead prediction.

        Raises:
            InputError: matplotlib is not installed.
        """
        return view.plot_identification(self, self.run, self.record.units.get(self.output, ""))

    def to_html(self, file: str | Path) -> None:
        """Write the result with its figure as one page.

        Raises:
            InputError: the file cannot be written.
        """
        title = f"{self.model.upper()} model of {self.output}: {self.record.name}"
        write_page(file, title, view.identification_html(self), self.plot, self.record.name)


def identify(
    record: Record,
    output: str,
    *,
    process: ProcessLike | None = None,
    input: str | Sequence[str] | None = None,
    validate: Record | None = None,
    settle: int = 0,
    **form: Any,
) -> IdentificationResult:
    """Fit a model of one output to the first half of a record and validate it on the second.

    Args:
        record: with columns of the inputs and the output.
        output: name of the output.
        process: decides which signals are the inputs; None: that of the record.
        input: names of the inputs, none, one or several; None: those of the process.
        validate: record to validate on; all of `record` is then fitted.
        settle: number of first held-out rows that may set the state, and are left out of the fits.
        form: `model` (`arx`, `oe`, `armax`, `bj`, `narx`, `noe`), `order`, `delay`, `scheme`, `recursive`,
            `forgetting`, `adaptation` and `gain`, like the options of the command.

    Raises:
        InputError: a signal is missing, the record cannot determine the model, or `form` has another name.
    """
    known = [field.name for field in fields(ModelForm)]
    for name in form:
        if name not in known:
            raise InputError(describe_unknown("argument", name, known))
    if input is None:
        inputs = find_process(process_of(record, process)).inputs
    else:
        inputs = (input,) if isinstance(input, str) else tuple(input)
    held_out = None if validate is None else Dataset.of_record(validate, inputs, output)
    data = Dataset.of_record(record, inputs, output)
    found, run = identify_and_run(data, ModelForm(**form), held_out, settle)
    values = {name: getattr(found, name) for name in Identification.__struct_fields__}
    return IdentificationResult(**values, run=run, record=record)
