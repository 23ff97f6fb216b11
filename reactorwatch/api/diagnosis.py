"""Diagnose a record from Python."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from reactorwatch.api.records import ProcessLike, check_signals, process_of
from reactorwatch.api.report_origin import report_origin
from reactorwatch.api.views import diagnosis as view
from reactorwatch.description.find import find_process
from reactorwatch.description.toml_file import add_description
from reactorwatch.diagnosis.diagnose import diagnose as find_causes
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.machine import report_object
from reactorwatch.diagnosis.result import Diagnosis
from reactorwatch.process.effect import Effect
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.record import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


@dataclass(frozen=True)
class DiagnosisResult(Diagnosis):
    """A `Diagnosis` with the record and the model that it compares.

    Attributes:
        record: the measured record.
        model: the simulation before it was extended.
        effects: possible causes.
        seconds: duration of the diagnosis.
    """

    record: Record = field(kw_only=True, repr=False, compare=False)
    model: ProcessModel = field(kw_only=True, repr=False, compare=False)
    effects: tuple[Effect, ...] = field(kw_only=True, repr=False, compare=False)
    seconds: float = field(kw_only=True, repr=False, compare=False)

    @property
    def file(self) -> str:
        """Name of the record."""
        return self.record.name

    @property
    def zero(self) -> str | None:
        """Clock time from which the minutes count, as ISO 8601; None: unknown."""
        return self.record.zero

    @property
    def extended(self) -> ProcessModel:
        """The model with the causes in it: a process for `simulate`, `diagnose` and `backtest`."""
        return parse_extended_model(msgspec.json.encode(self.extended_model)).build()

    def to_dict(self) -> dict[str, Any]:
        """The object that `reactorwatch diagnose --json` prints, and the differences of the simulation."""
        return report_object(self, self.file, self.seconds, self.zero)

    def _repr_html_(self) -> str:
        return view.diagnosis_html(self, self.effects)

    def to_frame(self) -> "DataFrame":
        """A row for each cause of each explanation; explanation 0 is the named one, the others are alternatives.

        Raises:
            InputError: pandas is not installed.
        """
        return view.diagnosis_frame(self)

    def plot(self) -> "Figure":
        """Plot the measured outputs with the simulation as it was and the extended one.

        Raises:
            InputError: matplotlib is not installed.
        """
        assert self.curves is not None, "a diagnosis of a record has curves"
        return view.plot_diagnosis(self, self.curves, self.model.units)

    def to_html(self, file: str | Path) -> None:
        """Write the report as one page.

        Raises:
            InputError: the file cannot be written.
        """
        from reactorwatch.diagnosis.report.page import as_page

        names, origin = (self.record.name, "extended.json", "experiment.csv"), report_origin(Path(self.record.name), {})
        page = as_page(self, self.model, self.effects, *names, on_the_bus=False, origin=origin)
        with atomic_write(Path(file)) as temporary:
            temporary.write_text(page, encoding="utf-8")


def diagnose(
    record: Record,
    process: ProcessLike | None = None,
    *,
    effects: tuple[Effect, ...] | None = None,
    without: Sequence[str] = (),
    uncertain: Mapping[str, float] | None = None,
    tolerance: Mapping[str, float] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> DiagnosisResult:
    """Find what a simulation gets wrong in a record, name the cause and extend the model with it.

    Args:
        record: with the inputs and outputs of the process.
        process: the simulation; None: the process of the record.
        effects: causes to search; None: those of the process.
        without: names of causes of the process that are left out.
        uncertain: standard deviations of parameters that are known only roughly, by name.
        tolerance: differences that do not matter in practice, by output.
        limits: smallest and largest value of signals that a proposed experiment may reach.

    Raises:
        InputError: the record cannot be diagnosed, or an argument is outside its range.
    """
    started = time.monotonic()
    described = find_process(process_of(record, process), record.zero_ns)
    model = described.require_model()
    check_signals(record, model)
    make_run(record, model)
    causes = described.select_causes(without) if effects is None else effects
    known = described.uncertain | dict(uncertain or {})
    found = find_causes(record, model, causes, dict(tolerance or {}) or None, known, dict(limits or {}) or None)
    values = {item.name: getattr(found, item.name) for item in fields(found)}
    values["extended_model"] = add_description(found.extended_model, described)
    seconds = time.monotonic() - started
    return DiagnosisResult(**values, record=record, model=model, effects=causes, seconds=seconds)
