"""Diagnose a record from Python."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
from msgspec.structs import replace

from reactorwatch import html
from reactorwatch.api.records import ProcessLike, check_signals, process_of
from reactorwatch.api.shown import Shown, report_origin
from reactorwatch.description.process import Process
from reactorwatch.description.read import find_process
from reactorwatch.description.toml_file import add_description
from reactorwatch.diagnosis.diagnose import diagnose as find_causes
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.panels import outputs
from reactorwatch.diagnosis.result import Diagnosis
from reactorwatch.figures import Panel
from reactorwatch.optional import frame_of_rows
from reactorwatch.process.effect import Effect
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record
from reactorwatch.sentences.diagnosis import (
    describe_causes,
    describe_place,
    describe_rival,
    describe_size,
    describe_timing,
    describe_verdict,
)

if TYPE_CHECKING:
    from pandas import DataFrame

COLUMNS = ("explanation", "delta_bic", "cause", "profile", "label", "location", "size", "size_sd", "unit", "onset_min")
"""Columns of the data frame."""


class Case(NamedTuple):
    """A record to be diagnosed.

    Attributes:
        record: the measured record.
        process: the process, on the clock of the record, with the equations of the simulation.
        effects: possible causes.
        uncertain: standard deviations of uncertain parameters, by name.
        file: name of the record as given; empty: its own.
    """

    record: Record
    process: Process
    effects: tuple[Effect, ...]
    uncertain: dict[str, float]
    file: str = ""


class DiagnosisResult(Shown[Diagnosis]):
    """A `Diagnosis` with its record and the model that it compares with it.

    Attributes:
        model: the simulation before it was extended.
        effects: possible causes.
    """

    def __init__(self, result: Diagnosis, record: Record, model: ProcessModel, effects: tuple[Effect, ...]) -> None:
        super().__init__(result, record)
        self.model, self.effects = model, effects

    def __repr__(self) -> str:
        return f"<{describe_verdict(self.result)}>"

    @property
    def extended(self) -> ProcessModel:
        """The model with the causes in it: a process for `simulate`, `diagnose` and `backtest`."""
        return parse_extended_model(msgspec.json.encode(self.result.extended_model)).build()

    def to_dict(self) -> dict[str, Any]:
        """The object that `reactorwatch diagnose --json` prints, and the differences of the simulation."""
        return self.result.to_dict("differences")

    def _repr_html_(self) -> str:
        causes = [
            (
                item.label,
                item.cause,
                describe_place(item.location),
                describe_size(item, self.effects),
                describe_timing(item),
            )
            for item in self.causes
        ]
        others = [
            (describe_causes(item.causes, self.effects), describe_rival(item, self.result))
            for item in self.alternatives
        ]
        errors = [
            (f"{name}, {item.unit}", f"{item.rmse_before:.3g}", f"{item.rmse_after:.3g}", f"{item.noise_sd:.3g}")
            for name, item in self.gain.held_out.items()
        ]
        return "".join(
            [
                html.headline(describe_verdict(self.result)),
                html.table(("cause", "name", "where", "size (95 %)", "when"), causes),
                html.table(("or", "compared"), others),
                html.table(("error of the simulation", "as it was", "extended", "noise"), errors),
                *map(html.sentence, self.remarks),
            ]
        )

    def to_frame(self) -> "DataFrame":
        """A row for each cause of each explanation; explanation 0 is the named one, the others are alternatives.

        Raises:
            InputError: pandas is not installed.
        """
        explanations = [(self.causes, 0.0), *((item.explanation, item.delta_bic) for item in self.alternatives)]
        rows: list[dict[str, Any]] = []
        for number, (causes, worse) in enumerate(explanations):
            for cause in causes:
                size, onset = cause.parameters["size"], cause.parameters.get("onset")
                values = (number, worse, cause.cause, cause.profile, cause.label, cause.location)
                sizes = (size.value, size.sd, size.unit, None if onset is None else onset.value)
                rows.append(dict(zip(COLUMNS, (*values, *sizes), strict=True)))
        return frame_of_rows(rows, COLUMNS)

    def _panels(self) -> list[Panel]:
        return outputs(self.result, self.model)

    def _page(self) -> str:
        from reactorwatch.diagnosis.report.page import as_page

        names, origin = (self.record.name, "extended.json", "experiment.csv"), report_origin(Path(self.record.name), {})
        return as_page(self.result, self.model, self.effects, *names, on_the_bus=False, origin=origin)


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
    described = find_process(process_of(record, process), record.zero_ns)
    model = described.require_model()
    check_signals(record, model)
    make_run(record, model)
    causes = described.select_causes(without) if effects is None else effects
    case = Case(record, described, causes, described.uncertain | dict(uncertain or {}))
    return diagnose_case(case, dict(tolerance or {}), dict(limits or {}))


def diagnose_case(case: Case, tolerance: dict[str, float], limits: dict[str, tuple[float, float]]) -> DiagnosisResult:
    """Diagnose a record whose rows are checked; arguments as for `diagnose`.

    Raises:
        InputError: invalid tolerances or limits.
    """
    started, model = time.monotonic(), case.process.require_model()
    found = find_causes(case.record, model, case.effects, tolerance or None, case.uncertain, limits or None)
    result = replace(
        found,
        file=case.file or found.file,
        extended_model=add_description(found.extended_model, case.process),
        seconds=round(time.monotonic() - started, 3),
    )
    return DiagnosisResult(result, case.record, model, case.effects)
