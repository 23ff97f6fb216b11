"""Simulate a process along a record."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from reactorwatch import html
from reactorwatch.api.records import (
    ProcessLike,
    Record,
    measured_fields,
    model_of,
    process_of,
    record_html,
    signal_panels,
)
from reactorwatch.arrays import Array
from reactorwatch.diagnosis.record_checks import check_values, find_wrong_unit
from reactorwatch.errors import InputError
from reactorwatch.figures import Panel
from reactorwatch.process import named_effects
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.law import laws_of
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import complete_state
from reactorwatch.records.record import Record as MeasuredRecord
from reactorwatch.records.record import join_runs
from reactorwatch.results.simulation import Rmse, SimulationReport


@dataclass(frozen=True, init=False)
class Simulation(Record):
    """A simulation in the rows of a record.

    Attributes:
        rmse: difference from the record, by output.
        measured: the record; None: unknown.
    """

    rmse: Mapping[str, Rmse] = field(default_factory=dict)
    measured: MeasuredRecord | None = field(default=None, repr=False)

    def __init__(self, rmse: Mapping[str, Rmse], measured: MeasuredRecord | None = None, **about: Any) -> None:
        super().__init__(**about)
        object.__setattr__(self, "rmse", rmse)
        object.__setattr__(self, "measured", measured)

    def _repr_html_(self) -> str:
        rows = [(name, f"{item.value:.3g} {item.unit}") for name, item in self.rmse.items()]
        return record_html(self) + html.table(("output", "root mean square difference from the record"), rows)

    def _panels(self) -> list[Panel]:
        if self.measured is None:
            return super()._panels()
        return signal_panels(self.measured, self.inputs, self)


def simulate(
    record: MeasuredRecord, process: ProcessLike | None = None, faults: Sequence[str] = (), settle: int = 0
) -> Simulation:
    """Simulate a process from the first row of a record (of each run), driven by the record's inputs.

    Args:
        record: with the inputs and outputs of the process.
        process: name, path of a file that describes it, description or model; None: the process of the record.
        faults: specifications such as `coolant_flow:step:-0.05@30min`, in the record's time.
        settle: number of first rows of each run that set the state it starts from, and are left out of the differences;
            0: the first row sets it.

    Returns:
        The inputs and the simulated outputs in the rows of the record.

    Raises:
        InputError: the record cannot drive the model, or a specification is malformed.
    """
    model = model_of(record, process)
    simulated = simulate_along(record, model, list(faults), settle)
    rmse = root_mean_squares(record, simulated, model, settle)
    return Simulation(rmse, record, **measured_fields(simulated), process=process_of(record, process))


def root_mean_squares(
    measured: MeasuredRecord, simulated: MeasuredRecord, model: ProcessModel, settle: int = 0
) -> dict[str, Rmse]:
    """Root mean square difference between simulation and record, by output; `settle` rows of each run are left out."""
    kept = np.ones(measured.rows, dtype=bool)
    for start in measured.run_starts:
        kept[start : start + settle] = False
    return {
        name: Rmse(
            float(np.sqrt(np.nanmean((simulated.columns[name] - measured.columns[name])[kept] ** 2))), model.units[name]
        )
        for name in model.output_names
    }


def simulate_along(measured: MeasuredRecord, model: ProcessModel, faults: list[str], settle: int = 0) -> MeasuredRecord:
    """Run the equations from the first row of each run of the record, driven by its input.

    Args:
        measured: record with the model's inputs and outputs as columns.
        model: the process; states without a column start at rest.
        faults: specifications of faults, with onsets in the record's time.
        settle: number of first rows of each run that set the state it starts from; 0: the first row sets it.

    Raises:
        InputError: the record cannot drive the model, or a run has no more rows than those.
    """
    runs = measured.split_runs()
    shortest = min(run.rows for run in runs)
    if not 0 <= settle < shortest:
        raise InputError(
            f"{measured.name}: settle must be at least 0 rows and less than those of a run, {shortest}, got {settle}"
        )
    simulated = join_runs([_simulate_run(run, model, faults, settle, alone=len(runs) == 1) for run in runs])
    return replace(simulated, name=f"simulation of {measured.name}")


def _simulate_run(
    measured: MeasuredRecord, model: ProcessModel, faults: list[str], settle: int, *, alone: bool
) -> MeasuredRecord:
    """Simulate along one run of a record; a single row among other runs is returned unchanged."""
    for text in faults:
        model = parse_fault(text, named_effects(model)).extend(model, end_min=float(measured.time_min[-1]))
    wrong = find_wrong_unit(model, measured.columns, measured.time_min)
    if wrong is not None and not wrong.of_times:  # it may be short, and its rows far apart
        raise InputError(f"{measured.name}: {wrong.text}")
    check_values(measured, model)
    inputs = np.column_stack([measured.columns[name] for name in model.input_names])
    first = {name: float(measured.columns[name][0]) for name in model.output_names}
    if not np.all(np.isfinite(list(first.values()))):
        levels = ", ".join(f"{name} = {value:g}" for name, value in first.items())
        first_row = "the first row" if alone else "the first row of each run"
        raise InputError(
            f"{measured.name}: {first_row} must have {' and '.join(first)}, the run starts from them; got {levels}"
        )
    if not np.all(np.isfinite(inputs)):
        row = int(np.argmax(~np.all(np.isfinite(inputs), axis=1)))
        names = ", ".join(model.input_names)
        raise InputError(
            f"{measured.name}: {names} must be there in every row, it is missing at {measured.time_min[row]:g} min"
        )
    if measured.rows == 1 and not alone:
        columns = {name: measured.columns[name] for name in (*model.input_names, *first)}
        return replace(measured, columns=columns, excluded={})
    start, simulator = complete_state(model, first, inputs[0], float(measured.time_min[0])), Simulator(model)
    try:
        if settle:
            start = _fit_start(simulator, measured, inputs, start, settle)
        trajectory = simulator.run(measured.time_min, inputs, start)
    except ValueError as error:
        raise InputError(f"{measured.name}: {error}") from error
    columns = {name: inputs[:, index] for index, name in enumerate(model.input_names)}
    columns |= {name: trajectory.outputs[:, index] for index, name in enumerate(model.output_names)}
    return replace(measured, columns=columns, excluded={})


def _fit_start(simulator: Simulator, measured: MeasuredRecord, inputs: Array, start: Array, rows: int) -> Array:
    """Start state that fits the outputs of the first rows best, from a first guess."""
    from scipy.optimize import least_squares  # only here: to import it is a tenth of a start

    model = simulator.model
    outputs = np.column_stack([measured.columns[name][:rows] for name in model.output_names])
    spreads = np.array([np.nanstd(measured.columns[name]) or 1.0 for name in model.output_names])
    scales = np.array([item.scale for item in model.states])
    low, high = (np.array([getattr(item, side) for item in model.states]) for side in ("lower", "upper"))

    def differences(state: Array) -> Array:
        run = simulator.run(measured.time_min[:rows], inputs[:rows], state)
        return np.asarray(np.nan_to_num((run.outputs - outputs) / spreads).ravel())

    return np.asarray(least_squares(differences, np.clip(start, low, high), x_scale=scales, bounds=(low, high)).x)


def report(
    measured: MeasuredRecord, simulated: MeasuredRecord, model: ProcessModel, out: Path | None, settle: int = 0
) -> SimulationReport:
    """Compare a simulation with its record.

    Args:
        measured: the record.
        simulated: the simulation, in the rows of the record.
        model: the process.
        out: file of the simulation; None: it could not be written.
        settle: first rows of each run that are left out.
    """
    remarks = [sentence for law in laws_of(model) for sentence in law.outside(simulated.columns)]
    return SimulationReport(
        file=None if out is None else str(out),
        rows=measured.rows,
        runs=len(measured.run_starts),
        rmse=root_mean_squares(measured, simulated, model, settle),
        remarks=remarks if model.laws else None,
        notes=tuple(measured.remarks),
    )
