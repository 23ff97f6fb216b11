"""Identify linear models of a record from Python."""

from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from reactorwatch import html
from reactorwatch.api.records import ProcessLike, process_of
from reactorwatch.api.shown import Shown, page_of
from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.figures import Line, Panel
from reactorwatch.identification.data import Dataset
from reactorwatch.identification.identify import Identification, ModelForm
from reactorwatch.identification.identify import identify as fit_model
from reactorwatch.optional import make_frame
from reactorwatch.records.record import Record
from reactorwatch.sentences.models import free_run_text, identification_headline

if TYPE_CHECKING:
    from pandas import DataFrame


class IdentificationResult(Shown[Identification]):
    """An `Identification` with the record that was fitted."""

    def __repr__(self) -> str:
        return f"<{self.model} of order {self.order} for {self.output}: free run {free_run_text(self.result)}>"

    def _repr_html_(self) -> str:
        return "".join(
            [
                html.headline(identification_headline(self.result)),
                html.sentence(f"{self.rows} rows were fitted; the fits are of rows that were not."),
                html.table(("check", "result"), self.checks.items()),
            ]
        )

    def to_frame(self) -> "DataFrame":
        """Held-out rows: the output measured, predicted one step ahead and simulated.

        Raises:
            InputError: pandas is not installed.
        """
        run, name = self.run, self.output
        values = {name: run.measured, f"{name}.one_step": run.one_step, f"{name}.free_run": run.free}
        return make_frame({"time_min": run.time, **values}, "time_min")

    def _panels(self) -> list[Panel]:
        run, unit = self.run, self.record.units.get(self.output, "")
        lines = (
            Line("measured", run.time, run.measured),
            Line("free run", run.time, run.free, "before"),
            Line("one step", run.time, run.one_step, "after"),
        )
        errors = (
            Line("free run", run.time, run.measured - run.free, "before"),
            Line("one step", run.time, run.measured - run.one_step, "after"),
        )
        in_unit = f", {unit}" if unit else ""
        return [Panel(f"{self.output}{in_unit}", lines), Panel(f"error{in_unit}", errors)]

    def _page(self) -> str:
        title = f"{self.model.upper()} model of {self.output}: {self.record.name}"
        return page_of(title, self._repr_html_(), self._panels(), self.record.name)


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
        form: `model` (`arx`, `oe`, `armax`, `bj`, `narx`, `noe`), `order`, `delay`, `recursive`
            and `forgetting`, like the options of the command.

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
    return IdentificationResult(fit_model(data, ModelForm(**form), held_out, settle), record)
